"""Detects and corrects cameras that were given each other's intrinsics.

In the InterCap release two sets of files have focal lengths and principal points of cameras 4 and 5
exchanged, but not the distortion. Two tests:

- Where depth lies on the colour grid, wrong intrinsics bend every measured surface. An exchange is
  accepted if it brings the backgrounds of both cameras much closer to the others'.
- Cameras without depth are tested by the keypoints. An exchange shifts the expected pixels of both
  cameras by a known pattern; its gain is a log likelihood ratio in which points, camera poses (as
  far as they are uncertain) and a constant error of each keypoint in each view are integrated out.
  A wrong principal point looks like a rotated camera, so the result is as good as the poses.

Devices that bring their own intrinsics are not tested.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from intercap_core.geometry.camera import projection
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.scene.background import Background
from intercap_core.scene.constraints import MIN_BODY_POINTS, BodyConstraint, body_views
from intercap_core.scene.keypoint_motion import KeypointMotion, build_motion
from intercap_core.scene.keypoint_timing import (
    CLUSTER,
    MIN_TIMING_SETS,
    keypoint_equations,
    pose_columns,
)
from intercap_core.scene.registration import STATIC, Registration, RigEstimate, SurfaceLayer
from intercap_core.scene.subject_views import SubjectViews
from intercap_core.scene.surfaces import background_surfaces

# Poses by a rig's own calibration, without what happened to the tripods since: for cameras whose
# lenses keypoints alone can judge. Tuned on the studio.
CALIBRATION_ROTATION_SIGMA = np.radians(0.3)
CALIBRATION_TRANSLATION_SIGMA_M = 0.006
VIEW_BIAS_VARIANCE = 2.0  # of a joint's constant error in a view, over its scatter's; tuned
MIN_LENS_GAIN = 15.0  # log likelihood; chance brings up to 9 on the studio
LENS_FIT_RANGE = (0.5, 1.5)  # how much of the exchange's pattern must be there; 1 is all of it
SUSPICIOUS = 1.3  # a camera's residuals over usual ones, else nothing is tried; tuned on the studio
MAX_SUSPECTS = 4  # every pair of them is tried
MUCH_BETTER = 0.8  # of the residuals with the lenses as given; tuned on the studio


@dataclass(frozen=True)
class LensPair:
    """Cameras ``first`` and ``second`` have each other's lenses; ``gain`` in log likelihood, less
    where the keypoints disagree by more than their noise; ``share`` of the exchange's pattern that
    the residuals hold."""

    first: int
    second: int
    gain: float
    share: float


def lenses_by_keypoints(
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
    patterns = [motion.projected_of(a, _lens_shift(motion, a, b)) for a, b in orders]
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


def _lens_shift(motion: KeypointMotion, camera: int, other: int) -> np.ndarray:
    """By how much (T, K, 2) px the points move in a ``camera`` with the ``other``'s lens."""
    in_camera = apply(motion.rig[camera].colour_from_master, np.nan_to_num(motion.paths.points))
    lenses = motion.rig.colour_parameters
    moved = projection.project(in_camera, lenses[other]) - projection.project(
        in_camera, lenses[camera]
    )
    return np.where(motion.seen[:, camera, :, None], moved, 0.0)


@dataclass(frozen=True)
class LensExchange:
    """Cameras ``first`` and ``second`` got each other's lens (``whole``) or all of it but the
    distortion; ``before`` and ``after``: median distance of their backgrounds to the other
    cameras', metres, NaN where keypoints decided."""

    first: int
    second: int
    whole: bool
    before: float
    after: float


def exchange_lenses(
    rig: Rig,
    backgrounds: Sequence[Background | None],
    subject: SubjectViews,
    times: np.ndarray,
    master: int,
) -> tuple[Rig, list[LensExchange]]:
    """Return the rig with exchanged lenses put right, and what was exchanged.

    ``backgrounds`` of the C cameras; ``subject`` by moment; ``times`` (T,) s.
    """
    found = _by_background(rig, backgrounds, subject, times, master)
    blind = [c for c, camera in enumerate(rig) if camera.depth is None]
    if len(blind) >= 2:
        for pair in lenses_by_keypoints(
            subject.keypoints,
            rig,
            times,
            rotation_sigma=CALIBRATION_ROTATION_SIGMA,
            translation_sigma=CALIBRATION_TRANSLATION_SIGMA_M,
        ):
            if pair.first in blind and pair.second in blind:
                found.append(LensExchange(pair.first, pair.second, True, np.nan, np.nan))
    for one in found:
        rig = swap_lenses(rig, one.first, one.second, whole=one.whole)
    return rig, found


