"""The object's pose over time: a seed frame, tracking both ways from it, and a second pass.

From the seed the track runs to both ends; then from the ends back over all frames. Where the two
passes end in different poses the images decide, and where they do not the frames are flagged.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.object_track.audit import audited
from intercap_core.object_track.constants import JUMP_DEG, JUMP_M, PASSES_AGREE_DEG, PASSES_AGREE_M
from intercap_core.object_track.fit import Fit
from intercap_core.object_track.follow import follow
from intercap_core.object_track.lost import FrameResult, decided, doubted, judged
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.seed import annotated_seed, find_seed
from intercap_core.object_track.view import View
from intercap_core.object_track.whole import WholeTrack
from intercap_core.rigid.mesh import ObjectMesh

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Track:
    """All frames (T), the frame that the track started from and how its pose was found:
    ``borne_out``, whether the images support the annotation."""

    frames: list[FrameResult]
    seed_frame: int
    annotated: bool
    borne_out: bool = True


class Tracker:
    """Tracks one object through one recording.

    ``load`` gives the views of frame t, one a camera; ``labels_by_view`` [T][C][candidates] the
    labels alone; ``times`` (T,) of the frames, seconds; ``labels`` the classes the object may be
    given; ``up`` (3,) the vertical; ``joints`` (T, 135, 3) of the person, who handles the object.
    """

    def __init__(
        self,
        mesh: ObjectMesh,
        load: Callable[[int], list[View]],
        labels_by_view: list[list[list[str]]],
        settings: ObjectTrackSettings,
        *,
        times: np.ndarray,
        labels: tuple[str, ...],
        up: np.ndarray | None,
        joints: np.ndarray | None = None,
    ) -> None:
        self._observer = Observer(mesh, load, labels_by_view, settings, labels, up, joints)
        self._mesh = mesh
        self._count = len(labels_by_view)
        self._times = times

    def run(self, initial: tuple[int, np.ndarray] | None = None) -> Track:
        """Track from an annotated (frame, pose (4, 4)), or from a seed that is searched for.

        Raises NotFound where no frame holds a candidate that could be the object.
        """
        borne_out = True
        if initial is not None:
            seed_frame, seed, borne_out = annotated_seed(self._observer, *initial)
        else:
            seed_frame, seed = find_seed(self._observer)
        self._observer.places.claim(self._mesh.centre_at(seed.pose))
        merged = self._passes(seed_frame, seed)
        if self._at_another(merged):  # known only once later frames were tracked
            merged = self._passes(seed_frame, seed)
        sure = seed_frame if initial is not None and borne_out else None
        refined = WholeTrack(self._observer, self._times, sure).refine(merged)
        whole = doubted(self._mesh, refined)
        return Track(
            _recovered(self._mesh, whole, seed_frame), seed_frame, initial is not None, borne_out
        )

    def _passes(self, seed_frame: int, seed: Fit) -> list[FrameResult]:
        """Every frame (T) by both passes."""
        one = audited(self._observer, self._both_ways(seed_frame, seed), self._times)
        last = self._count - 1
        two = list(one)
        for frames, start_at in (
            (range(last - 1, seed_frame, -1), last),
            (range(1, seed_frame), 0),
        ):
            for t, result in follow(self._observer, frames, one[start_at], one, may_search=False):
                two[t] = result
        return self._merged(one, two)

    def _both_ways(self, seed_frame: int, seed: Fit) -> list[FrameResult]:
        """Every frame (T), tracked from the seed to both ends."""
        results = {seed_frame: judged(seed, self._observer.settings)}
        for frames in (range(seed_frame + 1, self._count), range(seed_frame - 1, -1, -1)):
            results.update(follow(self._observer, frames, results[seed_frame]))
        return [results[t] for t in range(self._count)]

    def _at_another(self, frames: list[FrameResult]) -> bool:
        """Whether the track (T) was at a place where another thing stands."""
        return any(
            self._observer.places.taken(self._mesh.centre_at(frame.fit.pose))
            for frame in frames
            if not frame.lost
        )

    # --- two passes ---------------------------------------------------------------------------

    def _merged(self, one: list[FrameResult], two: list[FrameResult]) -> list[FrameResult]:
        """The frames (T) of both passes: of a run in which they differ that of the pass that
        explains the images of all its frames better."""
        result = list(one)
        apart = [self._apart(a, b) for a, b in zip(one, two, strict=True)]
        for t, (a, b) in enumerate(zip(one, two, strict=True)):
            if a.lost and not b.lost and not apart[t]:
                result[t] = b
        start = 0
        while start < self._count:
            end = start
            while end < self._count and apart[end]:
                end += 1
            if end > start:
                result[start:end] = _better_run(one[start:end], two[start:end])
            start = end + 1
        return result

    def _apart(self, one: FrameResult, two: FrameResult) -> bool:
        """Whether the passes end in different poses."""
        if one is two:
            return False
        angle = self._mesh.symmetry.rotation_error_deg(one.fit.pose[:3, :3], two.fit.pose[:3, :3])
        apart = np.linalg.norm(
            self._mesh.centre_at(one.fit.pose) - self._mesh.centre_at(two.fit.pose)
        )
        return bool(apart > PASSES_AGREE_M or angle > PASSES_AGREE_DEG)


def _better_run(one: list[FrameResult], two: list[FrameResult]) -> list[FrameResult]:
    """Of two passes over the same frames the one that explains them better, flagged where the
    images do not decide."""
    kept = [(a, b) for a, b in zip(one, two, strict=True) if not (a.lost and b.lost)]
    gain = np.array([b.score - a.score for a, b in kept])
    better = two if len(gain) and gain.mean() > 0 else one
    unsure = not decided(gain)
    return [replace(frame, disagree=unsure and not frame.lost) for frame in better]


def _recovered(mesh: ObjectMesh, frames: list[FrameResult], seed_frame: int) -> list[FrameResult]:
    """The frames with ``recovered`` set: the first that is not lost after lost ones, or after the
    track leapt. Before the seed it ran backwards and leapt from the frame after."""
    result = list(frames)
    for t in range(1, len(frames)):
        if frames[t].lost:
            continue
        leapt = frames[t].leapt if t > seed_frame else frames[t - 1].leapt
        if frames[t - 1].lost or (leapt and _jumped(mesh, frames[t - 1], frames[t])):
            result[t] = replace(frames[t], recovered=True)
    return result


def _jumped(mesh: ObjectMesh, before: FrameResult, now: FrameResult) -> bool:
    """Whether the object moved farther in one frame than a hand can move it."""
    shift = float(np.linalg.norm(now.fit.pose[:3, 3] - before.fit.pose[:3, 3]))
    turn = mesh.symmetry.rotation_error_deg(now.fit.pose[:3, :3], before.fit.pose[:3, :3])
    return bool(shift > JUMP_M or turn > JUMP_DEG)
