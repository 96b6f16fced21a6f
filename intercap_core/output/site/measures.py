"""Measures on the pages: truth, penetration, distances to clouds, cameras, estimated errors.

Errors are estimated without truth by :mod:`intercap_core.evaluation.verdict`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from intercap_core.evaluation import contact_figures, figures
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.physics.figures import physics_figures
from intercap_core.evaluation.physics.rest_test import RELEASED_FRAMES
from intercap_core.evaluation.summary import SequenceSummary
from intercap_core.evaluation.verdict.figures import StatedError, held_out_cameras, stated_errors
from intercap_core.flags import OF_OBJECT, PARTS
from intercap_core.output.site import charts
from intercap_core.output.site.embed import tile
from intercap_core.stage_list import ESTIMATES

_MAX_CAMERA_ROWS = 40
_PUBLISHED_CLOUD_MM = (20.29, 18.50)  # body and object, InterCap paper, Experiments
_NAMES = {"object_track": "object track", "body_fit": "body fit", "joint": "joint"}
# key, label, digits, True if larger is better (None: neither)
_TRUTH_ROWS: tuple[tuple[str, str, int, bool | None], ...] = (
    ("body_pve_mm", "body, per vertex, mm", 1, False),
    ("body_mpjpe_mm", "body, 22 joints, mm", 1, False),
    ("hand_mpjpe_mm", "hands, joints and tips, mm", 1, False),
    ("hand_grasp_mpjpe_mm", "hands while touching, mm", 1, False),
    ("hand_mpjpe_wrist_mm", "hands, wrists aligned, mm", 1, False),
    ("object_translation_mm", "object, centre of mass, median, mm", 1, False),
    ("object_translation_p95_mm", "object, centre of mass, 95th percentile, mm", 1, False),
    ("object_rotation_deg", "object, rotation, median, degrees", 2, False),
    ("object_rotation_p95_deg", "object, rotation, 95th percentile, degrees", 2, False),
    ("lost_share", "object lost (50 mm or 20 degrees), share", 3, False),
    ("lost_unnoticed_share", "object lost and not flagged, share", 3, False),
    ("first_frame_success", "first seen frame found (20 mm, 10 degrees), share", 2, True),
    ("contact_region_f1", "contact by region, F1", 3, True),
    ("contact_f1", "contact by vertex at 4.5 mm, F1", 3, True),
    ("contact_recall", "frames in contact found, share", 3, True),
    ("acceleration_body_mm", "acceleration error, body, mm/frame² at 30 fps", 2, False),
    ("acceleration_hands_mm", "acceleration error, hands, mm/frame²", 2, False),
    ("acceleration_object_mm", "acceleration error, object, mm/frame²", 2, False),
    ("rest_jitter_mm", "jitter while the object rests, mm", 2, False),
    ("rest_jitter_deg", "jitter of the rotation while the object rests, degrees", 2, False),
    ("motion_onset_frames", "start of motion, absolute error, frames", 1, False),
    ("motion_onset_late_frames",
     "start of motion, signed error (late is positive), frames", 1, None),
    ("joint_normalised_median",
     "error over its standard deviation, joints (calibrated: 1)", 2, None),
    ("object_normalised_median",
     "error over its standard deviation, object (calibrated: 1)", 2, None),
)  # fmt: skip


def truth(sequences: Sequence[SequenceMetrics]) -> dict[str, Any] | None:
    """Return the table of errors against truth by stage; None without truth."""
    known = [s for s in sequences if s.has_truth]
    if not known:
        return None
    by_stage = {stage: figures.truth_figures(known, stage) for stage in ESTIMATES}
    rows = []
    for key, name, digits, more in _TRUTH_ROWS:
        values = [by_stage[stage].get(key) for stage in ESTIMATES]
        known_values = [v for v in values if v is not None]
        if not known_values:
            continue
        printed = ["" if v is None else f"{v:.{digits}f}" for v in values]
        best = None
        if more is not None and len({*printed} - {""}) > 1:
            best = max(known_values) if more else min(known_values)
        is_best = [v is not None and v == best for v in values]
        rows.append((name, list(zip(printed, is_best, strict=True))))
    depth = figures.pooled(known, "truth/penetration_mean")
    touching = figures.pooled(known, "truth/contact_frame")
    own = None
    if depth is not None and touching is not None and touching.any():
        own = 1e3 * float(depth[touching].mean())
    return {
        "sequences": len(known),
        "frames": sum(len(s) for s in known),
        "stages": [_NAMES[stage] for stage in ESTIMATES],
        "rows": rows,
        "flags": figures.flag_figures(known),
        "own_penetration": own,
        "sweep": _sweep(known),
        "reliability": _reliability(known),
    }


def _sweep(known: Sequence[SequenceMetrics]) -> str:
    """Plot F1 of contact by vertex over the distance below which a vertex counts as touching."""
    lines = []
    for stage, colour in (("body_fit", "c2"), ("joint", "c1")):
        f1 = figures.contact_sweep(known, stage)
        if f1 and np.isfinite(list(f1.values())).all():
            x, y = np.array(list(f1)), np.array(list(f1.values()))
            lines.append(charts.Series(_NAMES[stage], colour, x, y))
    if not lines:
        return ""
    axes = ("threshold, mm", 0, 30), ("F1 of body vertices", 0, 1)
    return charts.line_chart(lines, *axes, marks=((4.5, "4.5 mm"),))


def _reliability(known: Sequence[SequenceMetrics]) -> str:
    """Plot the share of true contact over the estimated probability of contact."""
    table = contact_figures.contact_reliability(known)
    if table is None or len(table.count) < 2:
        return ""
    lines = [
        charts.Series("joint", "c1", table.stated, table.true),
        charts.Series("calibrated", "c2", np.array([0.0, 1.0]), np.array([0.0, 1.0])),
    ]
    axes = ("estimated probability of contact", 0, 1), ("share of true contact", 0, 1)
    return charts.line_chart(lines, *axes)


def penetration(sequences: Sequence[SequenceMetrics]) -> dict[str, Any] | None:
    """Return histogram, cumulative curve and figures over contact frames; None without objects."""
    touching = figures.pooled(sequences, "contact_frame")
    if touching is None:
        return None
    deepest, bin_mm = 30.0, 1.0
    edges = np.arange(0, deepest + bin_mm / 2, bin_mm)
    lines, shares, tallest = [], [], 1.0
    for name, colour in (("max", "c2"), ("mean", "c1"), ("median", "c3")):
        values = figures.pooled(sequences, f"penetration_{name}")
        assert values is not None
        depth = 1e3 * values[touching].astype(np.float64)
        counts = np.histogram(np.clip(depth, 0, deepest), edges)[0].astype(float)
        tallest = max(tallest, float(counts.max()))
        outline = np.repeat(counts, 2)
        lines.append(charts.Series(name, colour, np.repeat(edges, 2)[1:-1], outline))
        grid = np.linspace(0, deepest, 121)
        share = np.array([(depth <= g).mean() if len(depth) else 0.0 for g in grid])
        shares.append(charts.Series(name, colour, grid, 100 * share))
    return {
        **figures.penetration_figures(sequences),
        "frames": int(touching.sum()),
        "bin": f"{bin_mm:g}",
        "histogram": charts.line_chart(
            lines,
            ("penetration depth, mm (last bin: all larger)", 0, deepest),
            ("contact frames", 0, 1.08 * tallest),
        ),
        "cumulative": charts.line_chart(
            shares,
            ("penetration depth, mm", 0, deepest),
            ("contact frames, %", 0, 100),
            marks=((5, "5"), (7, "7"), (20, "20")),
        ),
    }


def quality_tiles(sequences: Sequence[SequenceMetrics]) -> list[dict[str, str]]:
    """Return the tiles of penetration, rest test, distances to the point clouds, and flags.

    Tiles of the object are omitted without an object.
    """
    parts, tiles = ["body"], []
    if any(s.has_object for s in sequences):
        parts.append("object")
        depth = figures.penetration_figures(sequences).get("mean_mm")
        tiles.append(tile("penetration", depth, "mm", "mean over contact frames"))
    released = physics_figures(sequences)
    if "displacement_mm" in released:
        note = (
            f"mean over {released['releases']} releases at rest, {RELEASED_FRAMES} simulated "
            f"frames; unsupported in {100 * released['unsupported_share']:.0f} % of the frames"
        )
        tiles.append(tile("object moves when released", released["displacement_mm"], "mm", note))
    cloud = figures.cloud_figures(sequences)
    for part in parts:
        distance = cloud[f"{part}_visible_mm"]
        tiles.append(tile(f"{part} to point cloud", distance, "mm", "visible surface"))
    shares = {part: 100 * share for part, share in figures.pooled_flags(sequences).shares().items()}
    others = ", ".join(
        f"{part} {shares[part]:.0f} %"
        for part in PARTS[1:]
        if "object" in parts or part not in OF_OBJECT
    )
    note = f"unreliable: {others}"
    return [*tiles, tile("frames with unreliable body", shares["body"], "%", note)]


def accelerations(sequences: Sequence[SequenceMetrics]) -> str:
    """Plot the cumulative distribution of accelerations; "" if there are none."""
    sorted_mm = {}
    for name in ("body", "object"):
        values = figures.pooled(sequences, f"acceleration_{name}")
        known = np.zeros(0) if values is None else 1e3 * values[np.isfinite(values)]
        if len(known):
            sorted_mm[name] = np.sort(known.astype(np.float64))
    if not sorted_mm:
        return ""
    top = max(5.0, *(float(np.quantile(values, 0.99)) for values in sorted_mm.values()))
    grid = np.linspace(0, top, 121)
    lines = []
    for name, known in sorted_mm.items():
        share = 100 * np.searchsorted(known, grid, "right") / len(known)
        lines.append(charts.Series(name, {"body": "c1", "object": "c2"}[name], grid, share))
    axes = ("acceleration, mm/frame² at 30 fps", 0, top), ("frames, %", 0, 100)
    return charts.line_chart(lines, *axes)


def clouds(dataset: str, sequences: Sequence[SequenceMetrics]) -> list[dict[str, Any]]:
    """Return rows of distances to the clouds, millimetres: measured, and references.

    The reference is the distance of the true surfaces, or the published figure of real recordings
    if no sequence is virtual.
    """
    names = ("body_mm", "object_mm", "body_visible_mm", "object_visible_mm")
    measured = figures.cloud_figures(sequences)
    floor = figures.floor_figures(sequences)
    rows = [{"name": dataset, "cells": [measured[n] for n in names], "reference": False}]
    if floor:
        cells = [floor.get(n) for n in names]
        rows.append(
            {"name": "ground-truth surfaces (noise floor)", "cells": cells, "reference": True}
        )
    if not any(s.has_truth for s in sequences):
        published = [*_PUBLISHED_CLOUD_MM, None, None]
        rows.append({"name": "InterCap, as published", "cells": published, "reference": True})
    return rows


def median_residuals(pairs: Sequence[tuple[str, float, float]]) -> tuple[float, float]:
    """Return medians before and after refinement over the pairs of cameras that have both.

    NaN if there is none. ``pairs``: name, and residual before and after refinement.
    """
    known = np.array([pair[1:] for pair in pairs if np.isfinite(pair[1:]).all()])
    before, after = np.median(known, axis=0) if len(known) else (np.nan, np.nan)
    return float(before), float(after)


def cameras(
    sequences: Sequence[SequenceMetrics],
    residuals: Mapping[str, Sequence[tuple[str, float, float]]],
) -> dict[str, Any]:
    """Return residuals before and after refinement: by pair for one sequence, else by sequence.

    Args:
        residuals: by sequence (name of the pair, before, after) of each pair of cameras, metres.
    """
    if len(residuals) == 1:
        rows = [(n, 1e3 * a, 1e3 * b) for n, a, b in next(iter(residuals.values()))]
    else:
        medians = {name: median_residuals(pairs) for name, pairs in residuals.items()}
        rows = [(name, 1e3 * before, 1e3 * after) for name, (before, after) in medians.items()]
        rows.sort(key=lambda row: -np.nan_to_num(row[2], nan=-1.0))
    note = "Worst first." if len(rows) > 3 else ""
    if len(rows) > _MAX_CAMERA_ROWS:
        note = f"The {_MAX_CAMERA_ROWS} worst of {len(rows)}; all are in tables/sequences.csv."
    bars = [charts.BarPair.change(*row) for row in rows[:_MAX_CAMERA_ROWS]]
    return {
        "chart": charts.bar_pairs(bars, "residual, mm") if bars else "",
        "note": note,
        "truth": figures.extrinsics_figures(sequences) or None,
    }


# label, unit and digits of IMAGE_MEASURES
_VIEWS = (
    ("keypoints", "px", 1), ("person's points", "mm", 1), ("object's mask", "IoU", 2),
    ("object's depth", "mm", 1),
)  # fmt: skip


def verdict(sequences: Sequence[SequenceMetrics], shown: set[str]) -> dict[str, Any] | None:
    """Return the variables of the template verdict.html.j2; None if no sequence was judged.

    Args:
        shown: names of the sequences whose cameras are listed.
    """
    judged = [s for s in sequences if "verdict/error" in s.values]
    if not judged:
        return None
    by_sequence = [(s, stated_errors(s)) for s in judged]
    parts = list(dict.fromkeys(e.part for _, errors in by_sequence for e in errors))
    return {
        "parts": parts,
        "truth": any(s.has_truth for s in judged),
        "rows": [
            {
                "sequence": s.name,
                "errors": [next((e for e in errors if e.part == part), None) for part in parts],
                "silent": "; ".join(dict.fromkeys(e.silent for e in errors if e.silent)),
            }
            for s, errors in by_sequence
        ],
        "range": error_range,
        "views": [{"name": name, "unit": unit} for name, unit, _ in _VIEWS],
        "cameras": [
            {
                "camera": held.camera,
                "views": [
                    {"pair": pair, "digits": digits}
                    for *pair, (_, _, digits) in zip(
                        held.held_in, held.held_out, _VIEWS, strict=True
                    )
                ],
                "shift": list(held.shift_mm.values()),
            }
            for s in judged
            if s.name in shown
            for held in held_out_cameras(s)
        ],
        "covered": covered(judged),
    }


def covered(sequences: Sequence[SequenceMetrics]) -> list[tuple[str, int, int]]:
    """Return part, number of true errors inside the estimated range, and number of both known."""
    known: dict[str, list[bool]] = {}
    for error in (e for s in sequences for e in stated_errors(s)):
        if np.isfinite(error.stated) and np.isfinite(error.true):
            known.setdefault(error.part, []).append(error.covers)
    return [(part, sum(inside), len(inside)) for part, inside in known.items()]


def error_range(error: StatedError) -> str:
    """Format the range of an estimated error, millimetres; a dash if none is stated."""
    if not np.isfinite(error.stated):
        return "–"
    return f"{error.stated / error.factor:.1f}–{error.stated * error.factor:.1f}"


def made_by_stage(
    summaries: Sequence[SequenceSummary],
) -> dict[str, list[tuple[int, str, list[str]]]]:
    """Return schema version, digest of settings and names of sequences by stage, most names first.

    Several entries of a stage are a mixture.
    """
    made: dict[str, dict[tuple[int, str], list[str]]] = {}
    for s in summaries:
        for stage, version in s.made_by.items():
            made.setdefault(stage, {}).setdefault(version, []).append(s.name)
    return {
        stage: sorted(((*key, names) for key, names in by.items()), key=lambda e: -len(e[2]))
        for stage, by in made.items()
    }
