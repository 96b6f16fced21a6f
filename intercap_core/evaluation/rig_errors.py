"""Errors of found camera poses against truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.evaluation.scene_errors import displacement
from intercap_core.schemas import TRUTH


@dataclass(frozen=True, eq=False)
class RigErrors:
    """One calibration of one rig."""

    sequence: str
    evidence: str
    """Key of the figures: person_depth, person_colour or board."""
    error: np.ndarray
    """(C - 1,) displacement over a 2 m cube of the cameras but the master, metres; empty if the
    poses were not found."""
    sigma: np.ndarray
    """(C - 1,) estimated errors, metres: worst direction, at the rig's centre."""
    problem: str = ""
    """Why the poses were not found."""


def pose_errors(truth: Path, names: Sequence[str], poses: np.ndarray) -> np.ndarray:
    """Displacement (C - 1,) of all cameras but the first, metres.

    ``poses`` (C, 4, 4): found poses of the cameras ``names`` in the frame of the first.
    """
    with artefacts.read(truth, TRUTH) as true:
        known = true.text("camera_names")
        order = [known.index(name) for name in names]
        return displacement(poses, true["master_from_colour"][order], 0)[1:]


def figures(rigs: Sequence[RigErrors]) -> dict[str, float]:
    """Mean error by evidence, millimetres; share of rigs that were solved; error over estimate."""
    if not rigs:
        return {}
    found = {"solved_share": float(np.mean([len(r.error) > 0 for r in rigs]))}
    for evidence in dict.fromkeys(r.evidence for r in rigs):
        errors = np.concatenate([r.error for r in rigs if r.evidence == evidence])
        if len(errors):
            found[f"pose_{evidence}_mm"] = 1e3 * float(errors.mean())
    ratio = np.concatenate([r.error / r.sigma for r in rigs])
    if len(ratio):
        found["error_over_estimate_median"] = float(np.median(ratio))
        found["error_within_twice_estimate_share"] = float((ratio <= 2).mean())
    return found
