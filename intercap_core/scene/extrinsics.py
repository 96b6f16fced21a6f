"""Refined camera poses of one recording, or the given poses if no improvement can be shown."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.camera_verdicts import PoseVerdict, judge_poses
from intercap_core.scene.constraints import BodyConstraint, BodyViews, FloorConstraint, body_views
from intercap_core.scene.keypoint_timing import undetermined
from intercap_core.scene.moments import Moments
from intercap_core.scene.registration import (
    MOVING,
    OFFSET,
    PRIOR_ROTATION_RAD,
    PRIOR_TRANSLATION_M,
    STATIC,
    Constraint,
    Registration,
    RigEstimate,
    RigSolution,
)
from intercap_core.scene.rig_prior import RigPrior
from intercap_core.scene.surfaces import DepthSurface

# Factor on the solver's covariance, because the points of a surface share errors of lens and
# material; tuned on the studio.
COVARIANCE_FACTOR = 3.0


@dataclass(frozen=True, eq=False)
class PairTable:
    """Held-out residuals of P pairs of cameras. Column 0 is for background, column 1 for moving
    surfaces."""

    pairs: np.ndarray
    """(P, 2) camera indices."""
    points: np.ndarray
    """(P, 2) number of held-out correspondences."""
    before: np.ndarray
    """(P, 2) median residual at the given poses, metres; NaN = no overlap."""
    after: np.ndarray
    """(P, 2) median residual at the resulting poses, metres; NaN = no overlap."""
    weak: np.ndarray
    """(P,) bool: few points, or residuals that remain large."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """Poses, depth biases and time offsets of a rig."""

    poses: np.ndarray
    """(C, 4, 4) master_from_colour."""
    bias: np.ndarray
    """(C,) metres to subtract from depth."""
    covariance: np.ndarray
    """(C, 7, C, 7). Rows of a camera: 0-2 rotation about its centre, rad; 3-5 translation, metres;
    6 depth bias, metres."""
    offset: np.ndarray
    """(C,) seconds by which each camera exposes after the set's time."""
    offset_sigma: np.ndarray
    """(C,) standard deviation of ``offset``, seconds; NaN = unknown."""
    converged: bool
    """The last iteration moved no point seen by a camera by more than a millimetre."""
    pairs: PairTable
    """Held-out residuals."""
    verdict: str
    """Summary for the whole rig."""
    refined: np.ndarray
    """(C,) bool: the camera's pose is refined."""
    verdicts: tuple[str, ...]
    """Reason for each camera's pose."""
    notes: tuple[str, ...]
    """What determines the pose of each weakly connected camera; "" = nothing to report."""


