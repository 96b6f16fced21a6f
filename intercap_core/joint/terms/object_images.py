"""What the images show of the object, looked at anew through corrected cameras.

Object images: E_O of equation 6 from the images, looked at anew in each round.

Every frame's evidence (equation 1, silhouettes and depth of every view v) is a quadratic form of
small steps x of the pose where it was looked at and of the cameras' corrections d_v,

    E(x, d, e) = sum_v |x + e - A_v d_v|^2 by I_v / 2 + g_v (x + e - A_v d_v),    e ~ N(0, F)

with A_v the step that a correction looks like. e is what the mesh differs from the thing itself: at
the best e the matrix of x is I - I K I, K = (I + F^-1)^-1, I = sum I_v. I_v is stated by how far
the views of a moment disagree; what they have in common, which the tracker adds to its covariance,
is here the cameras' and e. Frames in which the object is lost, or whose images contradict the pose,
stay near the track's, as in :mod:`.object_data`; evidence that is far from its own pose counts
little (Geman-McClure). No setting weighs E_O: its strength is the images'.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.camera.transforms import rigid, step_between
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import open_renderer
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.geometry.solve.time_series import rigid_velocity
from intercap_core.joint.cameras import BIAS, FREEDOMS, SHIFT, TURN, Cameras, Sights
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.sequential import TrackedPoses
from intercap_core.joint.state import OBJECT, State
from intercap_core.joint.terms.term import Term
from intercap_core.object_track.constants import (
    CONTRADICTED_LOG_RATIO,
    TRACKING_FACES,
    UNKNOWN_SIGMA,
)
from intercap_core.object_track.evidence import PoseEvidence, evidence_at, report_at, views_noise
from intercap_core.object_track.free_turns import free_turns, without_turns
from intercap_core.object_track.recording import ObjectRecording
from intercap_core.object_track.view_cache import ViewCache
from intercap_core.object_track.view_report import ViewReport

# Evidence of the images this many standard deviations from the pose counts a quarter. Tuned on the
# studio.
IMAGES_OUTLIER = 5.0
# Images that are kept as they were read, bytes: those of some hundred frames of six cameras. Others
# are read again in the next round.
VIEWS_KEPT_BYTES = 200_000_000


class ObjectImages:
    """The views of every moment, as the tracker sees them (equation 1: silhouettes and depth of
    the candidate that fits best, hidden by the person's mask).

    ``cameras`` (V,) places of those with images and a pose among the ``count`` of the rig; ``mesh``
    simplified.
    """

    def __init__(
        self,
        recording: ObjectRecording,
        mesh: ObjectMesh,
        settings: ObjectTrackSettings,
        labels: tuple[str, ...],
        threads: ThreadPool | None = None,
    ) -> None:
        """``threads`` look at a frame each where the CPU draws, None is one."""
        self._recording = recording
        self._views = ViewCache(recording.views, VIEWS_KEPT_BYTES)
        self._geometry = list(recording.geometry)
        self._settings, self._labels = settings, labels
        self._renderer = open_renderer(settings.render_on, threads=1)
        self._threads = ThreadPool()
        if threads is not None:
            self._threads = threads
        self.mesh, self.cameras = mesh.simplified(TRACKING_FACES), recording.cameras
        self.count = recording.count

    def take_cameras(self, cameras: Cameras) -> None:
        """See through these cameras from now on."""
        self._geometry = [
            given.corrected(
                cameras.rig[c],
                float(np.nan_to_num(cameras.depth_bias[c])),
                given.time_offset_s,
            )
            for c, given in zip(self.cameras, self._geometry, strict=True)
        ]

    def take_offsets(self, time_offset: np.ndarray) -> None:
        """Take the cameras to expose ``time_offset`` (C,) seconds late."""
        self._geometry = [
            given.corrected(given.camera, given.depth_bias_m, float(time_offset[c]))
            for c, given in zip(self.cameras, self._geometry, strict=True)
        ]

    def look(
        self, frames: Sequence[int], poses: np.ndarray, twists: np.ndarray
    ) -> dict[int, PoseEvidence]:
        """What each of ``frames`` says about its pose, of those (T, 4, 4) of an object that moves
        by ``twists`` (T, 6), without what facets seem to say of the turns of a round one."""
        found = self._threads.map(lambda t: self._look(t, poses[t], twists[t]), frames)
        return dict(zip(frames, found, strict=True))

    def compare(
        self, frames: Sequence[int], poses: np.ndarray, twists: np.ndarray, camera: np.ndarray
    ) -> dict[int, ViewReport]:
        """How the one ``camera`` (T,) of each of ``frames`` agrees with its pose, of those (T, 4,
        4) of an object that moves by ``twists`` (T, 6), where it has an image and a pose."""
        place = {c: number for number, c in enumerate(self.cameras)}
        shown = [t for t in frames if int(camera[t]) in place]

        def one(t: int) -> ViewReport:
            number = place[int(camera[t])]
            kept = self._views.kept(t)
            view = self._recording.view(t, number) if kept is None else kept[number]
            return report_at(
                self.mesh,
                view.through(self._geometry[number]),
                poses[t],
                min_overlap=self._settings.min_overlap,
                labels=self._labels,
                twist=twists[t],
                renderer=self._renderer,
            )

        return dict(zip(shown, self._threads.map(one, shown), strict=True))

    def _look(self, t: int, pose: np.ndarray, twist: np.ndarray) -> PoseEvidence:
        views = [
            view.through(geometry)
            for view, geometry in zip(self._views(t), self._geometry, strict=True)
        ]
        found = evidence_at(
            self.mesh,
            views,
            pose,
            min_overlap=self._settings.min_overlap,
            background_term=self._settings.background_term,
            labels=self._labels,
            twist=twist,
            renderer=self._renderer,
        )
        turns = free_turns(self.mesh, pose)
        depth = without_turns(found.of_depth, found.depth_gradient, turns)
        contour = without_turns(
            found.information - found.of_depth, found.gradient - found.depth_gradient, turns
        )
        return PoseEvidence(
            depth[0] + contour[0], depth[1] + contour[1], depth[0], depth[1], found.reports
        )

    def rays(self, place: np.ndarray) -> np.ndarray:
        """By how much (V, 3), metres, what is at ``place`` (3,) seems farther to each camera, for
        a metre of depth."""
        poses = np.array(
            [
                geometry.master_from_depth if geometry.camera.depth else geometry.master_from_colour
                for geometry in self._geometry
            ]
        )
        away = place - poses[:, :3, 3]
        return away / (away * poses[:, :3, 2]).sum(axis=1, keepdims=True)

    def centres(self) -> np.ndarray:
        """(V, 3) of the cameras, master frame."""
        return np.array([geometry.master_from_colour[:3, 3] for geometry in self._geometry])


@dataclass(frozen=True, eq=False)
class _Form:
    """A frame's ``matrix`` (6, 6) and ``slope`` (6,), less what the mesh's error takes; the
    ``weight`` of its evidence, K (``held``, (6, 6)) and the weighted ``gradient`` (6,)."""

    matrix: np.ndarray
    slope: np.ndarray
    weight: float
    held: np.ndarray
    gradient: np.ndarray


@dataclass(frozen=True, eq=False)
class _ByCameras:
    """A frame's ``hessian`` (D, D) and ``gradient`` (D,) by the corrections of its D / 7 views, and
    ``cross`` (6, D) with the object's step."""

    hessian: np.ndarray
    gradient: np.ndarray
    cross: np.ndarray


class ObjectImagesData(Term):
    """E_O of what ``images`` show of the tracked frames, and of the other poses of the track."""

    name = "object_data"

    def __init__(self, tracked: TrackedPoses, images: ObjectImages, share: float) -> None:
        """``share`` of an independent observation that a frame is."""
        self._tracked, self._images, self._share = tracked, images, share
        self._looked = rigid(tracked.rotation, tracked.translation)
        self._matrix = tracked.information
        self._gradient = np.zeros((len(tracked.seen), 6))
        self._by_cameras: dict[int, _ByCameras] = {}
        self._found: dict[int, PoseEvidence] = {}  # at the last look
        self._agree: dict[int, PoseEvidence] = {}  # of them, those that do not contradict it
        self._noise = 1.0

    def take_cameras(self, cameras: Cameras) -> None:
        """See through these cameras from the next look on."""
        self._images.take_cameras(cameras)

    def take_offsets(self, time_offset: np.ndarray) -> None:
        """Take the cameras to expose so late (C,), seconds, from the next look on."""
        self._images.take_offsets(time_offset)

    def refresh(self, state: State) -> None:
        """Look at the images at ``state``."""
        poses = rigid(state.rotation, state.translation)
        found = self._look(poses)
        agree = {t: evidence for t, evidence in found.items() if not _contradicts(evidence)}
        self._found, self._agree = found, agree
        self._noise = views_noise(list(agree.values()))
        tracked = self._tracked
        self._looked = rigid(tracked.rotation, tracked.translation)
        self._matrix = tracked.information.copy()
        self._gradient = np.zeros((len(tracked.seen), 6))
        self._by_cameras = {}
        for t, evidence in agree.items():
            self._looked[t] = poses[t]
            self._take(t, evidence)

    def contradicted(self, state: State) -> np.ndarray:
        """Tracked frames (T,) bool whose images contradict the object's pose at ``state``."""
        found = self._look(rigid(state.rotation, state.translation))
        wrong = np.zeros(len(state), bool)
        wrong[[t for t, evidence in found.items() if _contradicts(evidence)]] = True
        return wrong

    def _look(self, poses: np.ndarray) -> dict[int, PoseEvidence]:
        """The evidence of every tracked frame at its pose (T, 4, 4)."""
        frames = np.flatnonzero(self._tracked.seen).tolist()
        return self._images.look(frames, poses, self._motion(poses))

    def _motion(self, poses: np.ndarray) -> np.ndarray:
        """Twists (T, 6) of the tracked frames' poses (T, 4, 4)."""
        tracked = self._tracked
        motion = rigid_velocity(poses, tracked.seen, tracked.times)
        motion[tracked.resting] = 0
        return motion

    def _take(self, t: int, evidence: PoseEvidence) -> None:
        """Hold the frame's quadratic form."""
        form = self._form(t, evidence.information.sum(0), evidence.gradient.sum(0))
        self._matrix[t], self._gradient[t] = form.matrix, form.slope
        self._by_cameras[t] = self._seen_by(
            t, evidence, form.weight / self._noise, form.held, form.gradient
        )

    def _form(self, t: int, information: np.ndarray, gradient: np.ndarray) -> _Form:
        """Of what all views of a frame say, ``information`` (6, 6) and ``gradient`` (6,)."""
        information, gradient = information / self._noise, gradient / self._noise
        own = -np.linalg.solve(information + np.diag(UNKNOWN_SIGMA**-2), gradient)
        weight = geman_mcclure_weight(own @ information @ own, IMAGES_OUTLIER)
        information, gradient = weight * information, weight * gradient
        held = np.linalg.inv(information + np.diag(1 / self._tracked.spread[t]))  # K
        freed = np.eye(6) - information @ held
        return _Form(freed @ information, freed @ gradient, weight, held, gradient)

    def of_views(self, used: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E_O's matrix (T, 6, 6), gradient (T, 6) and energy (T,) at ``state``, of the last look,
        by the views ``used`` (T, C) alone."""
        matrix, gradient = self._matrix.copy(), self._gradient.copy()
        for t, evidence in self._agree.items():
            views = used[t, list(self._images.cameras)]
            form = self._form(
                t, evidence.information[views].sum(0), evidence.gradient[views].sum(0)
            )
            matrix[t], gradient[t] = form.matrix, form.slope
        return _equations(matrix, gradient, self._offset(state))

    def compare(self, state: State, camera: np.ndarray) -> Iterator[tuple[int, int, ViewReport]]:
        """Frame, camera, and how its view agrees with ``state``, of the one ``camera`` (T,) of each
        tracked frame; the last look stays."""
        poses = rigid(state.rotation, state.translation)
        frames = np.flatnonzero(self._tracked.seen).tolist()
        for t, report in self._images.compare(frames, poses, self._motion(poses), camera).items():
            yield t, int(camera[t]), report

    def reports(self) -> Iterator[tuple[int, int, ViewReport]]:
        """Frame, camera, and how its view agreed with the pose of the last look."""
        for t, evidence in self._found.items():
            for camera, report in zip(self._images.cameras, evidence.reports, strict=True):
                yield t, camera, report

    def _seen_by(
        self,
        t: int,
        evidence: PoseEvidence,
        weight: float,
        held: np.ndarray,
        gradient: np.ndarray,
    ) -> _ByCameras:
        """The frame's form by the corrections of all views, less what the mesh's error takes."""
        place = self._looked[t, :3, 3]
        arms, rays = place - self._images.centres(), self._images.rays(place)
        count = len(arms)
        steps = np.zeros((2, count, 6, FREEDOMS))  # A_v of silhouettes and of depth
        steps[:, :, :3, TURN] = np.eye(3)
        steps[:, :, 3:, TURN] = np.cross(np.eye(3), arms[:, None]).transpose(0, 2, 1)
        steps[:, :, 3:, SHIFT] = np.eye(3)
        steps[1, :, 3:, BIAS] = -rays
        of_depth = weight * evidence.of_depth, weight * evidence.depth_gradient
        of_contour = (
            weight * evidence.information - of_depth[0],
            weight * evidence.gradient - of_depth[1],
        )
        size = count * FREEDOMS
        hessian, pull = np.zeros((count, FREEDOMS, count, FREEDOMS)), np.zeros((count, FREEDOMS))
        cross = np.zeros((6, count, FREEDOMS))
        each = np.arange(count)
        for step, (information, slope) in zip(steps, (of_contour, of_depth), strict=True):
            seen = information @ step
            hessian[each, :, each] += step.transpose(0, 2, 1) @ seen
            pull -= np.einsum("vif,vi->vf", step, slope)
            cross += seen.transpose(1, 0, 2)
        flat = cross.reshape(6, size)
        freed = np.eye(6) - weight * evidence.information.sum(0) @ held
        return _ByCameras(
            hessian.reshape(size, size) - flat.T @ held @ flat,
            pull.ravel() + flat.T @ held @ gradient,
            -freed @ flat,
        )

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add E_O at ``state``, as of the last :meth:`refresh`."""
        found = _equations(self._matrix, self._gradient, self._offset(state))
        equations.add_blocks(self.name, OBJECT, *found)

    def sights(self, state: State) -> Sights:
        """What the frames that were looked at say of pose and cameras, at ``state``."""
        offset, count = self._offset(state), self._images.count
        columns = np.concatenate(
            [np.arange(FREEDOMS * c, FREEDOMS * (c + 1)) for c in self._images.cameras]
        )
        size = FREEDOMS * count
        hessian, pull, cross = (
            np.zeros((size, size)),
            np.zeros(size),
            np.zeros((len(offset), 6, size)),
        )
        for t, found in self._by_cameras.items():
            hessian[np.ix_(columns, columns)] += found.hessian
            pull[columns] += found.gradient + found.cross.T @ offset[t]
            cross[t][:, columns] = found.cross
        gradient = np.einsum("tij,tj->ti", self._matrix, offset) + self._gradient
        matrix = self._matrix + np.diag(UNKNOWN_SIGMA**-2)
        # what lasts is not seen in how the views of a moment differ: the variance as stated
        share = self._share * self._noise
        return Sights(OBJECT, matrix, gradient, cross, hessian, pull, share)

    def _offset(self, state: State) -> np.ndarray:
        return step_between(self._looked, rigid(state.rotation, state.translation))


def _equations(
    matrix: np.ndarray, slope: np.ndarray, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrix, gradient and energy (T,), 0 at the lowest, of forms (T, 6, 6) and (T, 6) where poses
    were looked at, ``offset`` (T, 6) from there."""
    bent = np.einsum("tij,tj->ti", matrix, offset)
    lowest = np.linalg.solve(matrix + np.diag(UNKNOWN_SIGMA**-2), slope[..., None])[..., 0]
    energy = 0.5 * (offset * bent + lowest * slope) + offset * slope
    return matrix, bent + slope, energy.sum(axis=1)


def _contradicts(evidence: PoseEvidence) -> bool:
    """Whether the views say that the object is not at this pose."""
    return sum(view.log_ratio for view in evidence.reports) < CONTRADICTED_LOG_RATIO
