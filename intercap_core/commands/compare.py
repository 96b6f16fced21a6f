"""`intercap compare`: what changed between two versions of a dataset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from intercap_core.errors import UserError
from intercap_core.evaluation.compare import SAME, Comparison, compare

ROWS = 40  # sequences printed; all are in the tables
TABLES = ("compare_sequences.csv", "compare_frames.csv", "compare_figures.csv")
_COLUMNS = (
    ("frames", "frames", 0), ("changed", "changed_frames", 0), ("body mm", "body_mm", 1),
    ("most", "body_max_mm", 1), ("hands mm", "hands_mm", 1), ("object mm", "object_mm", 1),
    ("most", "object_max_mm", 1), ("object deg", "object_deg", 1),
    ("contact differs", "contact_changed_frames", 0),
)  # fmt: skip


def print_comparison(old: Path, new: Path, output: Path | None = None) -> list[Path]:
    """Print what changed, most first, and write the tables into the folder ``output``.

    Returns the files written. Raises UserError where a folder holds no results.
    """
    if output is not None and output.exists() and not output.is_dir():
        raise UserError(f"{output}: is a file, expected a folder for tables; name another output")
    found = compare(old, new)
    console = Console()
    console.print(_table(found))
    if len(found.figures):
        console.print(_figures(found))
    same = int((found.sequences["state"] == SAME).sum())
    differs = len(found.sequences) - same
    left = max(0, differs - ROWS)
    more = f" ({left} of them are not printed)" if left else ""
    console.print(
        f"{differs} of {len(found.sequences)} sequences differ{more}, {len(found.frames)} frames; "
        f"{same} are the same",
        highlight=False,
    )
    if output is None:
        return []
    output.mkdir(parents=True, exist_ok=True)
    paths = [output / name for name in TABLES]
    for path, table in zip(paths, (found.sequences, found.frames, found.figures), strict=True):
        table.to_csv(path, index=False, float_format="%.6g")
    return paths


def _table(found: Comparison) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("sequence")
    table.add_column("state")
    for head, _, _ in _COLUMNS:
        table.add_column(head, justify="right")
    table.add_column("flagged", justify="right")
    table.add_column("body stated, mm", justify="right")
    shown = found.sequences[found.sequences["state"] != SAME].head(ROWS)
    for row in shown.to_dict("records"):
        cells = [_number(row[key], digits) for _, key, digits in _COLUMNS]
        flagged = _pair(row["flagged_before"], row["flagged_after"], 0)
        stated = _pair(row["stated_body_mm_before"], row["stated_body_mm_after"], 1)
        state = ": ".join(filter(None, (row["state"], row["note"])))
        table.add_row(escape(str(row["sequence"])), escape(state), *cells, flagged, stated)
    return table


def _figures(found: Comparison) -> Table:
    """The datasets' figures side by side."""
    table = Table(box=None, pad_edge=False)
    table.add_column("all frames")
    for head in ("old", "new"):
        table.add_column(head, justify="right")
    for name, old, new in found.figures.itertuples(index=False):
        table.add_row(escape(str(name)), f"{old:.4g}", f"{new:.4g}")
    return table


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"


def _pair(before: float, after: float, digits: int) -> str:
    return f"{_number(before, digits)} → {_number(after, digits)}"
