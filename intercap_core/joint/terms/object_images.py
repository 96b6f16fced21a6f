"""Object images: E_O of equation 6 from the images, which are compared again in each round.

The evidence of a frame is that of equation 1: silhouettes and depth of every view v. It is a
quadratic form of a small step x of the object's pose and of corrections d_v of the cameras,

    E(x, d, e) = sum_v (y_v^T I_v y_v / 2 + g_v^T y_v) + e^T F^-1 e / 2,    y_v = x + e - A_v d_v

y_v is the step that view v sees, I_v and g_v are the matrix and gradient of its evidence. A_v d_v
is the apparent step of the object due to a correction of camera v. e is the pose error due to
differences between mesh and object and to ambiguity. Its variances F (diagonal) are those that the
track adds to its covariance (``spread``). Minimised over e, the matrix of x is I - I K I with
K = (I + F^-1)^-1 and I = sum I_v.

The I_v and g_v of all frames are divided by one factor (``_noise``), which follows from the
disagreement of the views. A frame whose own minimum is far from
the compared pose has little weight (Geman-McClure). Frames in which the object is lost, or whose
images contradict the pose, stay near the tracked pose, as in :mod:`.object_data`.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.camera.transforms import rigid, step_between
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import Renderer
from intercap_core.geometry.solve.robust import OUTLIER_SIGMAS, geman_mcclure_weight
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
from intercap_core.object_track.view import FitContext, View
from intercap_core.object_track.view_report import ViewReport


class ObjectImages:
    """The object's images, with which poses are compared as in the tracker (equation 1).

    Silhouettes and depth are those of the best candidate of each view, occluded by the person.

    Attributes:
        recording: images and candidates of the V cameras that have images and a pose.
        first: index in the recording of frame 0.
        views: cache of the frames' views.
        mesh: simplified mesh of the object.
        context: renderer and settings of the comparison.
        threads: pool; each thread compares one frame.
    """

    def __init__(
        self,
        recording: ObjectRecording,
        mesh: ObjectMesh,
        settings: ObjectTrackSettings,
        labels: tuple[str, ...],
        threads: ThreadPool,
    ) -> None:
        self.recording, self.threads = recording, threads
        self.first = 0
        self.views = self._cache()
        self.mesh = mesh.simplified(TRACKING_FACES)
        renderer = Renderer(threads=1)
        self.context = FitContext(
            self.mesh, labels, settings.min_overlap, settings.background_term, renderer
        )

    def _cache(self, **limits: int) -> ViewCache:
        """An empty cache."""
        recording, first = self.recording, self.first  # no reference to self: it frees the cache
        return ViewCache(lambda t: recording.views(first + t), **limits)

    def view(self, t: int, place: int) -> View:
        """View of camera number ``place`` of the recording in frame t; not cached."""
        return self.recording.view(self.first + t, place)

    def window(self, frames: slice) -> ObjectImages:
        """The images from frame ``frames.start`` on."""
        window = copy(self)
        window.first = self.first + frames.start
        window.views = window._cache()
        return window

    def uncached(self) -> ObjectImages:
        """The same images for a caller that compares each frame once, without a cache of views."""
        single = copy(self)
        single.views = single._cache(max_bytes=0)
        return single


@dataclass(frozen=True, eq=False)
class _Form:
    """Quadratic form of a frame's evidence by the object's step, at the best error of the mesh."""

    matrix: np.ndarray  # (6, 6) I - I K I
    slope: np.ndarray  # (6,) gradient at the best error of the mesh
    weight: float  # Robust weight of the evidence
    mesh: np.ndarray  # (6, 6) K
    gradient: np.ndarray  # (6,) weighted gradient without an error of the mesh


@dataclass(frozen=True, eq=False)
class _ByCameras:
    """The same form by the corrections of the frame's V views, D = 7 V."""

    hessian: np.ndarray  # (D, D)
    gradient: np.ndarray  # (D,)
    cross: np.ndarray  # (6, D) with the object's step


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
        """``share`` is the weight of a frame in the correction of the cameras."""
        self._tracked, self._images, self._share = tracked, images, share
        self._cameras = images.recording.cameras
        self._geometry = list(images.recording.geometry)
        self._compared = rigid(tracked.rotation, tracked.translation)  # poses of the comparison
        self._matrix = tracked.information
        self._gradient = np.zeros((len(tracked.seen), 6))
        self._by_cameras: dict[int, _ByCameras] = {}
        self._evidence: dict[int, ImageEvidence] = {}  # of the last refresh, by frame
        self._agreeing: dict[int, ImageEvidence] = {}  # that does not contradict its pose
        self._noise = 1.0
        self._every = 1  # tracked frames that a compared one stands for

    def take_cameras(self, cameras: Cameras) -> None:
        """Use these poses and depth biases from the next :meth:`refresh` on."""
        self._geometry = [
            replace(
                given,
                camera=cameras.rig[c],
                depth_bias_m=float(np.nan_to_num(cameras.depth_bias[c])),
            )
            for c, given in zip(self._cameras, self._geometry, strict=True)
        ]

    def refresh(self, state: State, every: int = 1) -> None:
        """Compare the images with ``state``.

        ``every`` compares every n-th tracked frame only, for a correction of the cameras.
        """
        poses, self._every = rigid(state.rotation, state.translation), every
        self._evidence = self._compare_images(poses)
        self._agreeing = {
            t: evidence
            for t, evidence in self._evidence.items()
            if sum(view.log_ratio for view in evidence.reports) >= CONTRADICTED_LOG_RATIO
        }
        self._noise = views_noise(list(self._agreeing.values()))
        tracked = self._tracked
        self._compared = rigid(tracked.rotation, tracked.translation)
        self._matrix = tracked.information.copy()
        self._gradient = np.zeros((len(tracked.seen), 6))
        self._by_cameras = {}
        for t, evidence in self._agreeing.items():
            self._compared[t] = poses[t]
            form = self._form(t, evidence.information.sum(0), evidence.gradient.sum(0))
            self._matrix[t], self._gradient[t] = form.matrix, form.slope
            self._by_cameras[t] = self._linearise_cameras(
                t, evidence, form.weight / self._noise, form.mesh, form.gradient
            )

    def contradicted(self) -> np.ndarray:
        """Mask (T,) of frames whose images contradict the object's pose at the last
        :meth:`refresh`."""
        contradicted = np.zeros(len(self._tracked.seen), bool)
        contradicted[list(self._evidence.keys() - self._agreeing.keys())] = True
        return contradicted

    def _compare_images(self, poses: np.ndarray) -> dict[int, ImageEvidence]:
        """Evidence of the tracked frames about these poses (T, 4, 4)."""
        frames = np.flatnonzero(self._tracked.seen)[:: self._every].tolist()
        twists = self._motion(poses)
        evidence = self._images.threads.map(
            lambda t: self._compare_frame(t, poses[t], twists[t]), frames
        )
        return dict(zip(frames, evidence, strict=True))

    def _compare_frame(self, t: int, pose: np.ndarray, twist: np.ndarray) -> ImageEvidence:
        """Evidence of frame ``t``; none for turns about the axes of a round object."""
        views = [
            view.through(geometry)
            for view, geometry in zip(self._images.views(t), self._geometry, strict=True)
        ]
        full = evidence_at(self._images.context, views, pose, twist)
        turns = free_turns(self._images.mesh, pose)
        depth = without_turns(full.of_depth, full.depth_gradient, turns)
        contour = without_turns(
            full.information - full.of_depth, full.gradient - full.depth_gradient, turns
        )
        return ImageEvidence(
            depth[0] + contour[0], depth[1] + contour[1], depth[0], depth[1], full.reports
        )

    def _motion(self, poses: np.ndarray) -> np.ndarray:
        """Motion per second (T, 6) of the object through poses (T, 4, 4)."""
        tracked = self._tracked
        motion = rigid_velocity(poses, tracked.seen, tracked.times)
        motion[tracked.resting] = 0
        return motion

    def _form(self, t: int, information: np.ndarray, gradient: np.ndarray) -> _Form:
        """Form of the sum over views, ``information`` (6, 6) and ``gradient`` (6,)."""
        information, gradient = information / self._noise, gradient / self._noise
        # step from the compared pose to the minimum of this frame's evidence
        own = -np.linalg.solve(information + np.diag(UNKNOWN_SIGMA**-2), gradient)
        weight = geman_mcclure_weight(own @ information @ own, OUTLIER_SIGMAS)
        information, gradient = weight * information, weight * gradient
        mesh = np.linalg.inv(information + np.diag(1 / self._tracked.spread[t]))  # K
        freed = np.eye(6) - information @ mesh
        return _Form(freed @ information, freed @ gradient, weight, mesh, gradient)

    def linearise_views(
        self, used: np.ndarray, state: State
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E_O's matrix (T, 6, 6), gradient (T, 6) and energy (T,) at ``state`` by some images.

        Only silhouettes and depth images in the mask ``used`` (T, C, 2) count, as compared in the
        last :meth:`refresh`.
        """
        matrix, gradient = self._matrix.copy(), self._gradient.copy()
        for t, evidence in self._agreeing.items():
            contour, depth = used[t, list(self._cameras)].T.astype(float)
            information = np.einsum("v,vij->ij", contour, evidence.information)
            information += np.einsum("v,vij->ij", depth - contour, evidence.of_depth)
            slope = contour @ evidence.gradient + (depth - contour) @ evidence.depth_gradient
            form = self._form(t, information, slope)
            matrix[t], gradient[t] = form.matrix, form.slope
        return _equations(matrix, gradient, self._offset(state))

    def compare(self, state: State, camera: np.ndarray) -> Iterator[tuple[int, int, ViewReport]]:
        """Agreement of one view of each tracked frame with ``state``: frame, camera, report.

        ``camera`` (T,) is the index of the view's camera; a frame whose camera has no image or no
        pose is left out. What the last :meth:`refresh` stored does not change.
        """
        images, poses = self._images, rigid(state.rotation, state.translation)
        twists = self._motion(poses)
        place = {c: number for number, c in enumerate(self._cameras)}
        frames = [t for t in np.flatnonzero(self._tracked.seen).tolist() if camera[t] in place]

        def report(t: int) -> ViewReport:
            number = place[int(camera[t])]
            view = images.view(t, number)
            return report_at(
                images.context, view.through(self._geometry[number]), poses[t], twists[t]
            )

        for t, result in zip(frames, images.threads.map(report, frames), strict=True):
            yield t, int(camera[t]), result

    def reports(self) -> Iterator[tuple[int, int, ViewReport]]:
        """Agreement of all views at the last :meth:`refresh`: frame, camera, report."""
        for t, evidence in self._evidence.items():
            for camera, report in zip(self._cameras, evidence.reports, strict=True):
                yield t, camera, report

    def _linearise_cameras(
        self, t: int, evidence: ImageEvidence, weight: float, mesh: np.ndarray, gradient: np.ndarray
    ) -> _ByCameras:
        """Form of frame ``t`` by the corrections of all views, at the best error of the mesh.

        Args:
            t: frame.
            evidence: matrices and gradients of its views, as compared.
            weight: factor of the evidence: robust weight over noise.
            mesh: (6, 6) K of the module's header.
            gradient: (6,) weighted gradient by the object's step.
        """
        place = self._compared[t, :3, 3]
        arms = place - np.array([g.camera.master_from_colour[:3, 3] for g in self._geometry])
        depth_poses = np.array(
            [
                g.camera.master_from_depth if g.camera.depth else g.camera.master_from_colour
                for g in self._geometry
            ]
        )
        # rays from the depth cameras to the object, per metre of depth
        away = place - depth_poses[:, :3, 3]
        rays = away / (away * depth_poses[:, :3, 2]).sum(axis=1, keepdims=True)
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
        """Form of E_O by object and cameras at ``state``.

        The images are those of the last :meth:`refresh`.
        """
        frames = np.array(sorted(self._by_cameras), int)
        offset, size = self._offset(state)[frames], FREEDOMS * self._images.recording.count
        columns = np.concatenate(
            [np.arange(FREEDOMS * c, FREEDOMS * (c + 1)) for c in self._cameras]
        )
        hessian, pull = np.zeros((size, size)), np.zeros(size)
        cross = np.zeros((len(offset), 6, size))
        for at, t in enumerate(frames):
            form = self._by_cameras[t]
            hessian[np.ix_(columns, columns)] += form.hessian
            pull[columns] += form.gradient + form.cross.T @ offset[at]
            cross[at][:, columns] = form.cross
        own = self._matrix[frames]
        gradient = np.einsum("tij,tj->ti", own, offset) + self._gradient[frames]
        matrix = own + np.diag(UNKNOWN_SIGMA**-2)
        # ``_noise`` undoes the division of the matrices by it. It measures how much the views
        # disagree. Errors that all views have in common affect the cameras' corrections, but not
        # this disagreement, so that the variance as stated counts here
        share = self._share * self._noise * self._every
        return CameraEvidence(OBJECT, frames, matrix, gradient, cross, hessian, pull, share)

    def _offset(self, state: State) -> np.ndarray:
        return step_between(self._compared, rigid(state.rotation, state.translation))


def _equations(
    matrix: np.ndarray, slope: np.ndarray, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrix (T, 6, 6), gradient (T, 6) at ``offset`` and energy (T,) of quadratic forms.

    The energy is 0 at the minimum.

    Args:
        matrix: (T, 6, 6).
        slope: (T, 6) gradient at the compared poses.
        offset: (T, 6) step (turn, shift) from the compared poses to the state.
    """
    bent = np.einsum("tij,tj->ti", matrix, offset)
    lowest = np.linalg.solve(matrix + np.diag(UNKNOWN_SIGMA**-2), slope[..., None])[..., 0]
    energy = 0.5 * (offset * bent + lowest * slope) + offset * slope
    return matrix, bent + slope, energy.sum(axis=1)
