"""Cameras whose lenses were exchanged in a calibration, found by reprojection.

Each pair's exchange is one hypothesis: it shifts the expected pixels of both cameras by a known
pattern. What it gains is the likelihood of the keypoints' residuals with the pattern over that
without, where the body's points, the cameras' poses as far as they are uncertain, and each
keypoint's constant error in each view are integrated out. A wrong principal point looks like a
turned camera, so the verdict is as good as the poses are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from intercap_core.camera import projection
from intercap_core.camera.rig import Rig
from intercap_core.camera.transforms import apply
from intercap_core.scene.keypoint_motion import Motion, build_motion
from intercap_core.scene.keypoint_timing import (
    MIN_SETS,
    noise_of,
    pose_columns,
    precisions,
    series_of,
    windows,
)

VIEW_BIAS = 2.0  # variance of a keypoint's constant error in a view, of its other errors'
MIN_GAIN = 45.0  # log likelihood; what hidden joints and tails bring by chance stays well below
FIT_RANGE = (0.5, 1.5)  # how much of the pattern must be there


@dataclass(frozen=True)
class LensPair:
    """Cameras ``first`` and ``second`` have each other's lenses; ``gain`` in log likelihood,
    ``share`` of the exchange's pattern that the residuals hold."""

    first: int
    second: int
    gain: float
    share: float


def swapped_lenses(
    keypoints: np.ndarray,
    rig: Rig,
    times: np.ndarray,
    *,
    rotation_sigma: float,
    translation_sigma: float,
) -> list[LensPair]:
    """The pairs whose colour lenses should be exchanged; each camera at most once.

    ``keypoints`` (T, C, 135, 3) x, y, confidence of the subject by moment, slips put right;
    ``times`` (T,) s; ``rotation_sigma`` rad and ``translation_sigma`` m about each axis: how well
    the poses are known.
    """
    pairs = lens_gains(
        keypoints, rig, times, rotation_sigma=rotation_sigma, translation_sigma=translation_sigma
    )
    chosen: list[LensPair] = []
    for pair in sorted(pairs, key=lambda p: -p.gain):
        used = {c for other in chosen for c in (other.first, other.second)}
        good = pair.gain >= MIN_GAIN and FIT_RANGE[0] <= pair.share <= FIT_RANGE[1]
        if good and not used & {pair.first, pair.second}:
            chosen.append(pair)
    return chosen


def lens_gains(
    keypoints: np.ndarray,
    rig: Rig,
    times: np.ndarray,
    *,
    rotation_sigma: float,
    translation_sigma: float,
) -> list[LensPair]:
    """What each exchange of two unlike lenses for images of one size would gain."""
    size = [(camera.colour.width, camera.colour.height) for camera in rig]
    lenses = rig.colour_parameters
    orders = [
        (a, b)
        for a in range(len(rig))
        for b in range(len(rig))
        if a != b and size[a] == size[b] and not np.array_equal(lenses[a], lenses[b])
    ]
    if not orders or len(times) < MIN_SETS:
        return []
    motion = build_motion(keypoints, rig, times)
    whole = np.where(motion.seen[..., None], motion.residual + motion.bias, 0.0)
    patterns = [motion.projected_of(a, _with_lens(motion, a, b)) for a, b in orders]
    columns = np.concatenate([np.stack(patterns), pose_columns(motion)])
    matrix, vector = _normal_equations(motion, whole, columns)
    number = len(orders)
    prior = np.diag(
        np.tile(np.repeat([rotation_sigma**-2.0, translation_sigma**-2.0], 3), len(rig))
    )
    solved = np.linalg.solve(matrix[number:, number:] + prior, matrix[number:, :number])
    matrix = matrix[:number, :number] - matrix[:number, number:] @ solved
    vector = vector[:number] - solved.T @ vector[number:]
    place = {order: i for i, order in enumerate(orders)}
    found = []
    for a, b in orders:
        if a < b:
            both = [place[a, b], place[b, a]]
            linear = float(vector[both].sum())
            energy = max(float(matrix[np.ix_(both, both)].sum()), 1e-12)
            found.append(LensPair(a, b, linear - energy / 2, linear / energy))
    return found


def _with_lens(motion: Motion, camera: int, other: int) -> np.ndarray:
    """By how much (T, K, 2) px the points move in a ``camera`` with the ``other``'s lens."""
    in_camera = apply(motion.rig[camera].colour_from_master, np.nan_to_num(motion.paths.points))
    lenses = motion.rig.colour_parameters
    moved = projection.project(in_camera, lenses[other]) - projection.project(
        in_camera, lenses[camera]
    )
    return np.where(motion.seen[:, camera, :, None], moved, 0.0)


def _normal_equations(
    motion: Motion, residual: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (n, n) and vector (n,) of ``columns`` (n, T, K, 2C) against pixels (T, C, K, 2)."""
    noise = replace(noise_of(motion), constant=VIEW_BIAS)
    series = series_of(motion.projected(residual))
    size = len(columns)
    matrix, vector = np.zeros((size, size)), np.zeros(size)
    parts = windows(len(motion.times))
    for part in parts:
        precision = precisions(motion, noise, part) / len(parts)  # the constant part is shared
        for k in range(len(precision)):
            for c in np.flatnonzero(motion.valid[part, :, k].any(0)):
                both = slice(2 * c, 2 * c + 2)
                rows = columns[:, part, k, both].transpose(2, 1, 0)
                weighted = precision[k, c] @ rows
                matrix += (np.swapaxes(rows, 1, 2) @ weighted).sum(0)
                vector += np.einsum("xtn,xt->n", weighted, series[k, both, part])
    return matrix, vector
