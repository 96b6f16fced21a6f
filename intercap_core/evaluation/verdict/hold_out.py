"""Held-out evaluation of a joint fit: one camera at a time, and every other frame.

The joint fit's energy at its minimum x is a sum of image terms of each camera and of terms without
images. Leaving out the rows of camera c and solving the normal equations once gives the fit without
this camera to first order:

    x_c = x - (H - H_c)^-1 (g - g_c) + H^-1 g

The last term removes the remaining descent of the full problem. Correspondences, robust weights and
contact stay as they are at x, so that a refit costs one linear solve. A refit iterated to
convergence with new correspondences moves the body 4 to 10 % further.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch

from intercap_core.config import JointSettings
from intercap_core.joint.constants import MIN_DAMPING
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.fit import Assembly, assemble
from intercap_core.joint.inputs import JointInputs
from intercap_core.joint.minimise import limited
from intercap_core.joint.result import JointResult
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.no_object import NoObject
from intercap_core.joint.terms.object_data import ObjectData
from intercap_core.joint.terms.object_images import ObjectImagesData
from intercap_core.object_track.view_report import ViewReport

# A camera judges the frames of this many seconds, then the next camera does. Longer than the window
# of velocities, short enough that every camera judges a recording of two seconds.
HELD_S = 0.2


class JudgedPart(StrEnum):
    """What is judged."""

    BODY = "body"
    HANDS = "hands"
    OBJECT = "object"


class Refits:
    """Refits around one ``state``, at which the ``assembly``'s terms were refreshed."""

    def __init__(self, assembly: Assembly, state: State) -> None:
        self.state = state
        self._seen: list[tuple[slice, BodyData | ObjectData | ObjectImagesData]] = [
            (BODY, assembly.body)
        ]
        if not isinstance(assembly.object_, NoObject):
            self._seen.append((OBJECT, assembly.object_))
        self._rest = NormalEquations(len(state), assembly.problem.threads)
        for term in assembly.problem.terms:
            if not any(term is seen for _, seen in self._seen):
                term.add(state, self._rest)
        self._bands = np.empty_like(self._rest.bands)
        every = np.ones((len(state), len(assembly.body.time_offset)), bool)
        self._descent = self._step(every)

    def with_views(self, used: np.ndarray) -> State:
        """The state that the views ``used`` (T, C) alone lead to."""
        return self.state.moved(limited(self._step(used) - self._descent))

    def _step(self, used: np.ndarray) -> np.ndarray:
        equations = self._rest.copy(self._bands)
        for columns, term in self._seen:
            equations.add_blocks(term.name, columns, *term.of_views(used, self.state))
        step = equations.step(np.full(len(self.state), MIN_DAMPING))
        if step is None:  # nothing holds some parameter: no step tells anything
            return np.full(self._rest.gradient.shape, np.nan)
        return step


JOINTS = {JudgedPart.BODY: slice(0, 22), JudgedPart.HANDS: slice(25, 55)}


@dataclass(frozen=True, eq=False)
class ViewErrors:
    """How far the image of each camera is from a state, (T, C); NaN = it shows nothing of it.

    ``keypoint_px`` median over the body's keypoints; ``person_m`` median distance of the person's
    points from the skin beyond clothes; ``overlap`` IoU of the object's mask and render;
    ``object_depth_m`` median error of its depth.
    """

    keypoint_px: np.ndarray
    person_m: np.ndarray
    overlap: np.ndarray
    object_depth_m: np.ndarray


@dataclass(frozen=True, eq=False)
class HeldOut:
    """The judgement.

    ``cameras`` (V,) that were held out, one after another; ``held`` (T,) the one that judges a
    frame, whose own errors are those of ``without``: of states that it has no part in. ``within``:
    of the result itself. ``keypoint_m`` (T,): the held camera's error of keypoints at the person's
    distance, metres. ``shift`` (V, T) metres by which each part moves without a camera,
    ``repeated`` (T,) by how much it is elsewhere where only the neighbouring frames are seen.
    """

    cameras: np.ndarray
    held: np.ndarray
    within: ViewErrors
    without: ViewErrors
    keypoint_m: np.ndarray
    shift: dict[JudgedPart, np.ndarray]
    repeated: dict[JudgedPart, np.ndarray]


