"""Left and right of the subject: its limbs as a detector named them and as the result has them, and
where that is in doubt.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from intercap_core import artefacts
from intercap_core.annotate.opened import Opened
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.errors import UserError
from intercap_core.evaluation.flags import exchanged, ranges
from intercap_core.formats.detections.read import Detections
from intercap_core.output.viewer.page import payload
from intercap_core.person.left_right import excess_build_cost
from intercap_core.person.sides import ARMS, LEGS, images_with_stated_sides, swap_sides
from intercap_core.schemas import BODY_FIT, JOINT, PERSON, SCENE
from intercap_core.stages.person import subject_keypoints

POINTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "big_toe")  # of each side
BONES = ((0, 1), (1, 2), (3, 4), (4, 5), (5, 6))
# Of how much better another way suits the build, a negative log likelihood: right bodies of the
# studio stay below 2, mirrored ones are beyond 2.5 in two frames of three.
AGAINST_BUILD = 2.5
MOST_VIEWS = 0.5  # of those that see a limb; exchanged in more, the detector is contradicted
WEIGHT = 3.0  # of an exchange in all views beside what speaks against the build
JOINED = 3  # doubted frames with at most so many others between are one place
_KEYPOINTS = [KEYPOINT_NAMES.index(f"{s}_{p}") for s in ("left", "right") for p in POINTS]
_JOINTS = [JOINT_INDEX[f"{s}_{p}"] for s in ("left", "right") for p in (*POINTS[:-1], "foot")]
_NOWHERE = -1
_STAGES = ("detections", "scene", "person", "joint", "body_fit")


@dataclass(frozen=True)
class Sides:
    """``detected`` (T, C, 14, 2) int16: pixels of the subject's limbs, first all of what a detector
    called left, then right; -1 = not seen. ``exchanged`` (T, C, 2): whether stage ``person`` took
    arms and legs for the other side's: 1 yes, 0 no, -1 not seen. ``result`` (T, 14, 3) of
    ``source``, metres in the master's frame; NaN = none. ``against`` (T,): how much better another
    way suits the body's build; ``jumped`` (T,): the result's limbs jump to the other side and back.
    ``image_of`` (T, C): the set whose image shows each moment.
    """

    cameras: list[str]
    detected: np.ndarray
    exchanged: np.ndarray
    result: np.ndarray
    source: str
    against: np.ndarray
    jumped: np.ndarray
    image_of: np.ndarray


@dataclass(frozen=True)
class Doubt:
    """Frames ``first`` to ``last``, best looked at in ``frame``; of the ``camera`` most sides were
    exchanged."""

    first: int
    last: int
    frame: int
    camera: str
    words: str


def sides_of(opened: Opened) -> Sides:
    """Raises UserError where an artefact lacks, cannot be read or is of another recording."""
    return opened.made("sides", _STAGES, lambda: _sides(opened))


def sides_payload(opened: Opened) -> str:
    """What the page draws, as the viewer's package has it."""

    def made() -> str:
        found = sides_of(opened)
        header = {"cameras": found.cameras, "bones": [list(b) for b in BONES],
                  "points": list(POINTS), "source": found.source}  # fmt: skip
        arrays: dict[str, np.ndarray] = {
            "detected": found.detected,
            "exchanged": np.any(found.exchanged > 0, axis=2).astype(np.uint8),
            "result": found.result.astype(np.float32),
        }
        return payload(header, arrays)

    return opened.made("sides as sent", _STAGES, made)


def doubts(opened: Opened) -> list[Doubt]:
    """Where stage ``person`` contradicted the detector in most views, the body's build speaks
    against its choice, or the result's limbs jump from side to side; what the annotation states to
    be exchanged is no contradiction."""
    found = sides_of(opened)
    stated = np.zeros(found.image_of.shape, bool)
    with contextlib.suppress(UserError):  # an annotation that is none is told elsewhere
        annotation = opened.project.annotation(opened.name, look_at_frames=False)
        stated = images_with_stated_sides(
            annotation.left_right, found.cameras, found.image_of, opened.name
        )
    limbs = np.where(found.exchanged < 0, -1, found.exchanged ^ stated[..., None])
    return _runs(limbs, found)


