"""Detects and corrects pairs of cameras whose intrinsics were exchanged in the calibration files.

In the InterCap release, two groups of files have the focal lengths and principal points of cameras
4 and 5 exchanged, but not the distortion. Its depth lies on the colour image's pixel grid, so wrong
colour intrinsics also bend the surfaces. An exchange is accepted if it brings the backgrounds of
both cameras much closer to the backgrounds of the other cameras.

Cameras with depth on its own grid are not tested: their devices store both intrinsics themselves.
Neither are cameras without depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.background import Background
from intercap_core.scene.constraints import BodyConstraint, body_views
from intercap_core.scene.registration import STATIC, Registration, RigEstimate
from intercap_core.scene.subject_views import SubjectViews
from intercap_core.scene.surfaces import background_surfaces


@dataclass(frozen=True)
class LensExchange:
    """Two cameras whose intrinsics are exchanged in the calibration."""

    cameras: tuple[int, int]
    """Camera indices."""
    before: float
    """Distance of both backgrounds to those of the other cameras with the given lenses, metres:
    mean over pairs of cameras of the median held-out residual."""
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
    views = body_views(subject, times)  # keypoints also constrain the poses

    def residuals(rig: Rig) -> dict[tuple[int, int], float]:
        """Held-out residual by pair, metres, with poses refined on the background."""
        surfaces = background_surfaces(rig, backgrounds)
        registration = Registration(rig, {STATIC: [surfaces]}, master)
        body = [BodyConstraint(views, rig)] if views.suffice else []
        refined = registration.solve(RigEstimate.start(rig), body).estimate
        return registration.median_residuals(refined, STATIC)

    free = [c for c, camera in enumerate(rig) if camera.aligned and backgrounds[c] is not None]
    exchanges: list[LensExchange] = []
    while len(free) >= 2 and (best := _best_exchange(rig, free, residuals)) is not None:
        exchanges.append(best)
        free = [c for c in free if c not in best.cameras]
        rig = swap_lenses(rig, *best.cameras)
    return rig, exchanges


def swap_lenses(rig: Rig, first: int, second: int) -> Rig:
    """Exchange focal lengths and principal points of two cameras, but not the distortion.

    The intrinsics of depth on the colour image's pixel grid change with them.
    """
    cameras = list(rig.cameras)
    for own, other in ((first, second), (second, first)):
        camera, theirs = rig[own], rig[other].colour
        lens = replace(camera.colour, fx=theirs.fx, fy=theirs.fy, cx=theirs.cx, cy=theirs.cy)
        depth = lens if camera.aligned else camera.depth
        cameras[own] = replace(camera, colour=lens, depth=depth)
    return Rig(tuple(cameras))


def _best_exchange(
    rig: Rig, cameras: list[int], residuals: Callable[[Rig], dict[tuple[int, int], float]]
) -> LensExchange | None:
    """The exchange that brings two of ``cameras`` closest to the others, if any does.

    ``residuals`` returns the residual of each pair of cameras of a rig, metres.
    """
    given = residuals(rig)
    if not given:
        return None
    # A wrong lens also raises the residuals of other pairs through the refined poses, so the lowest
    # quartile is the reference.
    usual = np.quantile(list(given.values()), 0.25)
    suspects = [c for c in cameras if _mean_of(given, c) > 1.3 * usual]  # tuned on the studio
    suspects = sorted(sorted(suspects, key=lambda c: -_mean_of(given, c))[:4])  # bounds the time
    better = []
    for a, b in combinations(suspects, 2):
        own, other = rig[a].colour, rig[b].colour
        same_size = (own.width, own.height) == (other.width, other.height)
        if not same_size or np.array_equal(own.parameters, other.parameters):
            continue
        before = _mean_of(given, a, b)
        after = _mean_of(residuals(swap_lenses(rig, a, b)), a, b)
        if after < 0.8 * before:  # tuned on the studio
            better.append(LensExchange((a, b), before, after))
    return min(better, key=lambda exchange: exchange.after, default=None)


def _mean_of(residuals: dict[tuple[int, int], float], *cameras: int) -> float:
    """Mean residual of the pairs that contain one of ``cameras``; NaN if there are none."""
    own = [value for pair, value in residuals.items() if set(pair) & set(cameras)]
    return float(np.mean(own)) if own else float("nan")
