"""Held-out evaluation of a joint fit: one camera at a time, and every other frame.

The energy of the joint fit is a sum of terms with images, one part for each camera, and of terms
without images. At the result x it has the gradient g and the Gauss-Newton matrix H; g_c and H_c are
the parts of camera c. The fit without this camera is, to first order,

    x_c = x - (H - H_c)^-1 (g - g_c) + H^-1 g

The last term subtracts the step that the full problem itself would still make. Correspondences,
robust weights and contact are kept from x, so that a refit costs one linear solve. A refit iterated
to convergence with new correspondences would move the body 4 to 10 % further.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch

from intercap_core.config import JointSettings
from intercap_core.evaluation.body import BODY_JOINTS, BOTH_HANDS
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.fit import Assembly, assemble
from intercap_core.joint.inputs import JointInputs
from intercap_core.joint.minimise import limited
from intercap_core.joint.result import JointResult
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.object_data import NoObject, ObjectData
from intercap_core.joint.terms.object_images import ObjectImagesData
from intercap_core.object_track.view_report import ViewReport


class JudgedPart(StrEnum):
    """A part of a result whose error is stated."""

    BODY = "body"
    HANDS = "hands"
    OBJECT = "object"


class Refits:
    """Refits around one ``state`` with subsets of the images.

    The terms of ``assembly`` must have been refreshed (linearised) at this state.
    """

    def __init__(self, assembly: Assembly, state: State) -> None:
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
        self._bands = np.empty_like(self._rest.bands)
        every = np.ones((len(state), len(assembly.body.time_offset)), bool)
        self._descent = self._step(every)

    def with_views(self, used: np.ndarray) -> State:
        """The state fitted to the images in the mask ``used`` (T, C)."""
        return self.state.moved(limited(self._step(used) - self._descent))

    def _step(self, used: np.ndarray) -> np.ndarray:
        """Gauss-Newton step with the images in the mask ``used`` (T, C); NaN if it is singular."""
        equations = self._rest.copy(self._bands)
        for columns, term in self._seen:
            equations.add_blocks(term.name, columns, *term.linearise_views(used, self.state))
        step = equations.step(np.full(len(self.state), 1e-6))  # the least damping of the fit
        if step is None:  # some parameter is not determined
            return np.full(self._rest.gradient.shape, np.nan)
        return step


# Joints (slices of the 55) by which body and hands are compared.
JOINTS = {JudgedPart.BODY: BODY_JOINTS, JudgedPart.HANDS: BOTH_HANDS}


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
    keypoint_m: np.ndarray
    """(T,) keypoint error in the held-out camera, converted to metres at the person's distance."""
    shift: dict[JudgedPart, np.ndarray]
    """(V, T) by part, displacement if a camera is left out, metres."""
    repeated: dict[JudgedPart, np.ndarray]
    """(T,) by part, displacement if the images of this and every other frame are not used,
    metres."""


def hold_out(inputs: JointInputs, settings: JointSettings, result: JointResult) -> HeldOut | None:
    """Refit ``result`` without each camera and without every other frame, and compare.

    None if fewer than two cameras show the person.
    """
    assembly = assemble(inputs, settings)
    state = result.state
    _fix_to_result(assembly, result)
    assembly.problem.refresh(state)
    within = _errors_within(assembly)
    seen = np.isfinite(within.keypoint_px).any(axis=0)
    cameras = np.flatnonzero(seen)
    if len(cameras) < 2:
        return None
    refits = Refits(assembly, state)
    everything = np.ones(within.keypoint_px.shape, bool)
    without = []
    for camera in cameras:
        used = everything.copy()
        used[:, camera] = False
        without.append(refits.with_views(used))
    half = []
    for first in (0, 1):
        used = everything.copy()
        used[first::2] = False
        half.append(refits.with_views(used))
    # For errors in images, the cameras are held out in turn for 0.2 s each: longer than the window
    # of velocities, and short enough that each has a turn in a recording of two seconds.
    block = np.arange(len(state)) // max(1, round(inputs.fps * 0.2))
    turn = block % len(cameras)
    mixed = _select_states(without, turn)  # each frame from the fit without its held-out camera
    camera_index = cameras[turn]
    judged = _errors_in_held_out(assembly, mixed, camera_index)
    points = _points(inputs, state)
    moved = [_points(inputs, other) for other in without]
    halves = _points(inputs, _select_states(half, np.arange(len(state)) % 2))
    return HeldOut(
        cameras,
        camera_index,
        within,
        judged,
        _pixels_to_metres(judged.keypoint_px, result, points[JudgedPart.BODY]),
        {
            part: np.stack([_rms(other[part] - at) for other in moved])
            for part, at in points.items()
        },
        {part: _rms(halves[part] - at) for part, at in points.items()},
    )


def _fix_to_result(assembly: Assembly, result: JointResult) -> None:
    """Set cameras, time offsets and contact to those of the result."""
    if assembly.contact is not None:
        assembly.contact.take_contact(result.probability, result.annotated)
    assembly.body.take_cameras(result.cameras, result.time_offset)
    assembly.object_.take_offsets(result.time_offset)
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


def _pixels_to_metres(pixels: np.ndarray, result: JointResult, joints: np.ndarray) -> np.ndarray:
    """Errors (T,) in metres at the mean depth of the body's ``joints`` (T, J, 3).

    ``pixels`` (T, C) has one finite value per frame.
    """
    rig = result.cameras.rig
    pose = rig.colour_from_master
    depth = joints.mean(axis=1) @ pose[:, 2, :3].T + pose[:, 2, 3]
    size = pixels * depth / rig.colour_parameters[:, 0]
    return np.where(np.isfinite(size).any(axis=1), np.nansum(size, axis=1), np.nan)


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


def _points(inputs: JointInputs, state: State) -> dict[JudgedPart, np.ndarray]:
    """Points (T, K, 3) by which each part is compared: joints, or the object's centre of mass."""
    with torch.no_grad():
        posed = inputs.model(state.parameters(inputs.model), vertex_ids=np.array([0]))
    joints = posed.joints.double().numpy()
    found = {part: joints[:, at] for part, at in JOINTS.items()}
    if inputs.geometry.has_object:
        centre = state.rotation @ inputs.geometry.mesh.centre_of_mass + state.translation
        found[JudgedPart.OBJECT] = centre[:, None]
    return found


def _rms(shift: np.ndarray) -> np.ndarray:
    """Root mean square length (T,) of (T, K, 3)."""
    return np.sqrt((shift**2).sum(axis=2).mean(axis=1))