def _sides(opened: Opened) -> Sides:
    found = Detections.load(opened.paths["detections"])
    with artefacts.read(opened.paths["scene"], SCENE) as scene:
        image_of = scene["image_of"]
    found = found.showing(image_of)
    with artefacts.read(opened.paths["person"], PERSON) as person:
        chosen, used, joints = person["person"], person["keypoints"], person["joints"]
        cameras = person.text("camera_names")
    counts = np.array(
        [[len(found.people(t, c)) for c in range(len(cameras))] for t in range(len(chosen))]
    )
    if cameras != list(found.camera_names) or (chosen >= counts).any():
        raise UserError(
            f"{opened.paths['person']}: was made of other detections; re-run stage 'person'"
        )
    given = subject_keypoints(found, chosen).astype(used.dtype)
    confident = opened.project.config.person.min_confidence
    limbs = np.stack([_exchanged(given, used, limb, confident) for limb in (ARMS, LEGS)], 2)
    points = given[:, :, _KEYPOINTS]
    pixels = np.where(points[..., 2:] >= confident, np.rint(points[..., :2]), _NOWHERE)
    source, result, jumped = _result(opened, joints)
    return Sides(
        cameras, np.clip(pixels, _NOWHERE, 32767).astype(np.int16), limbs, result, source,
        excess_build_cost(joints.astype(np.float64)), jumped, image_of,
    )  # fmt: skip


def _exchanged(
    given: np.ndarray, used: np.ndarray, limb: np.ndarray, confident: float
) -> np.ndarray:
    """Whether a limb (T, C) was exchanged: 1 yes, 0 no, -1 it is not seen."""
    own, as_found, other = used[:, :, limb], given[:, :, limb], swap_sides(given)[:, :, limb]
    seen = (as_found[..., 2] >= confident).any(2)
    exchanged = (own == other).all((2, 3)) & (own != as_found).any((2, 3))
    return np.where(seen, exchanged.astype(int), -1)


def _result(opened: Opened, joints: np.ndarray) -> tuple[str, np.ndarray, np.ndarray]:
    """The limbs (T, 14, 3) of the best body that there is, else of the triangulated keypoints; and
    the frames in which they jumped to the other side."""
    for stage, schema in (("joint", JOINT), ("body_fit", BODY_FIT)):
        try:
            with artefacts.read(opened.paths[stage], schema) as body:
                found = body["joints"]
        except artefacts.Unreadable:
            continue
        if len(found) == len(joints):
            return stage, found[:, _JOINTS], np.any(list(exchanged(found).values()), 0)
    return "person", joints[:, _KEYPOINTS], np.zeros(len(joints), bool)


def _runs(limbs: np.ndarray, sides: Sides) -> list[Doubt]:
    against, jumped = sides.against, sides.jumped
    seen = (limbs >= 0).sum(1)
    share = (limbs > 0).sum(1) / np.maximum(seen, 1)  # (T, 2)
    contradicted = ((seen > 1) & (share >= MOST_VIEWS)).any(1)
    doubted = contradicted | (against >= AGAINST_BUILD) | jumped
    for before, after in pairwise(np.flatnonzero(doubted).tolist()):
        if after - before <= JOINED + 1:
            doubted[before:after] = True
    found = []
    for first, last, _ in ranges(["x" if one else "" for one in doubted]):
        run = slice(first, last + 1)
        why = []
        if contradicted[run].any():
            why.append("the detector is contradicted in half of the views or more")
        if (against[run] >= AGAINST_BUILD).any():
            why.append("knees, feet or head speak for the other way")
        if jumped[run].any():
            why.append("the body's limbs jump to the other side and back")
        worst = first + int((against[run] + WEIGHT * share[run].max(1)).argmax())
        most = int((limbs[run] > 0).sum((0, 2)).argmax())
        words = f"left and right: {'; '.join(why)}"
        found.append(Doubt(first, last, worst, sides.cameras[most], words))
    return found
