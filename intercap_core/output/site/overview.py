"""First page of the site: figures of the whole dataset, and links to the sequences."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from intercap_core.evaluation import figures, flags
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.summary import SequenceSummary
from intercap_core.evaluation.verdict.figures import mean_stated
from intercap_core.flags import PARTS
from intercap_core.output.site import measures
from intercap_core.output.site.drawing import EncodedImage
from intercap_core.output.site.embed import PREVIEW, css, render, span, tile
from intercap_core.output.site.heat_pictures import COLOUR_STOPS, STOP_AT
from intercap_core.versions import versions

_MAX_RUNS = 400  # rows of the list of flagged frames
# Label and unit of table columns. Columns with a dot in their name that are not listed here are not
# printed.
_FIGURES = {
    "acceleration_body_mm": ("acceleration, body", "mm/frame²"),
    "acceleration_object_mm": ("acceleration, object", "mm/frame²"),
    "penetration.mean_mm": ("penetration", "mean, mm"),
    "penetration.p98_mm": ("penetration", "98th percentile, mm"),
    "vertex_to_cloud.body_visible_mm": ("body to point cloud", "visible, mm"),
    "vertex_to_cloud.object_visible_mm": ("object to point cloud", "visible, mm"),
    "verdict.body_mm": ("body", "est. error, mm"),
    "verdict.hands_mm": ("hands", "est. error, mm"),
    "verdict.object_mm": ("object", "est. error, mm"),
    "joint.body_pve_mm": ("body PVE", "mm, ground truth"),
    "joint.hand_mpjpe_mm": ("hands", "mm, ground truth"),
    "joint.object_translation_mm": ("object", "mm, ground truth"),
    "joint.object_rotation_deg": ("object", "deg, ground truth"),
    "joint.contact_region_f1": ("contact", "F1, ground truth"),
    "verdict.keypoint_px": ("keypoints", "px"),
    "verdict.keypoint_px_held_out": ("keypoints", "without this camera, px"),
    "verdict.person_mm": ("person's points", "mm"),
    "verdict.person_held_out_mm": ("person's points", "without this camera, mm"),
    "verdict.overlap": ("object's mask", "IoU"),
    "verdict.overlap_held_out": ("object's mask", "without this camera, IoU"),
    "verdict.object_depth_mm": ("object's depth", "mm"),
    "verdict.object_depth_held_out_mm": ("object's depth", "without this camera, mm"),
}


@dataclass(frozen=True, eq=False)
class Heat:
    """Pictures of one surface's heatmap."""

    name: str
    pictures: Sequence[EncodedImage]
    top: float
    """Likelihood of the last colour."""
    frames: int


@dataclass(frozen=True, eq=False)
class DatasetContent:
    """Content of the overview."""

    dataset: str
    sequences: Sequence[SequenceSummary]
    table: pd.DataFrame
    """A row per sequence."""
    groups: Mapping[str, pd.DataFrame]
    """Tables by object, subject, intent and camera."""
    surfaces: Sequence[Heat]
    """Heatmaps of the body and the hands."""
    objects: Sequence[Heat]
    body_frames: int
    """Frames of the body's heatmaps."""
    page_of: Mapping[str, str]
    """Address of each sequence's page relative to the overview."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """Sequences without a result, with the reason."""
    remarks: Mapping[str, str] = field(default_factory=dict)
    """Remarks of the merge about other sequences."""
    changed: Sequence[tuple[str, str, str]] = ()
    """Name, value and default of each setting that differs from its default."""
    common_scale: float | None = None
    """Likelihood of the last colour of all heatmaps; None = each map's own maximum."""


def page(content: DatasetContent) -> str:
    """Return the HTML of the page."""
    measured = [s.metrics for s in content.sequences]
    rows = _rows(content)
    runs = [
        {
            "sequence": s.name,
            "page": content.page_of[s.name],
            "frames": span(first, last),
            "reason": reason,
        }
        for s in measured
        for first, last, reason in flags.ranges(s.flags.texts())
    ]
    context = {
        **vars(content),
        "headline": _headline(content, measured),
        "virtual": sum(s.has_truth for s in measured),
        "tiles": _tiles(measured),
        "parts": PARTS if any(s.has_object for s in measured) else PARTS[:2],
        "rows": sorted(rows, key=lambda row: row["rank"]),
        "filters": {
            name: sorted({row[name] for row in rows if row[name]})
            for name in ("subject", "object", "intent")
        },
        "failed": sorted(content.failed.items()),
        "remarks": sorted(content.remarks.items()),
        "counts": _counts(measured),
        "groups": [(name, _printed(table)) for name, table in content.groups.items()],
        "truth": measures.truth(measured),
        "verdict": measures.verdict(measured, set()),
        "penetration": measures.penetration(measured),
        "clouds": measures.clouds(content.dataset, measured),
        "acceleration": measures.accelerations(measured),
        "heat": _heat(content),
        "cameras": measures.cameras(measured, {s.name: s.residuals for s in content.sequences}),
        "flagged_runs": runs[:_MAX_RUNS],
        "flagged_left_out": max(0, len(runs) - _MAX_RUNS),
        "flagged_text": figures.pooled_flags(measured).summary(),
        "versions": versions(),
        "made_by": measures.made_by_stage(content.sequences),
    }
    return render("overview.html.j2", context)


