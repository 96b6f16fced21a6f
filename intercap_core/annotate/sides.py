"""Left and right of the subject: detected sides, sides of the result, and doubts about them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from intercap_core import artefacts
from intercap_core.annotate.opened import Opened
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.errors import UserError
from intercap_core.evaluation.flags import exchanged
from intercap_core.formats.detections.read import Detections
from intercap_core.geometry.solve.time_series import runs
from intercap_core.output.viewer.page import payload
from intercap_core.person.left_right import excess_build_cost
from intercap_core.person.sides import ARMS, LEGS, images_with_stated_sides, swap_sides
from intercap_core.person.subject import subject_keypoints
from intercap_core.schemas import BODY_FIT, JOINT, PERSON, SCENE

POINTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "big_toe")  # of each side
BONES = ((0, 1), (1, 2), (3, 4), (4, 5), (5, 6))
# Difference of negative log likelihoods of the build, tuned on the studio: correct bodies stay
# below 2, mirrored bodies exceed 2.5 in two of three frames.
MIRRORED_BUILD = 2.5
_KEYPOINTS = [KEYPOINT_NAMES.index(f"{s}_{p}") for s in ("left", "right") for p in POINTS]
# Joints of the body model for these points; the foot joint stands for the big toe
_JOINTS = [JOINT_INDEX[f"{s}_{p}"] for s in ("left", "right") for p in (*POINTS[:-1], "foot")]
_STAGES = ("detections", "scene", "person", "joint", "body_fit")


@dataclass(frozen=True)
class Sides:
    """Sides of the subject's limbs over T frames and C cameras."""

    cameras: list[str]
    """Names of the C cameras."""
    detected: np.ndarray
    """(T, C, 14, 2) int16 pixels of the detector's left, then right limbs; -1 = not visible."""
    exchanged: np.ndarray
    """(T, C, 2) whether stage person exchanged arms and legs: 1 yes, 0 no, -1 not visible."""
    result: np.ndarray
    """(T, 14, 3) limbs of the result, master frame, metres; NaN = none."""
    against: np.ndarray
    """(T,) negative log likelihood of the body's build minus that of the best exchange of arms,
    legs and head, >= 0; 0 = no exchange suits the build better."""
    jumped: np.ndarray
    """(T,) bool, the result's limbs jump to the other side and back."""
    image_of: np.ndarray
    """(T, C) index of the frame set whose image shows each frame; -1 = none."""


@dataclass(frozen=True)
class Doubt:
    """A run of frames with doubtful sides."""

    first: int
    """First frame."""
    last: int
    """Last frame, included."""
    frame: int
    """Frame to look at."""
    camera: str
    """Camera with most exchanged sides."""
    message: str
    """Reasons in words."""


def sides_of(opened: Opened) -> Sides:
    """Compute the sides; raises UserError if an artefact is missing, unreadable or does not fit."""
    return opened.cached("sides", _STAGES, lambda: _sides(opened))


def sides_payload(opened: Opened) -> str:
    """Serialize what the page draws."""

    def make() -> str:
        sides = sides_of(opened)
        arrays = {"detected": sides.detected, "result": sides.result.astype(np.float32)}
        return payload({"cameras": sides.cameras, "bones": BONES}, arrays)

    return opened.cached("sides payload", _STAGES, make)


def doubts(opened: Opened) -> list[Doubt]:
    """Return runs of frames with doubtful sides.

    Sides are doubtful in a frame if one of these holds:
    - At least two views show a limb, and in half of them or more stage person contradicted the
      sides of the detector, or those of the annotation where it states an exchange.
    - The body's build clearly suits exchanged sides better (``MIRRORED_BUILD``).
    - Limbs of the result jump to the other side and back.
    """
    sides = sides_of(opened)
    stated = np.zeros(sides.image_of.shape, bool)
    with contextlib.suppress(UserError):  # faults of the annotation are reported elsewhere
        annotation = opened.project.annotation(opened.name, look_at_frames=False)
        stated = images_with_stated_sides(
            annotation.left_right, sides.cameras, sides.image_of, opened.name
        )
    limbs = np.where(sides.exchanged < 0, -1, sides.exchanged ^ stated[..., None])
    return list(_runs(limbs, sides))