def hold_out(inputs: JointInputs, settings: JointSettings, result: JointResult) -> HeldOut | None:
    """Refit ``result`` without each camera and from every other frame, and judge it by the rest.

    None where fewer than two cameras show the person: without one of them nothing is left.
    """
    assembly = assemble(inputs, settings)
    state = result.state
    _hold_fixed(assembly, result)
    assembly.problem.refresh(state)
    within = _within(assembly)
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
    block = np.arange(len(state)) // max(1, round(inputs.fps * HELD_S))
    turn = block % len(cameras)
    mixed = _taken(without, turn)
    held = cameras[turn]
    judged = _judged(assembly, mixed, held)
    points = _points(inputs, state)
    moved = [_points(inputs, other) for other in without]
    halves = _points(inputs, _taken(half, np.arange(len(state)) % 2))
    return HeldOut(
        cameras,
        held,
        within,
        judged,
        _at_person(judged.keypoint_px, result, points[JudgedPart.BODY]),
        {
            part: np.stack([_rms(other[part] - at) for other in moved])
            for part, at in points.items()
        },
        {part: _rms(halves[part] - at) for part, at in points.items()},
    )


def _hold_fixed(assembly: Assembly, result: JointResult) -> None:
    """Cameras, time offsets and contact as the result has them."""
    if assembly.contact is not None:
        assembly.contact.take_contact(result.probability, result.annotated)
    assembly.body.take_cameras(result.cameras, result.time_offset)
    assembly.object_.take_offsets(result.time_offset)
    if isinstance(assembly.object_, ObjectImagesData):
        assembly.object_.take_cameras(result.cameras)


def _within(assembly: Assembly) -> ViewErrors:
    """Of all cameras, at the state at which body and object were refreshed last."""
    images = assembly.object_
    return _view_errors(
        assembly.body, images.reports() if isinstance(images, ObjectImagesData) else ()
    )


def _judged(assembly: Assembly, state: State, held: np.ndarray) -> ViewErrors:
    """Those of the camera that judges each frame, ``held`` (T,), alone, at ``state``."""
    images = assembly.object_
    assembly.body.compare(state, held)
    found = _view_errors(
        assembly.body, images.compare(state, held) if isinstance(images, ObjectImagesData) else ()
    )
    mine = np.arange(found.keypoint_px.shape[1]) == held[:, None]
    return ViewErrors(*(np.where(mine, values, np.nan) for values in vars(found).values()))


def _view_errors(body: BodyData, reports: Iterable[tuple[int, int, ViewReport]]) -> ViewErrors:
    """Of the body as it was compared last, and the object's ``reports`` by frame and camera."""
    keypoint = body.residuals().keypoint_px
    overlap, depth = np.full((2, *keypoint.shape), np.nan)
    for t, camera, report in reports:
        overlap[t, camera] = report.overlap
        depth[t, camera] = report.depth_residual_m
    return ViewErrors(keypoint, body.person_by_view(), overlap, depth)


def _at_person(pixels: np.ndarray, result: JointResult, joints: np.ndarray) -> np.ndarray:
    """Errors (T,), metres, of those in ``pixels`` (T, C), one camera a frame, at the middle of the
    body's ``joints`` (T, J, 3)."""
    rig = result.cameras.rig
    pose = rig.colour_from_master
    depth = joints.mean(axis=1) @ pose[:, 2, :3].T + pose[:, 2, 3]
    size = pixels * depth / rig.colour_parameters[:, 0]
    return np.where(np.isfinite(size).any(axis=1), np.nansum(size, axis=1), np.nan)


def _taken(states: list[State], which: np.ndarray) -> State:
    """Each frame of the state of this number (T,)."""
    frames, one = np.arange(len(which)), states[0]
    body, rotation, translation = (
        np.stack([getattr(state, name) for state in states])[which, frames]
        for name in ("body", "rotation", "translation")
    )
    return State(body, one.betas, one.expression, rotation, translation)


def _points(inputs: JointInputs, state: State) -> dict[JudgedPart, np.ndarray]:
    """What is compared of each part (T, K, 3): joints and, where there is one, the object's centre
    of mass."""
    with torch.no_grad():
        posed = inputs.model(state.parameters(inputs.model), vertex_ids=np.array([0]))
    joints = posed.joints.double().cpu().numpy()
    found = {part: joints[:, at] for part, at in JOINTS.items()}
    if inputs.geometry.has_object:
        centre = state.rotation @ inputs.geometry.mesh.centre_of_mass + state.translation
        found[JudgedPart.OBJECT] = centre[:, None]
    return found


def _rms(shift: np.ndarray) -> np.ndarray:
    """Root mean square length (T,) of (T, K, 3)."""
    return np.sqrt((shift**2).sum(axis=2).mean(axis=1))
