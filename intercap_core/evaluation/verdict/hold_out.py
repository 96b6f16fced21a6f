"""Held-out evaluation of a joint fit: one camera at a time, all depth, and every other frame.

The energy of the joint fit is a sum of terms with images, one part for each camera, and of terms
without images. At the result x it has the gradient g and the Gauss-Newton matrix H; g_c and H_c are
the parts of camera c. The fit without this camera is, to first order,

    x_c = x - (H - H_c)^-1 (g - g_c) + H^-1 g

The last term subtracts the step that the full problem itself would still make. Correspondences,
robust weights and contact are kept from x, so that a refit costs one linear solve. A refit iterated
to convergence with new correspondences would move the body 4 to 10 % further.

The cameras are fixed in these refits. Corrections d of the cameras (:mod:`intercap_core.joint.
cameras`) with the covariance S that the joint fit states move the fit by -H^-1 H_xd d, so that its
covariance grows by J S J^T with J = H^-1 H_xd. This part of the error is the same in all frames.

Long recordings are evaluated in windows of ``WINDOW`` frames with ``MARGIN`` further frames on
either side, since only neighbouring frames are coupled: memory does not grow with the recording.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Any

import numpy as np
import torch

from intercap_core.body.joints import BOTH_HANDS
from intercap_core.config import JointSettings
from intercap_core.joint.assembly import Assembly, assemble
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.inputs import JointInputs
from intercap_core.joint.minimise import limited
from intercap_core.joint.result import JointResult
from intercap_core.joint.state import (
    ALL,
    BODY,
    OBJECT,
    OBJECT_SHIFT,
    OBJECT_TURN,
    State,
    frame_chunks,
)
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.object_data import NoObject, ObjectData
from intercap_core.joint.terms.object_images import ObjectImagesData
from intercap_core.joint.windows import split_frames
from intercap_core.memory import return_freed_memory
from intercap_core.object_track.view_report import ViewReport


class JudgedPart(StrEnum):
    """A part of a result whose error is stated."""

    BODY = "body"
    HANDS = "hands"
    OBJECT = "object"


WINDOW = 300
"""Frames of a window whose results are kept; limited by memory, 4 MB a frame."""
MARGIN = 30
"""Further frames on either side. Windows of 150 instead of 300 frames change mean displacements by
at most 0.15 %, those of an object without every other frame by 0.6 % (bench/RESULTS.md)."""
SURFACE = 1
"""Index of surface points (depth, rims of the person's masks) in the last axis of masks (T, C, 2)
of the images that are used. Index 0 is that of keypoints and of the object's silhouettes."""


class Refits:
    """Refits around one ``state`` with subsets of the images.

    The terms of ``assembly`` must have been refreshed (linearised) at this state.

    Attributes:
        displaced: (T, 174, k) steps of the fit to all images by k further gradients.
    """

    def __init__(self, assembly: Assembly, state: State, gradients: np.ndarray) -> None:
        """``gradients`` (T, 174, k) are added in turn to that of the energy."""
        self.state = state
        self._seen: list[tuple[slice, BodyData | ObjectData | ObjectImagesData]] = [
            (BODY, assembly.body)
        ]
        if not isinstance(assembly.object_, NoObject):
            self._seen.append((OBJECT, assembly.object_))
        self._rest = BandedEquations(len(state), assembly.problem.threads)
        for term in assembly.problem.terms:
            if not any(term is seen for _, seen in self._seen):
                term.add(state, self._rest)
        return_freed_memory()
        self._bands = np.empty_like(self._rest.bands)
        everything = np.ones((len(state), assembly.body.num_cameras, 2), bool)
        solution = self._solve(everything, gradients)
        self._descent, self.displaced = solution[..., 0], solution[..., 1:]

    def with_images(self, used: np.ndarray) -> State:
        """The state fitted to the images in the mask ``used`` (T, C, 2)."""
        return self.state.moved(limited(self._solve(used)[..., 0] - self._descent))

    def _solve(self, used: np.ndarray, gradients: np.ndarray | None = None) -> np.ndarray:
        """Gauss-Newton step with the images ``used``, then those of ``gradients`` alone.

        The shape is (T, 174, 1 + k). NaN if the matrix is singular.
        """
        equations = self._rest.copy(self._bands)
        for columns, term in self._seen:
            equations.add_blocks(term.name, columns, *term.linearise_views(used, self.state))
        right = -equations.gradient[..., None]
        if gradients is not None:
            right = np.concatenate([right, -gradients], axis=2)
        solution = equations.solve(np.full(len(self.state), 1e-6), right)  # least damping of a fit
        return np.full(right.shape, np.nan) if solution is None else solution


class JudgedPoints:
    """Points by which each part is compared: joints, or the object's centre of mass.

    Attributes:
        weights: (K,) by part, sum to 1. Joints of the body weigh as the share of the skin that
            follows them, those of the hands alike.
    """

    def __init__(self, inputs: JointInputs) -> None:
        self._inputs = inputs
        skin = inputs.model.skinning_weights.double().mean(0).numpy()
        fingers = np.zeros(len(skin))
        fingers[BOTH_HANDS] = 1
        self.weights = {
            JudgedPart.BODY: skin / skin.sum(),
            JudgedPart.HANDS: fingers / fingers.sum(),
        }
        if inputs.geometry.has_object:
            self.weights[JudgedPart.OBJECT] = np.ones(1)

    def at(self, state: State) -> dict[JudgedPart, np.ndarray]:
        """Points (T, K, 3) of each part, metres."""
        model = self._inputs.model
        with torch.no_grad():
            posed = model(state.parameters(model), vertex_ids=np.array([0]))
        joints = posed.joints.double().numpy()
        found = {JudgedPart.BODY: joints, JudgedPart.HANDS: joints}
        if JudgedPart.OBJECT in self.weights:
            found[JudgedPart.OBJECT] = (self._arm(state) + state.translation)[:, None]
        return found

    def along(self, state: State, steps: np.ndarray) -> dict[JudgedPart, np.ndarray]:
        """Root sum of squares (T,) of the displacements of a part by ``steps`` (T, 174, k)."""
        model = self._inputs.model
        square = np.empty((len(state), len(self.weights[JudgedPart.BODY])))
        parameters = state.parameters(model)
        for frames in frame_chunks(len(state)):
            lin = model.linearise(parameters.frames(frames), vertex_ids=np.array([0]), joints=True)
            jacobian = lin.full()[:, 1:, :, BODY].double().numpy()
            moved = np.einsum("tjxn,tnk->tjxk", jacobian, steps[frames, BODY], optimize=True)
            square[frames] = (moved**2).sum(axis=(2, 3))
        found = {
            part: np.sqrt(square @ self.weights[part])
            for part in (JudgedPart.BODY, JudgedPart.HANDS)
        }
        if JudgedPart.OBJECT in self.weights:
            moved = steps[:, OBJECT_SHIFT] + np.cross(
                steps[:, OBJECT_TURN], self._arm(state)[..., None], axis=1
            )
            found[JudgedPart.OBJECT] = np.sqrt((moved**2).sum(axis=(1, 2)))
        return found

    def apart(
        self, points: dict[JudgedPart, np.ndarray], others: dict[JudgedPart, np.ndarray]
    ) -> dict[JudgedPart, np.ndarray]:
        """Weighted RMS distance (T,) of the points of each part."""
        return {
            part: np.sqrt(((others[part] - at) ** 2).sum(axis=2) @ self.weights[part])
            for part, at in points.items()
        }

    def _arm(self, state: State) -> np.ndarray:
        """Centre of mass (T, 3) relative to the object's origin, master axes, metres."""
        return state.rotation @ self._inputs.geometry.mesh.centre_of_mass


@dataclass(frozen=True, eq=False)
class ViewErrors:
    """Errors of a state in each image, (T, C); NaN if the image does not show the part."""

    keypoint_px: np.ndarray
    """Median reprojection error of the body's keypoints, px."""
    person_m: np.ndarray
    """Median distance of the person's points from the clothed skin, metres."""
    overlap: np.ndarray
    """Intersection over union of the object's mask and its render, 0 to 1."""
    object_depth_m: np.ndarray
    """Median depth error of the object, metres."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Result of a held-out evaluation of T frames; V cameras were held out in turn."""

    cameras: np.ndarray
    """(V,) indices of the cameras that were held out."""
    camera_index: np.ndarray
    """(T,) camera held out for this frame."""
    all_cameras: ViewErrors
    """Errors of the result itself, in all cameras."""
    held_out: ViewErrors
    """Errors in the held-out camera of a fit that did not use it."""
    shift: dict[JudgedPart, np.ndarray]
    """(V, T) by part, displacement if a camera is left out, metres."""
    surface: dict[JudgedPart, np.ndarray]
    """(T,) by part, displacement if no surface point is used, metres."""
    common: dict[JudgedPart, np.ndarray]
    """(T,) by part, standard deviation in space due to the cameras' covariance, metres; NaN if the
    fit does not compare the images of the part."""
    repeated: dict[JudgedPart, np.ndarray]
    """(T,) by part, displacement if the images of this and every other frame are not used,
    metres."""

    @classmethod
    def joined(cls, windows: Sequence[tuple[HeldOut, slice]]) -> HeldOut:
        """Join the evaluations of windows; the slices select the frames of each that are kept."""
        held, kept = zip(*windows, strict=True)

        def cut(values: list[np.ndarray], axis: int = -1) -> np.ndarray:
            """Join the kept frames of values; ``axis`` counts the frames."""
            parts = [
                value.take(np.arange(one.start, one.stop), axis)
                for value, one in zip(values, kept, strict=True)
            ]
            return np.concatenate(parts, axis)

        def join(name: str) -> Any:
            values = [getattr(one, name) for one in held]
            if isinstance(values[0], ViewErrors):
                errors = [vars(value) for value in values]
                return ViewErrors(**{key: cut([e[key] for e in errors], 0) for key in errors[0]})
            if isinstance(values[0], dict):
                return {part: cut([value[part] for value in values]) for part in values[0]}
            return cut(values)

        names = [field.name for field in fields(cls)[1:]]
        return cls(held[0].cameras, *(join(name) for name in names))


def hold_out(
    inputs: JointInputs, settings: JointSettings, result: JointResult, window: int = WINDOW
) -> HeldOut | None:
    """Refit ``result`` without each camera and without every other frame, and compare.

    None if fewer than two cameras show the person. Frames are evaluated in windows of about equal
    length, of at most ``window`` frames each.
    """
    cameras = np.flatnonzero(inputs.cameras_of_person)
    if len(cameras) < 2:
        return None
    held = [
        (_hold_out(inputs.window(at.used), settings, result.window(at.used), cameras), at.inner)
        for at in split_frames(len(result.state), window, MARGIN)
    ]
    return HeldOut.joined(held)


def _hold_out(
    inputs: JointInputs, settings: JointSettings, result: JointResult, cameras: np.ndarray
) -> HeldOut:
    """Evaluate one window of frames; ``cameras`` (V,) are those to hold out."""
    inputs = replace(inputs, images=inputs.images and inputs.images.uncached())
    assembly = assemble(inputs, settings)
    state = result.state
    _fix_to_result(assembly, result)
    assembly.problem.refresh(state)
    within = _errors_within(assembly)
    frames = inputs.frames.start + np.arange(len(state))
    pulls = _camera_pulls(assembly, state, result.camera_covariance)
    refits, points = Refits(assembly, state, pulls), JudgedPoints(inputs)
    everything = np.ones((*within.keypoint_px.shape, 2), bool)

    def without(frames: slice | np.ndarray, cameras: slice | int, kind: slice | int) -> State:
        used = everything.copy()
        used[frames, cameras, kind] = False
        return refits.with_images(used)

    whole = slice(None)
    by_camera = [without(whole, int(camera), whole) for camera in cameras]
    half = [without(frames % 2 == parity, whole, whole) for parity in (0, 1)]
    no_surface = without(whole, whole, SURFACE)
    common = points.along(state, refits.displaced)
    if isinstance(assembly.object_, ObjectData):
        common[JudgedPart.OBJECT] = np.full(len(state), np.nan)
    # For errors in images, the cameras are held out in turn for 0.2 s each: longer than the window
    # of velocities, and short enough that each has a turn in a recording of two seconds.
    block = frames // max(1, round(inputs.fps * 0.2))
    turn = block % len(cameras)
    mixed = _select_states(by_camera, turn)  # each frame from the fit without its held-out camera
    camera_index = cameras[turn]
    judged = _errors_in_held_out(assembly, mixed, camera_index)
    at = points.at(state)
    moved = [points.apart(at, points.at(other)) for other in by_camera]
    halves = _select_states(half, frames % 2)
    return HeldOut(
        cameras,
        camera_index,
        within,
        judged,
        shift={part: np.stack([each[part] for each in moved]) for part in at},
        surface=points.apart(at, points.at(no_surface)),
        common=common,
        repeated=points.apart(at, points.at(halves)),
    )


def _camera_pulls(assembly: Assembly, state: State, covariance: np.ndarray) -> np.ndarray:
    """Gradients (T, 174, k) due to independent corrections of the cameras, one deviation each.

    They are H_xd S^(1/2), with the ``covariance`` S (C, 7, C, 7). 0 for an object without images.
    """
    count = covariance.shape[0] * covariance.shape[1]
    variance, axes = np.linalg.eigh(covariance.reshape(count, count))
    root = axes * np.sqrt(variance.clip(min=0))
    pulls = np.zeros((len(state), ALL.stop, count))
    form = assembly.body.camera_evidence(state, 1.0)
    pulls[form.frames, BODY] = form.cross @ root
    if isinstance(assembly.object_, ObjectImagesData):
        form = assembly.object_.camera_evidence(state)
        pulls[form.frames, OBJECT] = form.cross @ root
    return pulls


def _fix_to_result(assembly: Assembly, result: JointResult) -> None:
    """Set cameras and contact to those of the result."""
    if assembly.contact is not None:
        assembly.contact.take_contact(result.probability, result.annotated)
    assembly.body.take_cameras(result.cameras)
    if isinstance(assembly.object_, ObjectImagesData):
        assembly.object_.take_cameras(result.cameras)


def _errors_within(assembly: Assembly) -> ViewErrors:
    """Errors in all cameras, at the state at which the terms were refreshed last."""
    images = assembly.object_
    return _view_errors(
        assembly.body, images.reports() if isinstance(images, ObjectImagesData) else ()
    )


def _errors_in_held_out(assembly: Assembly, state: State, camera: np.ndarray) -> ViewErrors:
    """Errors of ``state`` in the ``camera`` (T,) of each frame; NaN in the other cameras."""
    images = assembly.object_
    assembly.body.compare(state, camera)
    found = _view_errors(
        assembly.body, images.compare(state, camera) if isinstance(images, ObjectImagesData) else ()
    )
    mine = np.arange(found.keypoint_px.shape[1]) == camera[:, None]
    return ViewErrors(*(np.where(mine, values, np.nan) for values in vars(found).values()))


def _view_errors(body: BodyData, reports: Iterable[tuple[int, int, ViewReport]]) -> ViewErrors:
    """Errors of the body at its last comparison and of the object's (frame, camera, report)."""
    keypoint = body.residuals().keypoint_px
    overlap, depth = np.full((2, *keypoint.shape), np.nan)
    for t, camera, report in reports:
        overlap[t, camera] = report.overlap
        depth[t, camera] = report.depth_residual_m
    return ViewErrors(keypoint, body.person_by_view(), overlap, depth)


def _select_states(states: list[State], which: np.ndarray) -> State:
    """State whose frame t is that of ``states[which[t]]``.

    Parameters common to all frames (``betas``, ``expression``) are those of the first state.
    """
    frames, first = np.arange(len(which)), states[0]
    body, rotation, translation = (
        np.stack([getattr(state, name) for state in states])[which, frames]
        for name in ("body", "rotation", "translation")
    )
    return State(body, first.betas, first.expression, rotation, translation)
