"""Figures beside those that were recorded before: what got worse by more than the spread."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from rich.console import Console
from rich.table import Table

from intercap_core.commands.evaluate.part import SPREAD

REFERENCE = Path("bench/reference-quick.json")
TIMES_SPREAD = 2.0  # standard errors
SAME = 0.02  # of the figure: the same for all who read it
NEGLIGIBLE = 5e-4  # of any unit: no digit of a table shows it
# Words of keys that say which way is better; others are printed but not judged
_MORE_IS_BETTER = ("recall", "precision", "_f1", "success", "improved")
_LESS_IS_BETTER = ("_mm", "_deg", "lost_", "bad_frames", "acceleration", "missing")
_MAIN = (
    "translation_median_mm", "translation_p95_mm", "rotation_median_deg", "rotation_p95_deg",
    "lost_share", "body_pve_mm", "body_mpjpe_mm", "hand_mpjpe_mm", "contact_region_f1",
    "object_translation_mm", "object_rotation_deg", "slip_mm_s", "planted_mm_s",
    "contact_detected_f1", "hand_grasp_mpjpe_mm",
)  # fmt: skip


def worse(key: str, value: float, before: float, error: float) -> bool:
    """Whether a figure is worse than before by more than its spread and a little."""
    gain = value - before
    if any(word in key for word in _MORE_IS_BETTER):
        gain = -gain
    elif not any(word in key for word in _LESS_IS_BETTER):
        return False
    return gain > max(TIMES_SPREAD * error, SAME * abs(before), NEGLIGIBLE)


def compare(figures: Mapping[str, float], reference: Path = REFERENCE) -> list[str]:
    """Print the main figures beside the recorded ones and all that got worse; the latter's keys.

    The spread is the recorded one. The recordings are the same, so that most of a change is not
    chance even within it.
    """
    console = Console()
    if not reference.is_file():
        console.print(f"{reference} is not there: nothing to compare with", highlight=False)
        return []
    before = json.loads(reference.read_text(encoding="utf-8"))
    judged = [key for key in figures if key in before and not key.endswith(SPREAD)]
    found = [
        key
        for key in judged
        if worse(key, figures[key], before[key], before.get(f"{key}{SPREAD}", 0.0))
    ]
    gone = [key for key in before if key not in figures and not key.startswith("time.")]
    table = Table("figure", "recorded", "now", "+-", "", box=None)
    table.title = f"beside {reference}"
    for key in judged:
        main = key.split(".")[-1] in _MAIN
        if main or key in found:
            error = before.get(f"{key}{SPREAD}")
            cells = [f"{before[key]:.3f}", f"{figures[key]:.3f}"]
            cells += ["" if error is None else f"{error:.3f}", "worse" if key in found else ""]
            table.add_row(key, *cells)
    console.print(table)
    if gone:
        console.print(f"no longer there: {', '.join(gone)}", highlight=False, soft_wrap=True)
    words = f"{len(found)} figures are worse than recorded by more than their spread"
    console.print(words if found else "nothing is worse than recorded", highlight=False)
    return found