def _sides(opened: Opened) -> Sides:
    """Compare the detected keypoints with those that stage person has kept."""
    detections = Detections.load(opened.paths["detections"])
    with artefacts.read(opened.paths["scene"], SCENE) as scene:
        image_of = scene["image_of"]
    detections = detections.showing(image_of)
    with artefacts.read(opened.paths["person"], PERSON) as person:
        chosen, used, joints = person["person"], person["keypoints"], person["joints"]
        cameras = person.text("camera_names")
    counts = np.array(
        [[len(detections.people(t, c)) for c in range(len(cameras))] for t in range(len(chosen))]
    )
    if cameras != list(detections.camera_names) or (chosen >= counts).any():
        raise UserError(
            f"{opened.paths['person']}: was made from other detections; re-run stage 'person'"
        )
    given = subject_keypoints(detections, chosen).astype(used.dtype)
    confident = opened.project.config.person.min_confidence
    limbs = np.stack([_exchanged(given, used, limb, confident) for limb in (ARMS, LEGS)], 2)
    points = given[:, :, _KEYPOINTS]
    pixels = np.where(points[..., 2:] >= confident, np.rint(points[..., :2]), -1)
    result, jumped = _result(opened, joints)
    return Sides(
        cameras, np.clip(pixels, -1, 32767).astype(np.int16), limbs, result,
        excess_build_cost(joints.astype(np.float64)), jumped, image_of,
    )  # fmt: skip


def _exchanged(
    given: np.ndarray, used: np.ndarray, limb: np.ndarray, confident: float
) -> np.ndarray:
    """Return whether a limb (T, C) was exchanged: 1 yes, 0 no, -1 not visible."""
    result, detected, swapped = used[:, :, limb], given[:, :, limb], swap_sides(given)[:, :, limb]
    visible = (detected[..., 2] >= confident).any(2)
    exchanged = (result == swapped).all((2, 3)) & (result != detected).any((2, 3))
    return np.where(visible, exchanged.astype(int), -1)


def _result(opened: Opened, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return limbs (T, 14, 3) and frames with jumps (T,) of the most refined result."""
    for stage, schema in (("joint", JOINT), ("body_fit", BODY_FIT)):
        try:
            with artefacts.read(opened.paths[stage], schema) as body:
                refined = body["joints"]
        except artefacts.Unreadable:
            continue
        if len(refined) == len(joints):
            return refined[:, _JOINTS], np.any(list(exchanged(refined).values()), 0)
    return joints[:, _KEYPOINTS], np.zeros(len(joints), bool)


def _runs(limbs: np.ndarray, sides: Sides) -> Iterator[Doubt]:
    """Return runs of doubtful frames; ``limbs`` (T, C, 2) as :attr:`Sides.exchanged`."""
    against, jumped = sides.against, sides.jumped
    visible = (limbs >= 0).sum(1)
    share = (limbs > 0).sum(1) / np.maximum(visible, 1)  # (T, 2)
    contradicted = ((visible > 1) & (share >= 0.5)).any(1)
    doubtful = contradicted | (against >= MIRRORED_BUILD) | jumped
    for before, after in pairwise(np.flatnonzero(doubtful).tolist()):
        if after - before <= 4:  # at most three frames between are part of the run
            doubtful[before:after] = True
    for first, last in runs(doubtful):
        run = slice(first, last + 1)
        why = []
        if contradicted[run].any():
            why.append("the detector is contradicted in half of the views or more")
        if (against[run] >= MIRRORED_BUILD).any():
            why.append("knees, feet or head suit exchanged sides better")
        if jumped[run].any():
            why.append("the body's limbs jump to the other side and back")
        # the frame to show; a contradiction in all views costs 3, as in person.left_right
        worst = first + int((against[run] + 3.0 * share[run].max(1)).argmax())
        most = int((limbs[run] > 0).sum((0, 2)).argmax())
        message = f"left and right: {'; '.join(why)}"
        yield Doubt(first, last, worst, sides.cameras[most], message)
