"""Which of several calibrations belongs to a recording, by how well its depth images agree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.intercap import InterCapLayout
from intercap_core.geometry.camera.clouds import master_points
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply, invert

IMAGES = 7  # of each camera, spread over the recording: their median is the static background
STEP = 4  # of the pixels that are compared, in rows and columns
FAR_M = 0.3  # a surface this far off is another one, which hides the point from one camera
MIN_POINTS = 500  # that two cameras must share
CLEARLY = 0.9  # the best residual is at most this share of the next
SAME_POSE = 1e-3  # metres or radians: two calibrations say the same about a pair of cameras


@dataclass(frozen=True)
class Choice:
    """``best`` of the calibrations, None = cannot be told; ``residual_m``: of each."""

    best: str | None
    residual_m: dict[str, float]


def choose_calibration(sequence: SequenceEntry, calibrations: Mapping[str, Path]) -> Choice:
    """Compare the calibration folders on the background depth of one recording.

    Only pairs of cameras are looked at to which two calibrations give different relative poses.
    The residual is the median distance along the ray between a camera's points and the surface
    that the other measured, averaged over the pairs. Calibrations and cameras that cannot be read
    are left out.
    """
    rigs: dict[str, dict[str, Camera]] = {}
    depths: dict[str, np.ndarray] = {}
    for name, folder in calibrations.items():
        row = sequence.model_copy(update={"calibration": folder})
        try:
            rigs[name] = _cameras(row, depths)
        except UserError:
            continue
    shared = set.intersection(*(set(rig) for rig in rigs.values())) if rigs else set()
    pairs = [
        (a, b) for a, b in permutations(sorted(shared & set(depths)), 2) if _differ(rigs, a, b)
    ]
    residuals = {}
    for name, rig in rigs.items():
        found = [_residual(rig[a], rig[b], depths[a], depths[b]) for a, b in pairs]
        if any(np.isfinite(found)):
            residuals[name] = float(np.nanmean(found))
    order = sorted(residuals, key=lambda name: residuals[name])
    decided = len(order) > 1 and residuals[order[0]] <= CLEARLY * residuals[order[1]]
    return Choice(order[0] if decided else None, residuals)


def _cameras(row: SequenceEntry, depths: dict[str, np.ndarray]) -> dict[str, Camera]:
    """The cameras with depth of one calibration; background depth is added to ``depths`` once."""
    layout = InterCapLayout(row)
    cameras = {}
    for name in layout.names:
        if name not in layout.extrinsics.master_from_colour:
            continue
        try:
            with layout.open(name) as recording:
                if recording.camera.depth is None:
                    continue
                cameras[name] = recording.camera
                if name not in depths:
                    depths[name] = _background(recording.sample_depth(IMAGES))
        except UserError:
            continue
    return cameras


def _background(images: list[np.ndarray]) -> np.ndarray:
    """Median (H, W) uint16 over images of the values that are there; 0 = none."""
    stack = np.sort(np.stack(images) - np.uint16(1), axis=0)  # 0 wraps to the largest value
    known = (stack < 65535).sum(axis=0)
    middle = np.take_along_axis(stack, np.maximum(known - 1, 0)[None] // 2, axis=0)[0]
    return np.where(2 * known > len(images), middle + np.uint16(1), 0).astype(np.uint16)


def _differ(rigs: Mapping[str, dict[str, Camera]], a: str, b: str) -> bool:
    """Whether two calibrations place camera b differently as camera a sees it."""
    poses = [invert(r[a].master_from_colour) @ r[b].master_from_colour for r in rigs.values()]
    return any(np.abs(pose - poses[0]).max() > SAME_POSE for pose in poses[1:])


def _residual(a: Camera, b: Camera, depth_a: np.ndarray, depth_b: np.ndarray) -> float:
    """Median distance, metres, of what a sees to what b measured; NaN = no overlap."""
    lens = b.depth
    assert lens is not None
    thinned = np.zeros_like(depth_a)
    thinned[::STEP, ::STEP] = depth_a[::STEP, ::STEP]
    points = apply(b.depth_from_master, master_points(thinned, a).points)
    points = points[lens.sees(points)]
    column, row = np.rint(lens.project(points)).astype(np.int64).T
    measured = depth_b[np.minimum(row, lens.height - 1), np.minimum(column, lens.width - 1)] * 1e-3
    distance = np.abs(measured - points[:, 2])[measured > 0]
    near = distance[distance < FAR_M]
    return float(np.median(near)) if len(near) >= MIN_POINTS else np.nan