def refine(
    rig: Rig,
    master: int,
    static: dict[int, DepthSurface],
    moving: Sequence[dict[int, DepthSurface]],
    moments: Moments,
    times: np.ndarray,
    *,
    floor: FloorConstraint | None,
    free_poses: bool,
    prior: RigPrior | None = None,
) -> Refinement:
    """Refine the poses of all cameras but the ``master``, depth biases and time offsets.

    1. Biases and offsets are estimated at the given poses, then together with all poses.
    2. All given poses are kept unless the residuals of one kind of data improve and those of no
       kind get worse: held-out background, held-out moving surfaces, keypoints.
    3. Otherwise each camera's refined and given pose are compared (:mod:`.camera_verdicts`). If
       some keep the given pose, the others are refined around them.

    Args:
        rig: cameras as given.
        master: index of the camera whose pose is fixed.
        static: background surfaces by camera.
        moving: moving surfaces by camera, of several sets.
        moments: images by moment, time offsets of the keypoints, and the subject.
        times: (T,) seconds of the sets.
        floor: constraint of a common floor; None = no floor. It is used only if some camera shares
            no surface with the others.
        free_poses: False keeps all given poses.
        prior: of the poses, which are then those of ``rig``, and of the depth biases; None = errors
            of a careful calibration.
    """
    starts, timing = moments.starts, moments.timing
    layers = {STATIC: [static], MOVING: moving}
    given = prior.start(starts.offset) if prior else RigEstimate.start(rig, starts.offset)
    registration = Registration(rig, layers, master, starts.offset_sigma)
    views = body_views(moments.subject, times)
    body = BodyConstraint(views, rig) if views.suffice else None
    known = timing.information, timing.vector
    overlapping = [pair for k in (STATIC, MOVING) for pair in registration.residuals(given, k)]
    linked = _linked(overlapping, master)
    constraints: list[Constraint] = [body] if body else []
    if floor is not None and len(linked) < len(rig):
        constraints.append(floor)  # unnecessary if all overlap, which constrains more

    def solve(some: BodyViews | None, free: np.ndarray) -> RigSolution:
        used = constraints
        if some is not None:
            used = [BodyConstraint(some, rig), *(c for c in constraints if c is not body)]
        return registration.solve(given, used, known, free_poses=free)

    free_poses, every = free_poses and len(rig) > 1, np.ones(len(rig), bool)
    moved: list[int] = []
    if prior:
        if free_poses:  # without the prior, which would hide that a camera was moved
            alone = solve(None, every)
            if np.isfinite(alone.estimate.poses).all():
                moved = prior.moved(alone.estimate.poses, _inflated(alone.covariance))
                prior = prior.without(moved)
        registration.prior_precision = prior.precision(COVARIANCE_FACTOR)
    unmoved = registration.solve(given, (), known, free_poses=False)
    result, ratios, covariance = unmoved, [], unmoved.covariance
    verdicts: dict[int, PoseVerdict] = {}
    refined = np.zeros(len(rig), bool)
    if free_poses:
        freed = solve(None, every)
        ratios = _ratios(registration, body, unmoved.estimate, freed.estimate)
        # one kind of data gets better by at least 2 %, and none worse by more; tuned on the studio
        finite = np.isfinite(freed.estimate.poses).all()
        if finite and ratios and min(ratios) <= 0.98 and max(ratios) <= 1.02:
            verdicts = judge_poses(
                registration,
                lambda some, free: solve(some, free).estimate,
                views if body else None,
                unmoved.estimate,
                freed.estimate,
                [c for c in range(len(rig)) if c != master],
            )
            refined = np.array([c in verdicts and verdicts[c].refined for c in range(len(rig))])
            if refined.any():
                result = freed if refined.sum() == len(verdicts) else solve(None, refined)
                # a kept given pose is assumed to be as accurate as a refined one
                covariance = freed.covariance
    pairs = _pair_table(registration, unmoved.estimate, result.estimate)
    sigma = np.sqrt(np.diagonal(result.covariance[:, OFFSET, :, OFFSET]))
    # Offsets of cameras with a stated start are always known.
    unknown = undetermined(sigma, starts.offset_sigma) & np.isnan(starts.sigma)
    sigma = np.where(unknown, np.nan, sigma)
    sigma[master] = 0.0
    converged = result.last_step_m < 0.001
    verdict = _verdict(rig, pairs, ratios, refined, converged=converged, free=free_poses)
    on_floor = floor.cameras if floor is not None and floor in constraints else ()
    kept = "as given: " + verdict.removesuffix(": poses as given")
    of_cameras = [str(verdicts[c]) if c in verdicts else kept for c in range(len(rig))]
    of_cameras[master] = "the master, whose pose is fixed"
    notes = list(_notes(rig, master, pairs, views, refined, on_floor))
    if prior:
        verdict += f"; the given poses are those of sequence {prior.sequence}"
        for c in moved:
            notes[c] += "; " if notes[c] else ""
            notes[c] += f"it was moved after sequence {prior.sequence}, by its depth and keypoints"
    return Refinement(
        poses=result.estimate.poses,
        bias=result.estimate.bias,
        covariance=_stated_covariance(covariance, master, prior),
        offset=np.where(unknown, given.offset, result.estimate.offset),
        offset_sigma=sigma,
        converged=converged,
        pairs=pairs,
        verdict=verdict,
        refined=refined,
        verdicts=tuple(of_cameras),
        notes=tuple(notes),
    )


def _inflated(solved: np.ndarray) -> np.ndarray:
    """Covariance (C, 7, C, 7) of poses and depth bias from the solver's (C, 8, C, 8)."""
    return COVARIANCE_FACTOR * solved[:, :OFFSET, :, :OFFSET]


def _stated_covariance(solved: np.ndarray, master: int, prior: RigPrior | None) -> np.ndarray:
    """Covariance (C, 7, C, 7) of poses and depth bias from the solver's (C, 8, C, 8).

    Poses that were not estimated get the covariance of the prior, except the master's, whose
    covariance is 0.
    """
    stated = _inflated(solved)
    given = np.diag(np.repeat([PRIOR_ROTATION_RAD, PRIOR_TRANSLATION_M], 3) ** 2)
    for c in range(len(stated)):
        if c != master and not stated[c, :6, c, :6].any():
            stated[c, :6, c, :6] = prior.covariance[c, :6, c, :6] if prior else given
    return stated


