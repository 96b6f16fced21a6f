"""Detects and corrects pairs of cameras whose intrinsics were exchanged in the calibration files.

In the InterCap release, two groups of files have the focal lengths and principal points of cameras
4 and 5 exchanged, but not the distortion. Two tests:

- Cameras with depth on the colour image's pixel grid: wrong colour intrinsics also bend their
  surfaces. An exchange is accepted if it brings the backgrounds of both cameras much closer to the
  backgrounds of the other cameras.
- Cameras without depth are tested by the keypoints. An exchange shifts the expected pixels of both
  cameras by a known pattern. Its gain is a log likelihood ratio. Points, pose errors (with a
  prior) and a constant error of each keypoint in each view are marginalised. A wrong principal
  point resembles a rotation of the camera, so the test relies on accurate given poses.

Cameras with depth on its own grid are not tested: their devices store both intrinsics themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from intercap_core.geometry.camera import projection
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.scene.background import Background
from intercap_core.scene.constraints import MIN_BODY_POINTS, BodyConstraint, BodyViews, body_views
from intercap_core.scene.keypoint_motion import KeypointMotion, build_motion
from intercap_core.scene.keypoint_timing import (
    CLUSTER,
    MIN_TIMING_SETS,
    keypoint_equations,
    pose_columns,
)
from intercap_core.scene.registration import STATIC, Registration, RigEstimate
from intercap_core.scene.subject_views import SubjectViews
from intercap_core.scene.surfaces import background_surfaces


@dataclass(frozen=True)
class LensPair:
    """Hypothesis that the intrinsics of two cameras are exchanged."""

    cameras: tuple[int, int]
    """Camera indices."""
    gain: float
    """Log likelihood ratio against no exchange; less if keypoints disagree beyond their noise."""
    share: float
    """Least-squares amplitude of the expected pattern in the residuals: 1 if the lenses are
    exchanged, 0 if not."""


def choose_pairs(pairs: Sequence[LensPair]) -> list[LensPair]:
    """Pairs with significant gain and fitting amplitude, best first; each camera at most once."""
    chosen: list[LensPair] = []
    for pair in sorted(pairs, key=lambda p: -p.gain):
        used = {c for other in chosen for c in other.cameras}
        # on the studio, gains of correct lenses reach 9; the range of the amplitude is tuned there
        good = pair.gain >= 15.0 and 0.5 <= pair.share <= 1.5
        if good and not used & set(pair.cameras):
            chosen.append(pair)
    return chosen


def lens_gains(
    keypoints: np.ndarray, rig: Rig, times: np.ndarray, pose_sigma: tuple[float, float]
) -> list[LensPair]:
    """Test each exchange of two different lenses for images of one size.

    For each ordered pair (a, b), the pattern is the displacement of camera a's pixels by the lens
    of b. One linear system holds the amplitudes of all patterns and the pose errors of all cameras.
    The exchange of a and b means amplitude 1 for (a, b) and (b, a). The pose errors are eliminated.
    Let e be the squared norm of the remaining pattern and l its product with the residuals. The
    amplitude is l / e, the log likelihood ratio of amplitude 1 against 0 is l - e / 2.

    Args:
        keypoints: (T, C, 135, 3) x, y, confidence of the subject by moment.
        times: (T,) seconds.
        pose_sigma: standard deviations of the poses about each axis, rad, and along it, metres.

    Returns:
        One result for each unordered pair.
    """
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
    # the constant biases are kept in the residuals, because a wrong lens also causes constant
    # shifts
    whole = np.where(motion.seen[..., None], motion.residual + motion.bias, 0.0)
    patterns = [motion.projected_of(a, _lens_shift(motion, a, b)) for a, b in orders]
    columns = np.concatenate([np.stack(patterns), pose_columns(motion)])
    # a joint's constant error in a view has twice the variance of its noise; tuned on the studio
    matrices, vectors = keypoint_equations(motion, whole, columns, constant=2.0)
    number = len(orders)
    prior = np.tile(np.repeat([sigma**-2.0 for sigma in pose_sigma], 3), len(rig))
    matrix, vector = matrices.sum(0), vectors.sum(0)
    poses = np.linalg.inv(matrix[number:, number:] + np.diag(prior))
    place = {order: i for i, order in enumerate(orders)}
    pairs = []
    for a, b in orders:
        if a > b:
            continue
        pattern = np.zeros(len(matrix))
        pattern[[place[a, b], place[b, a]]] = 1.0
        # The part of the pattern that no poses explain.
        pattern[number:] = -poses @ (matrix @ pattern)[number:]
        energy = float(pattern @ matrix @ pattern + prior @ pattern[number:] ** 2) + 1e-12
        linear = float(pattern @ vector)
        fitted = pattern * linear / energy
        fitted[number:] += poses @ vector[number:]
        # variance of the keypoint groups' gradients at the fit over that of the noise model
        scores = (vectors - matrices @ fitted) @ pattern
        disagreement = float((np.bincount(CLUSTER, scores) ** 2).sum()) / energy
        gain = (linear - energy / 2) / max(1.0, disagreement)
        pairs.append(LensPair((a, b), gain, linear / energy))
    return pairs


def _lens_shift(motion: KeypointMotion, camera: int, other: int) -> np.ndarray:
    """Displacement (T, K, 2), px, of the points in ``camera`` if it had the lens of ``other``."""
    in_camera = apply(motion.rig[camera].colour_from_master, np.nan_to_num(motion.paths.points))
    lenses = motion.rig.colour_parameters
    moved = projection.project(in_camera, lenses[other]) - projection.project(
        in_camera, lenses[camera]
    )
    return np.where(motion.seen[:, camera, :, None], moved, 0.0)


@dataclass(frozen=True)
class LensExchange:
    """Two cameras whose intrinsics are exchanged in the calibration."""

    cameras: tuple[int, int]
    """Camera indices."""
    with_distortion: bool
    """The distortion is exchanged as well."""
    before: float
    """Distance of both backgrounds to those of the other cameras with the given lenses, metres:
    mean over pairs of cameras of the median held-out residual. NaN if the keypoints decided."""
    after: float
    """The same with the lenses exchanged."""


def exchange_lenses(
    rig: Rig,
    backgrounds: Sequence[Background | None],
    subject: SubjectViews,
    times: np.ndarray,
    master: int,
) -> tuple[Rig, list[LensExchange]]:
    """Return the rig with exchanged lenses corrected, and the exchanges.

    Args:
        backgrounds: of the C cameras; None = no depth.
        subject: the subject's keypoints, by moment.
        times: (T,) seconds.
        master: camera whose pose is fixed.
    """
    exchanges = _BackgroundTest(backgrounds, body_views(subject, times), master).exchanges(rig)
    blind = [c for c, camera in enumerate(rig) if camera.depth is None]
    if len(blind) >= 2:
        # errors of poses from a calibration, 0.3 degrees and 6 mm; tuned on the studio
        gains = lens_gains(subject.keypoints, rig, times, (np.radians(0.3), 0.006))
        for pair in choose_pairs(gains):
            if set(pair.cameras) <= set(blind):
                exchanges.append(LensExchange(pair.cameras, True, np.nan, np.nan))
    for exchange in exchanges:
        rig = swap_lenses(rig, *exchange.cameras, with_distortion=exchange.with_distortion)
    return rig, exchanges


def swap_lenses(rig: Rig, first: int, second: int, *, with_distortion: bool) -> Rig:
    """Exchange focal lengths and principal points of two cameras, and optionally the distortion.

    The intrinsics of depth on the colour image's pixel grid change with them.
    """
    cameras = list(rig.cameras)
    for own, other in ((first, second), (second, first)):
        camera, lens = rig[own], rig[other].colour
        if not with_distortion:
            lens = replace(camera.colour, fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy)
        depth = lens if camera.aligned else camera.depth
        cameras[own] = replace(camera, colour=lens, depth=depth)
    return Rig(tuple(cameras))


@dataclass(frozen=True, eq=False)
class _BackgroundTest:
    """Tests exchanges by the distances between the backgrounds of all cameras."""

    backgrounds: Sequence[Background | None]
    """Of the C cameras."""
    views: BodyViews
    """Keypoints of the subject, which also constrain the poses."""
    master: int
    """Camera whose pose is fixed."""

    def exchanges(self, rig: Rig) -> list[LensExchange]:
        """Exchanges among cameras with depth on the colour grid; each camera at most once."""
        free = [c for c, cam in enumerate(rig) if cam.aligned and self.backgrounds[c] is not None]
        exchanges: list[LensExchange] = []
        while len(free) >= 2 and (best := self._best(rig, free)) is not None:
            exchanges.append(best)
            free = [c for c in free if c not in best.cameras]
            rig = swap_lenses(rig, *best.cameras, with_distortion=best.with_distortion)
        return exchanges

    def _best(self, rig: Rig, cameras: list[int]) -> LensExchange | None:
        """The exchange that brings two of ``cameras`` closest to the others, if any does."""
        given = self._residuals(rig)
        if not given:
            return None
        # A wrong lens also raises the residuals of other pairs through the refined poses, so the
        # lowest quartile is the reference.
        usual = np.quantile(list(given.values()), 0.25)
        suspects = [c for c in cameras if _mean_of(given, c) > 1.3 * usual]  # tuned on the studio
        suspects = sorted(
            sorted(suspects, key=lambda c: -_mean_of(given, c))[:4]
        )  # bounds the time
        better = []
        for (a, b), distorted in product(combinations(suspects, 2), (True, False)):
            own, other = rig[a].colour, rig[b].colour
            same_size = (own.width, own.height) == (other.width, other.height)
            if not same_size or np.array_equal(own.parameters, other.parameters):
                continue
            before = _mean_of(given, a, b)
            after = _mean_of(
                self._residuals(swap_lenses(rig, a, b, with_distortion=distorted)), a, b
            )
            if after < 0.8 * before:  # tuned on the studio
                better.append(LensExchange((a, b), distorted, before, after))
        return min(better, key=lambda exchange: exchange.after, default=None)

    def _residuals(self, rig: Rig) -> dict[tuple[int, int], float]:
        """Held-out residual by pair, metres, with poses refined on the background."""
        surfaces = background_surfaces(rig, self.backgrounds)
        registration = Registration(rig, {STATIC: [surfaces]}, self.master)
        enough = len(self.views.points) >= MIN_BODY_POINTS
        body = [BodyConstraint(self.views, rig)] if enough else []
        refined = registration.solve(RigEstimate.start(rig), body).estimate
        return registration.median_residuals(refined, STATIC)


def _mean_of(residuals: dict[tuple[int, int], float], *cameras: int) -> float:
    """Mean residual of the pairs that contain one of ``cameras``; NaN if there are none."""
    own = [value for pair, value in residuals.items() if set(pair) & set(cameras)]
    return float(np.mean(own)) if own else float("nan")
