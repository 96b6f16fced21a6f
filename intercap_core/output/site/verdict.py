"""The page's section on the verdict without truth: stated errors, and what each camera says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import StatedError, stated_errors, verdict_figures

# dataset, what it is, scale to the unit that is printed, digits
_VIEWS: tuple[tuple[str, str, str, float, int], ...] = (
    ("keypoint_px", "keypoints", "px", 1.0, 1),
    ("person_m", "person's points", "mm", 1e3, 1),
    ("overlap", "object's mask", "IoU", 1.0, 2),
    ("object_depth_m", "object's depth", "mm", 1e3, 1),
)


def context(sequences: Sequence[SequenceMetrics], shown: set[str]) -> dict[str, Any] | None:
    """What the template prints, cameras of the sequences ``shown`` alone; None where no sequence
    was judged."""
    judged = [s for s in sequences if "verdict/error" in s.values]
    if not judged:
        return None
    by_sequence = [(s, stated_errors(s)) for s in judged]
    parts = list(dict.fromkeys(e.part for _, errors in by_sequence for e in errors))
    return {
        "parts": parts,
        "truth": any(s.has_truth for s in judged),
        "rows": [_row(s.name, parts, errors) for s, errors in by_sequence],
        "views": [{"name": name, "unit": unit} for _, name, unit, _, _ in _VIEWS],
        "cameras": [
            camera
            for s in judged
            if s.name in shown and "verdict/held_camera" in s.values
            for camera in _cameras(s)
        ],
        "figures": verdict_figures(judged) or None,
    }


def _row(name: str, parts: Sequence[str], errors: Sequence[StatedError]) -> dict[str, Any]:
    found = {e.part: e for e in errors}
    silent = list(dict.fromkeys(e.silent for e in errors if e.silent))
    return {
        "sequence": name,
        "cells": [_cell(found.get(part)) for part in parts],
        "silent": "; ".join(silent),
    }


def _cell(error: StatedError | None) -> dict[str, Any]:
    if error is None:
        return {"stated": None, "range": "", "true": None, "repeated": None}
    known = {"true": error.true, "repeated": error.repeated}
    if not np.isfinite(error.stated):
        return {"stated": None, "range": "", **known}
    low, high = error.stated / error.factor, error.stated * error.factor
    return {"stated": error.stated, "range": f"{low:.1f}–{high:.1f}", **known}


def _cameras(s: SequenceMetrics) -> list[dict[str, Any]]:
    """A row for each camera that was held out."""
    values = s.values
    moved = np.sqrt(_mean(values["verdict/shift"] ** 2, axis=2))  # (P, C)
    rows = []
    for c, name in enumerate(values["verdict/camera_names"]):
        if not np.isfinite(moved[:, c]).any():
            continue
        held = values["verdict/held_camera"] == c
        cells = []
        for key, _, _, scale, digits in _VIEWS:
            pair = [
                scale * _median(values[f"verdict/{key}{end}"][held, c]) for end in ("", "_held_out")
            ]
            cells.append({"pair": pair, "digits": digits})
        rows.append(
            {
                "sequence": s.name,
                "camera": str(name),
                "views": cells,
                "shift": (1e3 * moved[:, c]).tolist(),
            }
        )
    return rows


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _mean(values: np.ndarray, axis: int) -> np.ndarray:
    """Over what is known; NaN where nothing is."""
    known = np.isfinite(values)
    total = np.where(known, values, 0).sum(axis=axis)
    return total / np.where(known.any(axis=axis), known.sum(axis=axis), np.nan)