def swap_lenses(rig: Rig, first: int, second: int, *, whole: bool) -> Rig:
    """The rig with the lenses of two cameras exchanged, without the distortion unless ``whole``;
    depth on the colour grid goes with it."""
    cameras = list(rig.cameras)
    for own, other in ((first, second), (second, first)):
        cameras[own] = _with_lens(rig[own], _lens(rig[own].colour, rig[other].colour, whole))
    return Rig(tuple(cameras))


def _lens(own: Intrinsics, other: Intrinsics, whole: bool) -> Intrinsics:
    if whole:
        return other
    return replace(own, fx=other.fx, fy=other.fy, cx=other.cx, cy=other.cy)


def _with_lens(camera: Camera, lens: Intrinsics) -> Camera:
    depth = lens if camera.aligned else camera.depth
    return replace(camera, colour=lens, depth=depth)


def _by_background(
    rig: Rig,
    backgrounds: Sequence[Background | None],
    subject: SubjectViews,
    times: np.ndarray,
    master: int,
) -> list[LensExchange]:
    aligned = [c for c, camera in enumerate(rig) if camera.aligned and backgrounds[c] is not None]
    if len(aligned) < 2:
        return []
    found: list[LensExchange] = []
    while True:
        free = [c for c in aligned if all(c not in (one.first, one.second) for one in found)]
        best = _best_exchange(rig, free, backgrounds, subject, times, master)
        if best is None:
            return found
        found.append(best)
        rig = swap_lenses(rig, best.first, best.second, whole=best.whole)


def _best_exchange(
    rig: Rig,
    cameras: list[int],
    backgrounds: Sequence[Background | None],
    subject: SubjectViews,
    times: np.ndarray,
    master: int,
) -> LensExchange | None:
    """The exchange that brings two of ``cameras`` nearest to the others; None where none does."""
    given = _residuals(rig, backgrounds, subject, times, master)
    if not given:
        return None
    # a wrong lens biases its neighbours' poses, too: the lowest quartile is the usual residual.
    usual = np.quantile(list(given.values()), 0.25)
    suspects = [c for c in cameras if _of(given, c) > SUSPICIOUS * usual]
    suspects = sorted(sorted(suspects, key=lambda c: -_of(given, c))[:MAX_SUSPECTS])
    found = []
    for a, b in combinations(suspects, 2):
        if not _interchangeable(rig[a].colour, rig[b].colour):
            continue
        before = _of(given, a, b)
        for whole, candidate in _variants(rig, a, b):
            after = _of(_residuals(candidate, backgrounds, subject, times, master), a, b)
            if after < MUCH_BETTER * before:
                found.append(LensExchange(a, b, whole, before, after))
    return min(found, key=lambda one: one.after, default=None)


def _variants(rig: Rig, a: int, b: int) -> Iterator[tuple[bool, Rig]]:
    for whole in (True, False):
        yield whole, swap_lenses(rig, a, b, whole=whole)


def _interchangeable(one: Intrinsics, other: Intrinsics) -> bool:
    same_image = (one.width, one.height) == (other.width, other.height)
    return same_image and not np.array_equal(one.parameters, other.parameters)


def _residuals(
    rig: Rig,
    backgrounds: Sequence[Background | None],
    subject: SubjectViews,
    times: np.ndarray,
    master: int,
) -> dict[tuple[int, int], float]:
    """Held-out residual by pair, metres, after the poses were refined on the background."""
    surfaces = background_surfaces(rig, backgrounds)
    registration = Registration(rig, [SurfaceLayer(surfaces, STATIC)], master)
    views = body_views(subject, times)
    body = [BodyConstraint(views, rig)] if len(views.points) >= MIN_BODY_POINTS else []
    refined = registration.solve(RigEstimate.start(rig), body).estimate
    residuals = registration.residuals(refined, STATIC)
    return {
        (int(a), int(b)): float(median)
        for (a, b), median in zip(residuals.pairs, residuals.median, strict=True)
    }


def _of(residuals: dict[tuple[int, int], float], *cameras: int) -> float:
    """Mean over the pairs that one of the cameras is in; NaN where there is none."""
    own = [value for pair, value in residuals.items() if set(pair) & set(cameras)]
    return float(np.mean(own)) if own else float("nan")
