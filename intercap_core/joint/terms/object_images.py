"""Object images: E_O of equation 6 from the images, which are compared again in each round.

The evidence of a frame (equation 1, silhouettes and depth of every view v) is a quadratic form of a
small step x of the object's pose and of corrections d_v of the cameras,

    E(x, d, e) = sum_v |x + e - A_v d_v|^2 by I_v / 2 + g_v (x + e - A_v d_v),    e ~ N(0, F)

A_v is the apparent step of the object under a correction of camera v. e is the difference between
mesh and object: at the best e the matrix of x is I - I K I with K = (I + F^-1)^-1 and I = sum I_v.
The scale of I_v follows from the disagreement of the views of a frame. Errors that all views share,
which the tracker adds to its covariance, are here explained by the cameras and by e.

Frames in which the object is lost, or whose images contradict the pose, stay near the tracked pose,
as in :mod:`.object_data`. Evidence that is far from its own pose has little weight (Geman-McClure).
No setting weighs E_O: its strength is that of the images.
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
from intercap_core.joint.cameras import BIAS, FREEDOMS, SHIFT, TURN, CameraEvidence, Cameras
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.sequential import TrackedPoses
from intercap_core.joint.state import OBJECT, State
from intercap_core.joint.terms.term import Equation, JointTerm
from intercap_core.object_track.evidence import (
    UNKNOWN_SIGMA,
    ImageEvidence,
    evidence_at,
    free_turns,
    report_at,
    views_noise,
    without_turns,
)
from intercap_core.object_track.likelihood import CONTRADICTED_LOG_RATIO
from intercap_core.object_track.recording import TRACKING_FACES, ObjectRecording, ViewCache
from intercap_core.object_track.view import FitContext
from intercap_core.object_track.view_report import ViewReport

# Standard deviations from its own pose at which evidence counts a quarter. Tuned on the studio.
IMAGES_OUTLIER = 5.0
# Memory for images that are kept between rounds, bytes: some hundred frames of six cameras.
VIEWS_KEPT_BYTES = 200_000_000


class ObjectImages:
    """The object's images, compared as in the tracker (equation 1).

    Silhouettes and depth are those of the best candidate of each view, occluded by the person.

    Attributes:
        cameras: (V,) indices of the cameras that have images and a pose.
        count: number of cameras of the rig.
        mesh: simplified mesh of the object.
    """

    def __init__(
        self,
        recording: ObjectRecording,
        mesh: ObjectMesh,
        settings: ObjectTrackSettings,
        labels: tuple[str, ...],
        threads: ThreadPool | None = None,
    ) -> None:
        """``threads`` compare a frame each; None for one thread."""
        self._recording = recording
        self._views = ViewCache(recording.views, VIEWS_KEPT_BYTES)
        self._geometry = list(recording.geometry)
        self._threads = ThreadPool()
        if threads is not None:
            self._threads = threads
        self.mesh, self.cameras = mesh.simplified(TRACKING_FACES), recording.cameras
        renderer = open_renderer(settings.render_on, threads=1)
        self._context = FitContext(
            self.mesh, labels, settings.min_overlap, settings.background_term, renderer
        )
        self.count = recording.count

    def take_cameras(self, cameras: Cameras) -> None:
        """Use these poses and depth biases."""
        self._geometry = [
            given.corrected(
                cameras.rig[c],
                float(np.nan_to_num(cameras.depth_bias[c])),
                given.time_offset_s,
            )
            for c, given in zip(self.cameras, self._geometry, strict=True)
        ]

    def take_offsets(self, time_offset: np.ndarray) -> None:
        """Use these time offsets (C,), seconds."""
        self._geometry = [
            given.corrected(given.camera, given.depth_bias_m, float(time_offset[c]))
            for c, given in zip(self.cameras, self._geometry, strict=True)
        ]

    def look(
        self, frames: Sequence[int], poses: np.ndarray, twists: np.ndarray
    ) -> dict[int, ImageEvidence]:
        """Evidence of each of ``frames`` about its pose.

        Turns about the axes of a round object have no evidence, although its facets show some.

        Args:
            poses: (T, 4, 4) master_from_object.
            twists: (T, 6) motion per second.
        """
        evidence = self._threads.map(lambda t: self._look(t, poses[t], twists[t]), frames)
        return dict(zip(frames, evidence, strict=True))

    def compare(
        self, frames: Sequence[int], poses: np.ndarray, twists: np.ndarray, camera: np.ndarray
    ) -> dict[int, ViewReport]:
        """Agreement of one view per frame with the object's pose.

        Frames whose camera has no image or no pose are left out.

        Args:
            poses: (T, 4, 4) master_from_object.
            twists: (T, 6) motion per second.
            camera: (T,) index of the camera.
        """
        place = {c: number for number, c in enumerate(self.cameras)}
        shown = [t for t in frames if int(camera[t]) in place]

        def report(t: int) -> ViewReport:
            number = place[int(camera[t])]
            kept = self._views.kept(t)
            view = self._recording.view(t, number) if kept is None else kept[number]
            seen = view.through(self._geometry[number])
            return report_at(self._context, seen, poses[t], twists[t])

        return dict(zip(shown, self._threads.map(report, shown), strict=True))

    def _look(self, t: int, pose: np.ndarray, twist: np.ndarray) -> ImageEvidence:
        views = [
            view.through(geometry)
            for view, geometry in zip(self._views(t), self._geometry, strict=True)
        ]
        found = evidence_at(self._context, views, pose, twist)
        turns = free_turns(self.mesh, pose)
        depth = without_turns(found.of_depth, found.depth_gradient, turns)
        contour = without_turns(
            found.information - found.of_depth, found.gradient - found.depth_gradient, turns
        )
        return ImageEvidence(
            depth[0] + contour[0], depth[1] + contour[1], depth[0], depth[1], found.reports
        )

    def rays(self, place: np.ndarray) -> np.ndarray:
        """Displacement (V, 3) of a point at ``place`` (3,) per metre of depth bias of each view."""
        poses = np.array(
            [
                geometry.master_from_depth if geometry.camera.depth else geometry.master_from_colour
                for geometry in self._geometry
            ]
        )
        away = place - poses[:, :3, 3]
        return away / (away * poses[:, :3, 2]).sum(axis=1, keepdims=True)

    def centres(self) -> np.ndarray:
        """Centres (V, 3) of the cameras, master frame."""
        return np.array([geometry.master_from_colour[:3, 3] for geometry in self._geometry])


@dataclass(frozen=True, eq=False)
class _Form:
    """Quadratic form of a frame's evidence by the object's step, at the best error of the mesh."""

    matrix: np.ndarray
    """(6, 6) I - I K I."""
    slope: np.ndarray
    """(6,) gradient at the best error of the mesh."""
    weight: float
    """Robust weight of the evidence."""
    mesh: np.ndarray
    """(6, 6) K."""
    gradient: np.ndarray
    """(6,) weighted gradient without an error of the mesh."""


@dataclass(frozen=True, eq=False)
class _ByCameras:
    """The same form by the corrections of the frame's V views, D = 7 V."""

    hessian: np.ndarray
    """(D, D)."""
    gradient: np.ndarray
    """(D,)."""
    cross: np.ndarray
    """(6, D) with the object's step."""


