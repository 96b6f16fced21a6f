"""Refined camera poses of one recording, or the given ones where no improvement can be shown."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.camera_verdicts import MUST_IMPROVE, PoseJudge, PoseVerdict
from intercap_core.scene.constraints import (
    MIN_BODY_POINTS,
    BodyConstraint,
    BodyViews,
    FloorConstraint,
    body_views,
)
from intercap_core.scene.keypoint_timing import TIMING_INFLATION, TimeOffsets
from intercap_core.scene.registration import (
    MOVING,
    OFFSET,
    PRIOR_ROTATION_RAD,
    PRIOR_TRANSLATION_M,
    STATIC,
    Constraint,
    OffsetInformation,
    PairResiduals,
    Registration,
    RigEstimate,
    RigSolution,
    SurfaceLayer,
)
from intercap_core.scene.starts import StartTimes
from intercap_core.scene.subject_views import SubjectViews
from intercap_core.scene.surfaces import DepthSurface

# Variance of refined poses and biases over that of the normal equations: the points of a surface
# share errors of its lens and its material. Tuned on the studio.
COVARIANCE_INFLATION = 3.0
CONVERGED_M = 0.001  # the last step's motion of what a camera looks at
MAY_WORSEN = 1.02  # in any group
WEAK_POINTS = 120  # held-out correspondences of a pair, background and moving together
WEAK_RESIDUAL = 2.0  # times the median pair's
KNOWN_OFFSET_SIGMA_S = 0.008  # less certain than what devices are off by: not known


@dataclass(frozen=True, eq=False)
class PairTable:
    """Held-out residuals by pair: ``pairs`` (P, 2) camera indices; for the background and for what
    moves, ``points`` (P, 2) and medians ``before`` and ``after`` (P, 2), metres, NaN = no overlap;
    ``weak`` (P,): few points, or residuals that stay large."""

    pairs: np.ndarray
    points: np.ndarray
    before: np.ndarray
    after: np.ndarray
    weak: np.ndarray


@dataclass(frozen=True, eq=False)
class Refinement:
    """``poses`` (C, 4, 4) master_from_colour, ``bias`` (C,) metres to subtract from depth,
    ``offset`` and ``offset_sigma`` (C,) seconds, NaN sigma = not known; ``improved``: the poses are
    better than the start's on held-out points; the pairs and the verdict; which cameras (C,) were
    ``refined``, each one's own verdict, and its note, in words. ``covariance`` (C, 7, C, 7) of each
    camera's rotation about its centre, rad, translation and depth bias, m, given the master's."""

    poses: np.ndarray
    bias: np.ndarray
    covariance: np.ndarray
    offset: np.ndarray
    offset_sigma: np.ndarray
    improved: bool
    converged: bool
    pairs: PairTable
    verdict: str
    refined: np.ndarray
    verdicts: tuple[str, ...]
    notes: tuple[str, ...]


def refine(
    rig: Rig,
    master: int,
    static: dict[int, DepthSurface],
    moving: Sequence[dict[int, DepthSurface]],
    subject: SubjectViews,
    times: np.ndarray,
    timing: TimeOffsets,
    starts: StartTimes,
    *,
    floor: FloorConstraint | None,
    free_poses: bool,
) -> Refinement:
    """Refine all cameras' poses but the ``master``'s, their depth bias and time offsets.

    ``static`` and ``moving`` are surfaces as :func:`.surface.background_surfaces` and
    :func:`.moving.moving_surfaces` give; ``subject`` is by moment; ``timing`` is what its keypoints
    say of the offsets beside those of ``starts``; ``floor`` ties cameras that share no surface
    with the others. The start's poses are kept where held-out points and keypoints together do not
    get better, and where not ``free_poses``.
    """
    layers = [SurfaceLayer(static, STATIC), *(SurfaceLayer(at_once, MOVING) for at_once in moving)]
    registration = Registration(rig, layers, master, starts.offset_sigma)
    given = RigEstimate.start(rig, starts.offset)
    views = body_views(subject, times)
    body = BodyConstraint(views, rig) if len(views.points) >= MIN_BODY_POINTS else None
    known = OffsetInformation(
        timing.information / TIMING_INFLATION**2, timing.vector / TIMING_INFLATION**2
    )
    overlapping = [registration.residuals(given, k).pairs for k in (STATIC, MOVING)]
    linked = _linked(np.concatenate(overlapping), master)
    constraints: list[Constraint] = [body] if body else []
    if floor is not None and len(linked) < len(rig):
        constraints.append(floor)  # where cameras overlap, their surfaces tell more
    held = registration.solve(given, (), known, free_poses=False)
    found, improved, ratios = held, False, []
    verdicts: dict[int, PoseVerdict] = {}
    covariance = held.covariance
    if free_poses and len(rig) > 1:

        def solve(some: BodyViews | None, free: np.ndarray) -> RigSolution:
            own = constraints
            if some is not None:
                own = [BodyConstraint(some, rig), *(one for one in constraints if one is not body)]
            return registration.solve(given, own, known, free_poses=free)

        freed = solve(None, np.ones(len(rig), bool))
        ratios = _ratios(registration, body, held.estimate, freed.estimate)
        if _better(ratios, freed.estimate):
            judge = PoseJudge(
                registration,
                lambda some, free: solve(some, free).estimate,
                views if body else None,
                held.estimate,
                freed.estimate,
            )
            verdicts = judge.verdicts([c for c in range(len(rig)) if c != master])
            own = np.array([c in verdicts and verdicts[c].refined for c in range(len(rig))])
            improved = bool(own.any())
            if improved:
                all_of_them = own.sum() == len(verdicts)
                found = freed if all_of_them else solve(None, own)
                covariance = (
                    freed.covariance
                )  # what is kept is as well known as it would be refined
    pairs = _pair_table(registration, held.estimate, found.estimate)
    sigma = np.sqrt(np.diagonal(found.covariance[:, OFFSET, :, OFFSET]))
    unknown = (sigma > KNOWN_OFFSET_SIGMA_S) & np.isnan(starts.sigma)  # a stated time is known
    sigma = np.where(unknown, np.nan, sigma)
    sigma[master] = 0.0
    converged = found.last_step_m < CONVERGED_M
    verdict = _verdict(rig, pairs, ratios, improved, converged, free_poses)
    refined, words = _verdicts(rig, master, verdicts, verdict)
    return Refinement(
        found.estimate.poses,
        found.estimate.bias,
        _stated_covariance(covariance, master),
        np.where(unknown, given.offset, found.estimate.offset),
        sigma,
        improved,
        converged,
        pairs,
        verdict,
        refined,
        words,
        _notes(
            rig,
            master,
            pairs,
            views.weights,
            refined,
            floor.cameras if floor is not None and floor in constraints else (),
        ),
    )


def _verdicts(
    rig: Rig, master: int, own: dict[int, PoseVerdict], said: str
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Which cameras (C,) were refined, and why, in words; of the rig as a whole where no camera was
    judged by itself."""
    refined = np.array([c in own and own[c].refined for c in range(len(rig))])
    whole = "as given: " + said.removesuffix(": poses as given")
    words = [str(own[c]) if c in own else whole for c in range(len(rig))]
    words[master] = "the master, which the others are placed by"
    return refined, tuple(words)


