"""Cameras that were given each other's lenses, put right.

The InterCap release holds two sets of files in which the focal lengths and principal points of
cameras 4 and 5 are exchanged, distortion not. Where depth lies on the colour grid, a wrong lens
bends every surface that the camera measures, so the background shows it reliably; where a camera
has no depth, the keypoints are used (:mod:`.lenses`). Devices that bring their own lenses are left
alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.scene.background import Background
from intercap_core.scene.body_constraints import BodyConstraint, body_views
from intercap_core.scene.constants import (
    CALIBRATION_ROTATION_SIGMA,
    CALIBRATION_TRANSLATION_SIGMA_M,
    MAX_SUSPECTS,
    MIN_BODY_POINTS,
    MUCH_BETTER,
    SUSPICIOUS,
)
from intercap_core.scene.lenses import swapped_lenses
from intercap_core.scene.registration import STATIC, Estimate, Layer, Registration
from intercap_core.scene.subject_views import SubjectViews
from intercap_core.scene.surface import background_surfaces


@dataclass(frozen=True)
class Exchange:
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
) -> tuple[Rig, list[Exchange]]:
    """Return the rig with exchanged lenses put right, and what was exchanged.

    ``backgrounds`` of the C cameras; ``subject`` by moment; ``times`` (T,) s.
    """
    found = _by_background(rig, backgrounds, subject, times, master)
    blind = [c for c, camera in enumerate(rig) if camera.depth is None]
    if len(blind) >= 2:
        for pair in swapped_lenses(
            subject.keypoints,
            rig,
            times,
            rotation_sigma=CALIBRATION_ROTATION_SIGMA,
            translation_sigma=CALIBRATION_TRANSLATION_SIGMA_M,
        ):
            if pair.first in blind and pair.second in blind:
                found.append(Exchange(pair.first, pair.second, True, np.nan, np.nan))
    for one in found:
        rig = exchanged(rig, one.first, one.second, whole=one.whole)
    return rig, found


def exchanged(rig: Rig, first: int, second: int, *, whole: bool) -> Rig:
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
) -> list[Exchange]:
    aligned = [c for c, camera in enumerate(rig) if camera.aligned and backgrounds[c] is not None]
    if len(aligned) < 2:
        return []
    found: list[Exchange] = []
    while True:
        free = [c for c in aligned if all(c not in (one.first, one.second) for one in found)]
        best = _best_exchange(rig, free, backgrounds, subject, times, master)
        if best is None:
            return found
        found.append(best)
        rig = exchanged(rig, best.first, best.second, whole=best.whole)


def _best_exchange(
    rig: Rig,
    cameras: list[int],
    backgrounds: Sequence[Background | None],
    subject: SubjectViews,
    times: np.ndarray,
    master: int,
) -> Exchange | None:
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
                found.append(Exchange(a, b, whole, before, after))
    return min(found, key=lambda one: one.after, default=None)


def _variants(rig: Rig, a: int, b: int) -> Iterator[tuple[bool, Rig]]:
    for whole in (True, False):
        yield whole, exchanged(rig, a, b, whole=whole)


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
    registration = Registration(rig, [Layer(surfaces, STATIC)], master)
    views = body_views(subject, times)
    body = [BodyConstraint(views, rig)] if len(views.points) >= MIN_BODY_POINTS else []
    refined = registration.solve(Estimate.start(rig), body).estimate
    residuals = registration.residuals(refined, STATIC)
    return {
        (int(a), int(b)): float(median)
        for (a, b), median in zip(residuals.pairs, residuals.median, strict=True)
    }


def _of(residuals: dict[tuple[int, int], float], *cameras: int) -> float:
    """Mean over the pairs that one of the cameras is in; NaN where there is none."""
    own = [value for pair, value in residuals.items() if set(pair) & set(cameras)]
    return float(np.mean(own)) if own else float("nan")
