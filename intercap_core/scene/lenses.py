"""Cameras whose lenses were exchanged in a calibration, found by reprojection.

Each pair's exchange is one hypothesis: it shifts the expected pixels of both cameras by a known
pattern. What it gains is the likelihood of the keypoints' residuals with the pattern over that
without, where the body's points, the cameras' poses as far as they are uncertain, and each
keypoint's constant error in each view are integrated out. A wrong principal point looks like a
turned camera, so the verdict is as good as the poses are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.camera import projection
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.scene.constants import (
    LENS_FIT_RANGE,
    MIN_LENS_GAIN,
    MIN_TIMING_SETS,
    VIEW_BIAS_VARIANCE,
)
from intercap_core.scene.keypoint_motion import Motion, build_motion
from intercap_core.scene.keypoint_timing import CLUSTER, keypoint_equations, pose_columns


@dataclass(frozen=True)
class LensPair:
    """Cameras ``first`` and ``second`` have each other's lenses; ``gain`` in log likelihood, less
    where the keypoints disagree by more than their noise; ``share`` of the exchange's pattern that
    the residuals hold."""

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
        good = pair.gain >= MIN_LENS_GAIN and LENS_FIT_RANGE[0] <= pair.share <= LENS_FIT_RANGE[1]
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
    if not orders or len(times) < MIN_TIMING_SETS:
        return []
    motion = build_motion(keypoints, rig, times)
    whole = np.where(motion.seen[..., None], motion.residual + motion.bias, 0.0)
    patterns = [motion.projected_of(a, _with_lens(motion, a, b)) for a, b in orders]
    columns = np.concatenate([np.stack(patterns), pose_columns(motion)])
    matrices, vectors = keypoint_equations(motion, whole, columns, constant=VIEW_BIAS_VARIANCE)
    number = len(orders)
    prior = np.tile(np.repeat([rotation_sigma**-2.0, translation_sigma**-2.0], 3), len(rig))
    matrix, vector = matrices.sum(0), vectors.sum(0)
    poses = np.linalg.inv(matrix[number:, number:] + np.diag(prior))
    place = {order: i for i, order in enumerate(orders)}
    found = []
    for a, b in orders:
        if a > b:
            continue
        pattern = np.zeros(len(matrix))
        pattern[[place[a, b], place[b, a]]] = 1.0
        # The part of the pattern that no poses explain, and the poses beside a share of it.
        pattern[number:] = -poses @ (matrix @ pattern)[number:]
        energy = float(pattern @ matrix @ pattern + prior @ pattern[number:] ** 2) + 1e-12
        linear = float(pattern @ vector)
        fitted = pattern * linear / energy
        fitted[number:] += poses @ vector[number:]
        scores = (vectors - matrices @ fitted) @ pattern
        disagreement = float((np.bincount(CLUSTER, scores) ** 2).sum()) / energy
        gain = (linear - energy / 2) / max(1.0, disagreement)
        found.append(LensPair(a, b, gain, linear / energy))
    return found


def _with_lens(motion: Motion, camera: int, other: int) -> np.ndarray:
    """By how much (T, K, 2) px the points move in a ``camera`` with the ``other``'s lens."""
    in_camera = apply(motion.rig[camera].colour_from_master, np.nan_to_num(motion.paths.points))
    lenses = motion.rig.colour_parameters
    moved = projection.project(in_camera, lenses[other]) - projection.project(
        in_camera, lenses[camera]
    )
    return np.where(motion.seen[:, camera, :, None], moved, 0.0)
