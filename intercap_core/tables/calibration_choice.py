"""Choice of the calibration that belongs to a recording, by the agreement of its depth images."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations
from pathlib import Path

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.intercap import InterCapLayout
from intercap_core.geometry.camera.clouds import master_points
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply, invert


def choose_calibration(
    sequence: SequenceEntry, calibrations: Mapping[str, Path]
) -> tuple[str | None, dict[str, float]]:
    """Compare the calibration folders on the background depth of one recording.

    Only pairs of cameras to which two calibrations give different relative poses are compared. One
    camera's background points are transformed to the other camera; a point's error is the
    difference of its depth from the depth that the other camera measured there. The residual is
    the median error, averaged over the pairs. The best residual must be at most 90 % of the next.
    Calibrations and cameras that cannot be read are left out.

    Returns:
        The name of the calibration whose residual is clearly the smallest, None if there is none;
        and the residual of each calibration that could be compared, metres.
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
        distances = [_residual(rig[a], rig[b], depths[a], depths[b]) for a, b in pairs]
        if any(np.isfinite(distances)):
            residuals[name] = float(np.nanmean(distances))
    order = sorted(residuals, key=lambda name: residuals[name])
    decided = len(order) > 1 and residuals[order[0]] <= 0.9 * residuals[order[1]]
    return order[0] if decided else None, residuals


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
                    depths[name] = _background(recording.sample_depth(7))
        except UserError:
            continue
    return cameras


def _background(images: list[np.ndarray]) -> np.ndarray:
    """Median depth (H, W) uint16 of pixels that most images measured, otherwise 0."""
    stack = np.sort(np.stack(images) - np.uint16(1), axis=0)  # 0 wraps to the largest value
    known = (stack < 65535).sum(axis=0)
    middle = np.take_along_axis(stack, np.maximum(known - 1, 0)[None] // 2, axis=0)[0]
    return np.where(2 * known > len(images), middle + np.uint16(1), 0).astype(np.uint16)


def _differ(rigs: Mapping[str, dict[str, Camera]], a: str, b: str) -> bool:
    """Whether two calibrations differ in the pose of camera b relative to camera a."""
    poses = [invert(r[a].master_from_colour) @ r[b].master_from_colour for r in rigs.values()]
    return any(np.abs(pose - poses[0]).max() > 1e-3 for pose in poses[1:])


def _residual(a: Camera, b: Camera, depth_a: np.ndarray, depth_b: np.ndarray) -> float:
    """Median difference, metres, of the depth of points of a and the depth measured by b.

    NaN if fewer than 500 points can be compared.
    """
    lens = b.depth
    assert lens is not None
    thinned = np.zeros_like(depth_a)
    thinned[::4, ::4] = depth_a[::4, ::4]  # one pixel of 16 is enough
    points = apply(b.depth_from_master, master_points(thinned, a).points)
    points = points[lens.sees(points)]
    column, row = np.rint(lens.project(points)).astype(np.int64).T
    measured = depth_b[np.minimum(row, lens.height - 1), np.minimum(column, lens.width - 1)] * 1e-3
    distance = np.abs(measured - points[:, 2])[measured > 0]
    near = distance[distance < 0.3]  # metres; beyond that, b sees another surface
    return float(np.median(near)) if len(near) >= 500 else np.nan