def _ratios(
    registration: Registration,
    body: BodyConstraint | None,
    start: RigEstimate,
    refined: RigEstimate,
) -> list[float]:
    """Ratios of cost, refined over start: held-out background, held-out moving surfaces, keypoints.

    The keypoints are those of the fit, not held-out ones. A kind without data has no entry. The
    start has the depth biases and time offsets that fit it best, so only poses are compared.
    """
    ratios = []
    for kind in (STATIC, MOVING):
        medians = [
            list(registration.median_residuals(at, kind).values()) for at in (start, refined)
        ]
        if all(medians):  # every pair counts the same, however much it overlaps
            before, after = (float(np.mean(of_pairs)) for of_pairs in medians)
            ratios.append(after / max(before, 1e-9))
    if body is not None:
        before_px, after_px = (body.median_error(at.poses, at.offset) for at in (start, refined))
        ratios.append(after_px / max(before_px, 1e-9))
    return ratios


def _pair_table(registration: Registration, start: RigEstimate, refined: RigEstimate) -> PairTable:
    """Held-out residuals by pair, before and after.

    A pair is weak with fewer than 120 points, or with more than twice the median residual of all
    pairs; both untuned.
    """
    kinds = [
        [registration.residuals(at, kind) for at in (start, refined)] for kind in (STATIC, MOVING)
    ]
    pairs = sorted({pair for both in kinds for residuals in both for pair in residuals})
    points = np.zeros((len(pairs), 2), np.int64)
    medians = np.full((2, len(pairs), 2), np.nan)
    for k, both in enumerate(kinds):
        for when, residuals in enumerate(both):
            for row, pair in enumerate(pairs):
                if pair in residuals:
                    medians[when, row, k] = np.median(residuals[pair])
                    points[row, k] = len(residuals[pair])
    after = medians[1]
    usual = np.array([np.nanmedian(a) if np.isfinite(a).any() else np.nan for a in after.T])
    large = (after > 2.0 * usual).any(1)
    weak = large | (points.sum(1) < 120)
    return PairTable(np.array(pairs, np.int32).reshape(-1, 2), points, medians[0], after, weak)


def _verdict(
    rig: Rig,
    pairs: PairTable,
    ratios: list[float],
    refined: np.ndarray,
    *,
    converged: bool,
    free: bool,
) -> str:
    """Summarise the refinement of the rig."""
    if len(rig) == 1:
        return "one camera: nothing to refine"
    if not free:
        return "refinement is switched off: poses as given"
    if not ratios:
        return "too little is seen by several cameras at once: poses as given"
    if not refined.any():
        return "held-out points do not get better: poses as given"
    words = "refined" if converged else "refined, not fully converged"
    for k, kind in enumerate(("background", "moving surfaces")):
        if np.isfinite(pairs.after[:, k]).any():
            before, after = (1e3 * float(np.nanmean(x[:, k])) for x in (pairs.before, pairs.after))
            words += f"; {kind} {before:.1f} to {after:.1f} mm"
    names = [f"{rig.names[a]}-{rig.names[b]}" for a, b in pairs.pairs[pairs.weak]]
    return f"{words}; weak pairs: {', '.join(names)}" if names else words


def _notes(
    rig: Rig,
    master: int,
    pairs: PairTable,
    views: BodyViews,
    refined: np.ndarray,
    on_floor: Collection[int],
) -> tuple[str, ...]:
    """Describe which data determine the pose of each camera that shares no surface with others.

    The result (C,) is "" for cameras that a chain of overlapping pairs connects to the master.

    Args:
        views: keypoints of the subject.
        refined: (C,) bool, cameras with refined poses.
        on_floor: cameras with points in the constraint of the common floor.
    """
    linked = _linked(pairs.pairs.tolist(), master)
    notes = []
    for c in range(len(rig)):
        if c in linked or len(rig) == 1:
            notes.append("")
        else:
            why = "shares no surface with the others" if rig[c].depth else "has no depth"
            seen = views.subset(views.weights[:, c] > 0).suffice
            if refined[c] and seen:
                rests = "the keypoints and the floor" if c in on_floor else "the keypoints"
                notes.append(f"{why}: its pose rests on {rests}")
            elif seen:
                notes.append(f"{why}: its pose is as given")
            else:
                notes.append(f"{why} and no keypoints with the others: its pose is as given")
    return tuple(notes)


def _linked(pairs: Collection[Collection[int]], master: int) -> set[int]:
    """Cameras that a chain of ``pairs`` connects to the master, which is included."""
    linked = {master}
    for _ in pairs:  # the longest chain
        linked = linked.union(*(pair for pair in pairs if linked & set(pair)))
    return linked