def _stated_covariance(found: np.ndarray, master: int) -> np.ndarray:
    """Covariance (C, 7, C, 7) of poses and depth bias from that ``found`` (C, 8, C, 8): residuals
    of many points say little of errors that they share. Poses that were held are as uncertain as
    given ones."""
    stated = COVARIANCE_INFLATION * found[:, :OFFSET, :, :OFFSET]
    given = np.repeat([PRIOR_ROTATION_RAD, PRIOR_TRANSLATION_M], 3) ** 2
    for c in range(len(stated)):
        if c != master and not stated[c, :6, c, :6].any():
            stated[c, :6, c, :6] = np.diag(given)
    return stated


def _ratios(
    registration: Registration, body: BodyConstraint | None, start: RigEstimate, found: RigEstimate
) -> list[float]:
    """Held-out costs over the start's: background, what moves, and keypoints, where there are any.

    The start has the depth bias and the time offsets that suit it best: poses alone are judged.
    """
    ratios = []
    for kind in (STATIC, MOVING):
        before, after = (registration.residuals(at, kind) for at in (start, found))
        if len(before.pairs) and len(after.pairs):
            ratios.append(_cost(after) / max(_cost(before), 1e-9))
    if body is not None:
        before_px, after_px = (body.median_error(at.poses, at.offset) for at in (start, found))
        ratios.append(after_px / max(before_px, 1e-9))
    return ratios