class ObjectImagesData(JointTerm):
    """E_O of the images of tracked frames, and of the track in other frames."""

    name = "object_data"
    equation = Equation(
        symbol="E_O",
        source="6",
        formula="equation 1 of every view, compared again in each round: a quadratic form of small "
        "steps of the pose and of the cameras",
        settings=("look_again",),
    )

    def __init__(self, tracked: TrackedPoses, images: ObjectImages, share: float) -> None:
        """``share`` is the share of an independent observation that a frame is."""
        self._tracked, self._images, self._share = tracked, images, share
        self._compared = rigid(tracked.rotation, tracked.translation)  # poses of the comparison
        self._matrix = tracked.information
        self._gradient = np.zeros((len(tracked.seen), 6))
        self._by_cameras: dict[int, _ByCameras] = {}
        self._evidence: dict[int, ImageEvidence] = {}  # of the last refresh, by frame
        self._agreeing: dict[int, ImageEvidence] = {}  # that does not contradict its pose
        self._noise = 1.0

    def take_cameras(self, cameras: Cameras) -> None:
        """Use these cameras from the next :meth:`refresh` on."""
        self._images.take_cameras(cameras)

    def take_offsets(self, time_offset: np.ndarray) -> None:
        """Use these time offsets (C,), seconds, from the next :meth:`refresh` on."""
        self._images.take_offsets(time_offset)

    def refresh(self, state: State) -> None:
        """Compare the images with ``state``."""
        poses = rigid(state.rotation, state.translation)
        self._evidence = self._look(poses)
        self._agreeing = {
            t: evidence for t, evidence in self._evidence.items() if not _contradicts(evidence)
        }
        self._noise = views_noise(list(self._agreeing.values()))
        tracked = self._tracked
        self._compared = rigid(tracked.rotation, tracked.translation)
        self._matrix = tracked.information.copy()
        self._gradient = np.zeros((len(tracked.seen), 6))
        self._by_cameras = {}
        for t, evidence in self._agreeing.items():
            self._compared[t] = poses[t]
            self._take(t, evidence)

    def contradicted(self, state: State) -> np.ndarray:
        """Mask (T,) of tracked frames whose images contradict the object's pose at ``state``."""
        looked = self._look(rigid(state.rotation, state.translation))
        wrong = np.zeros(len(state), bool)
        wrong[[t for t, evidence in looked.items() if _contradicts(evidence)]] = True
        return wrong

    def _look(self, poses: np.ndarray) -> dict[int, ImageEvidence]:
        """Evidence of the tracked frames at these poses (T, 4, 4)."""
        frames = np.flatnonzero(self._tracked.seen).tolist()
        return self._images.look(frames, poses, self._motion(poses))

    def _motion(self, poses: np.ndarray) -> np.ndarray:
        """Motion per second (T, 6) of the object through poses (T, 4, 4)."""
        tracked = self._tracked
        motion = rigid_velocity(poses, tracked.seen, tracked.times)
        motion[tracked.resting] = 0
        return motion

    def _take(self, t: int, evidence: ImageEvidence) -> None:
        """Set the quadratic form of frame ``t``."""
        form = self._form(t, evidence.information.sum(0), evidence.gradient.sum(0))
        self._matrix[t], self._gradient[t] = form.matrix, form.slope
        self._by_cameras[t] = self._seen_by(
            t, evidence, form.weight / self._noise, form.mesh, form.gradient
        )

    def _form(self, t: int, information: np.ndarray, gradient: np.ndarray) -> _Form:
        """Form of the sum over views, ``information`` (6, 6) and ``gradient`` (6,)."""
        information, gradient = information / self._noise, gradient / self._noise
        own = -np.linalg.solve(information + np.diag(UNKNOWN_SIGMA**-2), gradient)
        weight = geman_mcclure_weight(own @ information @ own, IMAGES_OUTLIER)
        information, gradient = weight * information, weight * gradient
        mesh = np.linalg.inv(information + np.diag(1 / self._tracked.spread[t]))  # K
        freed = np.eye(6) - information @ mesh
        return _Form(freed @ information, freed @ gradient, weight, mesh, gradient)

    def of_views(self, used: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E_O's matrix (T, 6, 6), gradient (T, 6) and energy (T,) at ``state`` of some views.

        ``used`` (T, C) masks the views; the images are those of the last :meth:`refresh`.
        """
        matrix, gradient = self._matrix.copy(), self._gradient.copy()
        for t, evidence in self._agreeing.items():
            views = used[t, list(self._images.cameras)]
            form = self._form(
                t, evidence.information[views].sum(0), evidence.gradient[views].sum(0)
            )
            matrix[t], gradient[t] = form.matrix, form.slope
        return _equations(matrix, gradient, self._offset(state))

    def compare(self, state: State, camera: np.ndarray) -> Iterator[tuple[int, int, ViewReport]]:
        """Agreement of one view of each tracked frame with ``state``: frame, camera, report.

        ``camera`` (T,) names the views. The result of the last :meth:`refresh` stays.
        """
        poses = rigid(state.rotation, state.translation)
        frames = np.flatnonzero(self._tracked.seen).tolist()
        for t, report in self._images.compare(frames, poses, self._motion(poses), camera).items():
            yield t, int(camera[t]), report

    def reports(self) -> Iterator[tuple[int, int, ViewReport]]:
        """Agreement of all views at the last :meth:`refresh`: frame, camera, report."""
        for t, evidence in self._evidence.items():
            for camera, report in zip(self._images.cameras, evidence.reports, strict=True):
                yield t, camera, report

    def _seen_by(
        self,
        t: int,
        evidence: ImageEvidence,
        weight: float,
        mesh: np.ndarray,
        gradient: np.ndarray,
    ) -> _ByCameras:
        """Form of frame ``t`` by the corrections of all views, at the best error of the mesh."""
        place = self._compared[t, :3, 3]
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
        freed = np.eye(6) - weight * evidence.information.sum(0) @ mesh
        return _ByCameras(
            hessian.reshape(size, size) - flat.T @ mesh @ flat,
            pull.ravel() + flat.T @ mesh @ gradient,
            -freed @ flat,
        )

    def add(self, state: State, equations: BandedEquations) -> None:
        """Add E_O at ``state``, as of the last :meth:`refresh`."""
        form = _equations(self._matrix, self._gradient, self._offset(state))
        equations.add_blocks(self.name, OBJECT, *form)

    def camera_evidence(self, state: State) -> CameraEvidence:
        """Evidence of the cameras at ``state``, of the last :meth:`refresh`."""
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
        for t, form in self._by_cameras.items():
            hessian[np.ix_(columns, columns)] += form.hessian
            pull[columns] += form.gradient + form.cross.T @ offset[t]
            cross[t][:, columns] = form.cross
        gradient = np.einsum("tij,tj->ti", self._matrix, offset) + self._gradient
        matrix = self._matrix + np.diag(UNKNOWN_SIGMA**-2)
        # lasting errors do not show in the disagreement of the views: the variance as stated
        share = self._share * self._noise
        return CameraEvidence(OBJECT, matrix, gradient, cross, hessian, pull, share)

    def _offset(self, state: State) -> np.ndarray:
        return step_between(self._compared, rigid(state.rotation, state.translation))


def _equations(
    matrix: np.ndarray, slope: np.ndarray, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrix, gradient and energy (T,) of quadratic forms, with energy 0 at the minimum.

    Args:
        matrix: (T, 6, 6).
        slope: (T, 6) gradient at the compared poses.
        offset: (T, 6) from the compared poses.
    """
    bent = np.einsum("tij,tj->ti", matrix, offset)
    lowest = np.linalg.solve(matrix + np.diag(UNKNOWN_SIGMA**-2), slope[..., None])[..., 0]
    energy = 0.5 * (offset * bent + lowest * slope) + offset * slope
    return matrix, bent + slope, energy.sum(axis=1)


def _contradicts(evidence: ImageEvidence) -> bool:
    """Whether the images contradict the object's pose."""
    return sum(view.log_ratio for view in evidence.reports) < CONTRADICTED_LOG_RATIO
