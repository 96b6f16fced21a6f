"""Compare two versions of a dataset: changes by sequence and frame.

A frame has changed if body, hands or object moved by more than 1 mm, or the object turned by more
than 0.5 degrees. It has also changed if its contact regions or flag differ.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.body.joints import BODY_JOINTS, FINGER_JOINTS
from intercap_core.errors import UserError
from intercap_core.evaluation.summary import SequenceSummary
from intercap_core.evaluation.verdict.figures import stated_errors
from intercap_core.flags import Flags
from intercap_core.schemas import JOINT

NAME, FRAME = "sequence", "frame"
SAME, CHANGED, ADDED, REMOVED, UNLIKE = "same", "changed", "added", "removed", "not comparable"


@dataclass(frozen=True)
class Comparison:
    """Differences between two versions, millimetres and degrees."""

    sequences: pd.DataFrame
    """One row per sequence of either version. Sequences that cannot be compared come first, then
    those with the largest share of changed frames."""
    frames: pd.DataFrame
    """One row per changed frame."""
    figures: pd.DataFrame
    """Columns "figure", "old", "new": numbers of summary.json; empty if a version lacks it."""


def compare(old: Path, new: Path) -> Comparison:
    """Compare two results folders, sequence by sequence.

    Folders with a joint artefact are sequences. Raises UserError if a version has none.
    """
    before, after = (_sequences(folder) for folder in (old, new))
    rows: list[dict[str, object]] = []
    frames = []
    for name in sorted({*before, *after}):
        if name not in before or name not in after:
            rows.append({NAME: name, "state": ADDED if name not in before else REMOVED})
            continue
        try:
            row, changed = _compare_one(name, before[name], after[name])
        except UserError as error:
            row, changed = {"state": UNLIKE, "note": str(error)}, pd.DataFrame()
        rows.append({NAME: name, **row})
        if len(changed):
            frames.append(changed)
    columns = [
        NAME, "state", "frames", "changed_frames", "body_mm", "body_max_mm", "hands_mm",
        "object_mm", "object_max_mm", "object_deg", "contact_frames_before",
        "contact_frames_after", "contact_changed_frames", "flagged_before", "flagged_after",
        *(f"stated_{part}_mm_{when}" for part in ("body", "hands", "object")
          for when in ("before", "after")),
        "note",
    ]  # fmt: skip
    table = pd.DataFrame(rows, columns=columns)
    numbers = table.columns.drop([NAME, "state", "note"])
    table[numbers] = table[numbers].astype(float)
    table["note"] = table["note"].fillna("")
    worst = table[["body_max_mm", "object_max_mm"]].max(axis=1)
    share = table["changed_frames"] / table["frames"]
    incomparable = table["state"].isin([ADDED, REMOVED, UNLIKE])
    keys = ["incomparable", "share", "worst"]
    order = pd.DataFrame(dict(zip(keys, (incomparable, share, worst), strict=True))).fillna(-1)
    table = table.loc[order.sort_values(keys, ascending=False).index]
    return Comparison(
        table.reset_index(drop=True),
        pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=[NAME, FRAME]),
        _figures(old, new),
    )


def _figures(old: Path, new: Path) -> pd.DataFrame:
    """Numbers that the summary.json of both versions contain."""
    both = []
    for folder in (old, new):
        try:
            summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return pd.DataFrame(columns=["figure", "old", "new"])
        both.append(pd.json_normalize(summary).select_dtypes("number").loc[0].astype(float))
    table = pd.concat(both, axis=1, join="inner", keys=["old", "new"])
    return table.rename_axis("figure").reset_index()


def _sequences(folder: Path) -> dict[str, Path]:
    """Folders of the sequences of a version, by name."""
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; expected a results folder, results/<dataset>")
    found = {path.parent.name: path.parent for path in sorted(folder.glob("*/joint.h5"))}
    if not found:
        raise UserError(
            f"{folder}: has no sequence with a joint.h5; expected a results folder, "
            "results/<dataset>, of a project that was run"
        )
    return found


def _compare_one(name: str, old: Path, new: Path) -> tuple[dict[str, object], pd.DataFrame]:
    """Row of one sequence, and the table of its changed frames."""
    with (
        artefacts.read(old / "joint.h5", JOINT) as before,
        artefacts.read(new / "joint.h5", JOINT) as after,
    ):
        table = _frames(name, before, after)
        changed = (
            (table[["body_mm", "hands_mm", "object_mm"]] > 1.0).any(axis=1)
            | (table["object_deg"] > 0.5)
            | (table["touches"] != "")
            | (table["touches_no_more"] != "")
            | (table["flag_before"] != table["flag_after"])
        )
        touching = [np.any(_touching(joint), axis=1) for joint in (before, after)]
    contact = (table["touches"] != "") | (table["touches_no_more"] != "")
    row: dict[str, object] = {
        "state": CHANGED if changed.any() else SAME,
        "frames": len(table),
        "changed_frames": int(changed.sum()),
        "body_mm": table["body_mm"].mean(),
        "body_max_mm": table["body_mm"].max(),
        "hands_mm": table["hands_mm"].mean(),
        "object_mm": table["object_mm"].mean(),
        "object_max_mm": table["object_mm"].max(),
        "object_deg": table["object_deg"].mean(),
        "contact_frames_before": int(touching[0].sum()),
        "contact_frames_after": int(touching[1].sum()),
        "contact_changed_frames": int(contact.sum()),
        "note": "",
    }
    for when, folder in (("before", old), ("after", new)):
        row |= _measured(folder, when)
    return row, table[changed].copy()


def _frames(name: str, before: Artefact, after: Artefact) -> pd.DataFrame:
    """Differences of all frames of a sequence, millimetres and degrees."""
    joints, joints_after = before["joints"], after["joints"]
    if joints.shape != joints_after.shape:
        raise UserError(
            f"sequence {name}: {len(joints)} frames before and {len(joints_after)} after; frames "
            "cannot be compared"
        )
    apart = 1e3 * np.linalg.norm(joints_after - joints, axis=2)
    fingers = np.hstack([apart[:, hand] for hand in FINGER_JOINTS])
    turned = np.full(len(joints), np.nan)
    known = np.isfinite(before["rotation"]).all((1, 2)) & np.isfinite(after["rotation"]).all((1, 2))
    if known.any():
        turn = after["rotation"][known] @ before["rotation"][known].swapaxes(1, 2)
        turned[known] = np.degrees(Rotation.from_matrix(turn).magnitude())
    regions = np.array(before.text("region_names"))
    old, new = _touching(before), _touching(after)
    if "made_by" in before.attributes or "made_by" in after.attributes:
        new = old  # imported results state no contact, which is not a change
    return pd.DataFrame(
        {
            NAME: name,
            FRAME: np.arange(len(joints)),
            "body_mm": apart[:, BODY_JOINTS].mean(1),
            "hands_mm": fingers.mean(1),
            "object_mm": 1e3 * np.linalg.norm(after["translation"] - before["translation"], axis=1),
            "object_deg": turned,
            "touches": _named(regions, new & ~old),
            "touches_no_more": _named(regions, old & ~new),
            "flag_before": Flags.read(before).texts(),
            "flag_after": Flags.read(after).texts(),
        }
    )


def _touching(joint: Artefact) -> np.ndarray:
    """Mask (T, R) of the regions in contact."""
    return np.nan_to_num(joint["contact_probability"]) >= 0.5


def _named(regions: np.ndarray, which: np.ndarray) -> Sequence[str]:
    """Names of the regions in each row of the mask ``which`` (T, R), joined by ";"."""
    return [";".join(regions[row]) for row in which]


def _measured(folder: Path, when: str) -> dict[str, object]:
    """Number of flagged frames, and stated errors; empty if the summary cannot be read."""
    try:
        found = SequenceSummary.read(folder / "summary.h5").metrics
    except UserError:
        return {}
    row: dict[str, object] = {f"flagged_{when}": int(found.values["flagged"].any(axis=1).sum())}
    for error in stated_errors(found):
        row[f"stated_{error.part}_mm_{when}"] = error.stated
    return row