def _cost(residuals: PairResiduals) -> float:
    """Mean of the pairs' medians: every pair counts the same, however much it overlaps."""
    return float(residuals.median.mean())


def _better(ratios: list[float], found: RigEstimate) -> bool:
    if not ratios or not np.isfinite(found.poses).all():
        return False
    return min(ratios) <= MUST_IMPROVE and max(ratios) <= MAY_WORSEN


def _pair_table(registration: Registration, start: RigEstimate, found: RigEstimate) -> PairTable:
    kinds = [
        [registration.residuals(at, kind) for at in (start, found)] for kind in (STATIC, MOVING)
    ]
    pairs = sorted({tuple(pair) for both in kinds for r in both for pair in r.pairs})
    place = {pair: row for row, pair in enumerate(pairs)}
    points = np.zeros((len(pairs), 2), np.int64)
    medians = np.full((2, len(pairs), 2), np.nan)
    for k, both in enumerate(kinds):
        for when, residuals in enumerate(both):
            rows = [place[tuple(pair)] for pair in residuals.pairs]
            medians[when, rows, k] = residuals.median
            points[rows, k] = residuals.count
    after = medians[1]
    usual = np.array([np.nanmedian(a) if np.isfinite(a).any() else np.nan for a in after.T])
    large = (after > WEAK_RESIDUAL * usual).any(1)
    weak = large | (points.sum(1) < WEAK_POINTS)
    return PairTable(np.array(pairs, np.int32).reshape(-1, 2), points, medians[0], after, weak)


def _verdict(
    rig: Rig,
    pairs: PairTable,
    ratios: list[float],
    improved: bool,
    converged: bool,
    free_poses: bool,
) -> str:
    if len(rig) == 1:
        return "one camera: nothing to refine"
    if not free_poses:
        return "refinement is switched off: poses as given"
    if not ratios:
        return "too little is seen by several cameras at once: poses as given"
    if not improved:
        return "held-out points do not get better: poses as given"
    said = "refined" if converged else "refined, not fully converged"
    for k, kind in enumerate(("background", "moving surfaces")):
        if np.isfinite(pairs.after[:, k]).any():
            before, after = (1e3 * float(np.nanmean(x[:, k])) for x in (pairs.before, pairs.after))
            said += f"; {kind} {before:.1f} to {after:.1f} mm"
    names = [f"{rig.names[a]}-{rig.names[b]}" for a, b in pairs.pairs[pairs.weak]]
    return f"{said}; weak pairs: {', '.join(names)}" if names else said


def _notes(
    rig: Rig,
    master: int,
    pairs: PairTable,
    body_weights: np.ndarray,
    improved: np.ndarray,
    on_floor: Collection[int],
) -> tuple[str, ...]:
    """What each camera's pose rests on, where that is less than the others': ``improved`` (C,)
    were refined, those ``on_floor`` are tied to the common floor."""
    linked = _linked(pairs.pairs, master)
    notes = []
    for c in range(len(rig)):
        if c in linked or len(rig) == 1:
            notes.append("")
        else:
            why = "shares no surface with the others" if rig[c].depth else "has no depth"
            seen = len(body_weights) and (body_weights[:, c] > 0).sum() >= MIN_BODY_POINTS
            if improved[c] and seen:
                rests = "the keypoints and the floor" if c in on_floor else "the keypoints"
                notes.append(f"{why}: its pose rests on {rests}")
            elif seen:
                notes.append(f"{why}: its pose is as given")
            else:
                notes.append(f"{why} and no keypoints with the others: its pose is as given")
    return tuple(notes)


def _linked(pairs: np.ndarray, master: int) -> set[int]:
    """The cameras that a chain of ``pairs`` (P, 2) joins to the master, itself included."""
    linked = {master}
    while True:
        touching = [{int(c) for c in pair} for pair in pairs if linked & {int(c) for c in pair}]
        if set().union(*touching) <= linked:
            return linked
        linked = linked.union(*touching)