def _headline(content: DatasetContent, measured: Sequence[SequenceMetrics]) -> str:
    frames = sum(len(s) for s in measured)
    seconds = sum(len(s) / s.fps for s in measured)
    subjects = len({s.subject for s in measured})
    objects = len({s.object_ for s in measured if s.object_})
    parts = [
        _counted(len(measured), "sequence"),
        _counted(frames, "frame"),
        f"{seconds / 60:.1f} minutes" if seconds >= 120 else f"{seconds:.1f} seconds",
        _counted(subjects, "subject"),
        _counted(objects, "object") if objects else "people alone",
    ]
    imported = sum(bool(s.made_by) for s in measured)
    if imported:
        parts.append(f"{imported} with imported results")
    if content.failed:
        parts.append(f"{len(content.failed)} failed")
    return ", ".join(parts)


def _tiles(measured: Sequence[SequenceMetrics]) -> list[dict[str, str]]:
    tiles = []
    if any(s.has_truth for s in measured):
        joint = figures.truth_figures(measured, "joint")
        for key, name, unit, digits, note in (
            ("body_pve_mm", "body error", "mm", 1, "mean over vertices, against ground truth"),
            ("object_translation_mm", "object error", "mm", 1, "median of the centre"),
            ("object_rotation_deg", "object rotation error", "°", 2, "median"),
            (
                "contact_region_f1", "contact, F1 by region", "", 2,
                "of the body, against ground truth",
            ),
            ("contact_f1", "contact, F1 by vertex", "", 2, "at 4.5 mm, against ground truth"),
        ):  # fmt: skip
            if key in joint:
                worst, error = _worst_object(measured, key) if key.startswith("object") else ("", 0)
                if worst:
                    value = tile("", error, unit, "", digits)["value"]
                    note += f"; worst: {worst}, {value if np.isfinite(error) else 'lost'}"
                tiles.append(tile(name, joint[key], unit, note, digits))
    inside = {part: f"; {n} of {all_} true errors in range"
              for part, n, all_ in measures.covered(measured)}  # fmt: skip
    tiles += [
        tile(f"{part}, estimated error", value, "mm", f"without ground truth{inside.get(part, '')}")
        for part, value in mean_stated(measured).items()
    ]
    return tiles + measures.quality_tiles(measured)


def _worst_object(measured: Sequence[SequenceMetrics], key: str) -> tuple[str, float]:
    """Return name and value of the object with the largest error; "" if there is only one."""
    by_object: dict[str, list[SequenceMetrics]] = {}
    for s in measured:
        if s.has_truth and s.has_object:
            by_object.setdefault(s.object_, []).append(s)
    if len(by_object) < 2:
        return "", 0.0
    errors = {
        name: figures.truth_figures(some, "joint").get(key, np.inf)
        for name, some in by_object.items()
    }
    return max(errors.items(), key=lambda item: item[1])


def _rows(content: DatasetContent) -> list[dict[Hashable, Any]]:
    """Return the records of the table of sequences with percentages and addresses of pages."""
    return [
        record
        | {
            **{
                f"flagged_{part}": 100 * record[f"flagged.{part}_frames"] / record["frames"]
                for part in PARTS
            },
            "contact": 100 * record["contact_frames"] / record["frames"],
            "page": content.page_of[record["sequence"]],
            "preview": content.page_of[record["sequence"]].replace("index.html", PREVIEW),
        }
        for record in content.table.to_dict("records")
    ]


def _counts(measured: Sequence[SequenceMetrics]) -> dict[str, Any]:
    """Count sequences by subject (rows) and object (columns), as in the paper's table."""
    subjects = sorted({s.subject for s in measured})
    objects = sorted({s.object_ for s in measured})
    count = np.zeros((len(subjects), len(objects)), int)
    for s in measured:
        count[subjects.index(s.subject), objects.index(s.object_)] += 1
    return {
        "objects": [name or "alone" for name in objects],
        "rows": [
            {"subject": subject, "cells": row.tolist(), "all": int(row.sum())}
            for subject, row in zip(subjects, count, strict=True)
        ],
        "all": [*count.sum(0).tolist(), int(count.sum())],
    }


def _printed(table: pd.DataFrame) -> dict[str, Any]:
    """Format the columns of interest: heads with units, and cells."""
    shown = [str(name) for name in table if "." not in str(name) or name in _FIGURES]
    cells = [
        [_text(value) for value in row] for row in table[shown].itertuples(index=False, name=None)
    ]
    return {
        "heads": [_label(name) for name in shown],
        "rows": cells,
        "left_out": len(table.columns) - len(shown),
    }


def _label(column: str) -> tuple[str, str]:
    """Return label and unit of a column."""
    if column in _FIGURES:
        return _FIGURES[column]
    for ending, unit in (("_mm", "mm"), ("_ms", "ms"), ("_percent", "%")):
        if column.endswith(ending):
            return column.removesuffix(ending).replace("_", " "), unit
    return column.replace("_", " "), ""


def _text(value: object) -> str:
    """Format a cell; a dash if its value is unknown."""
    if value is None or value == "" or (isinstance(value, float) and not np.isfinite(value)):
        return "–"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.2f}" if abs(value) < 1 else f"{value:.1f}"  # shares as well


def _heat(content: DatasetContent) -> dict[str, Any]:
    stops = ", ".join(
        f"{css(colour)} {100 * at:g}%" for colour, at in zip(COLOUR_STOPS, STOP_AT, strict=True)
    )
    return {
        "gradient": f"linear-gradient(90deg, {stops})",
        "body_frames": content.body_frames,
        "common": content.common_scale,
        "surfaces": list(content.surfaces),
        "objects": list(content.objects),
    }


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
