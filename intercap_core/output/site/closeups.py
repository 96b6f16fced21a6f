"""Close-ups of hands that hold: the joint fit beside the sequential fits and, where known, truth.

Each hand's contact, as the joint stage states it, is cut into holds. A hold is drawn at its middle
frame from two sides, the same for all columns: those from which most of hand and object is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from intercap_core import artefacts
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.evaluation import flags
from intercap_core.evaluation.contact import CONTACT_M
from intercap_core.evaluation.proximity import PosedObject
from intercap_core.evaluation.tracks import read_body, read_object
from intercap_core.evaluation.truth import Truth
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable
from intercap_core.output.site.drawing import Painted, draw, encode_jpeg
from intercap_core.output.site.overlays import BODY_COLOUR, OBJECT_COLOUR
from intercap_core.schemas import JOINT, SCENE
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

SIDES = ("left", "right")
TOUCHING_COLOUR = (0.86, 0.20, 0.26)
HOLDING = 0.5  # probability of a hold, as everywhere where contact is stated
VIEWS = 2
_CELL_PX, _GAP_PX, _HEAD_PX = 200, 4, 18
_FIELD_M = 0.25  # width and height of what a cell shows, at the hand
_DISTANCE_M = 0.8
_SURVEY_PX = 48  # of pictures for choosing viewpoints
_APART_DEG = 60.0  # between both viewpoints
_STEEPEST = 0.8  # of a viewing direction, its share along the room's up: nobody looks from below
_NEAR_M = 0.03  # of the object: skin that a viewpoint should show
_GROUND, _INK = 225, (40, 44, 52)
_CELL = np.ones((_CELL_PX, _CELL_PX, 3), np.float32)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, eq=False)
class Column:
    """One version of what happened: ``body`` gives the vertices (V, 3) of a frame, on the fitted
    mesh; the object has ``vertices`` (Vo, 3) and ``faces`` (Fo, 3) under ``rotation`` (T, 3, 3) and
    ``translation`` (T, 3). Master frame, metres."""

    name: str
    body: Callable[[int], np.ndarray]
    vertices: np.ndarray
    faces: np.ndarray
    watertight: bool
    rotation: np.ndarray
    translation: np.ndarray

    def at(self, t: int) -> Moment:
        """Body and object in frame ``t``."""
        return Moment(
            self.body(t).astype(np.float64),
            self.vertices @ self.rotation[t].T + self.translation[t],
            self.faces,
            self.watertight,
        )


@dataclass(frozen=True, eq=False)
class Moment:
    """``body`` (V, 3) and the object's ``vertices`` (Vo, 3) with its ``faces`` (Fo, 3), master
    frame, metres."""

    body: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    watertight: bool

    def distance(self, ids: np.ndarray) -> np.ndarray:
        """Signed distance (N,) of the skin vertices ``ids`` (N,) to the object."""
        surface = PosedObject(self.vertices, self.faces, watertight=self.watertight)
        return surface.signed_distance(self.body[ids], np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class Handling:
    """``columns`` of one sequence, the last one truth where it is ``known``; ``probability`` (T, 2)
    that the left and the right hand touch; ``up`` (3,) of the room, master frame."""

    model: BodyModel
    columns: tuple[Column, ...]
    known: bool
    probability: np.ndarray
    up: np.ndarray


@dataclass(frozen=True)
class Hold:
    """Frames ``first`` to ``last`` in which the hand of a ``side`` touches."""

    side: str
    first: int
    last: int

    @property
    def frame(self) -> int:
        """The one in the middle."""
        return (self.first + self.last) // 2

    @property
    def caption(self) -> str:
        """What a picture of it shows."""
        span = f"{self.first}–{self.last}" if self.last > self.first else f"{self.first}"
        return f"{self.side} hand, frames {span}, drawn at {self.frame}"


@dataclass(frozen=True, eq=False)
class CloseUp:
    """``jpeg`` bytes: a row for each viewpoint, a column for each version."""

    hold: Hold
    jpeg: bytes
    width: int
    height: int


def read_handling(
    paths: SequencePaths,
    models: SequenceModels,
    *,
    truth: Path | None,
    joints: Mapping[str, Path] | None = None,
) -> Handling:
    """Read what is drawn from the artefacts of a sequence with an object, and its ``truth``.

    ``joints`` are joint.h5 by the name of their column; by default the sequence's own is "joint",
    beside "sequential". Holds are those of the last one. Raises UserError as reading does.
    """
    assert models.object_ is not None
    mesh = ObjectMesh.load(models.object_)
    body_models, gender = models.body_models, models.gender

    def column(name: str, body: tuple[Path, str], object_: tuple[Path, str]) -> Column:
        track, pose = read_body(*body, body_models, gender), read_object(*object_)
        return Column(
            name, track.frame, mesh.vertices, mesh.faces, mesh.watertight, pose.rotation,
            pose.translation,
        )  # fmt: skip

    columns = []
    if joints is None:
        joints = {"joint": paths.joint}
        sequential = (paths.body_fit, "body_fit"), (paths.object_track, "object_track")
        columns.append(column("sequential", *sequential))
    columns += [column(name, (path, "joint"), (path, "joint")) for name, path in joints.items()]
    last = list(joints.values())[-1]
    model = read_body(last, "joint", body_models, gender).model
    with artefacts.read(last, JOINT) as joint:
        regions = joint.text("region_names")
        hands = [regions.index(f"{side}_hand") for side in SIDES]
        probability = joint["contact_probability"][:, hands]
    with artefacts.read(paths.scene, SCENE) as scene:
        times, fps = scene["times"], float(scene.attributes["fps"])
        up = scene["zup_from_master"][2, :3].astype(float)
    known = False
    if truth is not None:
        true = Truth.load(truth, times, fps, model.num_vertices)
        if true.vertices is not None:
            known = True
            columns.append(
                Column(
                    "truth", true.vertices.__getitem__, true.object_vertices, true.object_faces,
                    mesh.watertight, true.rotation, true.translation,
                )
            )  # fmt: skip
    return Handling(model, tuple(columns), known, probability, up)


def holds(probability: np.ndarray) -> list[Hold]:
    """Runs of frames in which a hand's ``probability`` (T, 2) is over a half, longest first."""
    found = [
        Hold(side, first, last)
        for side, values in zip(SIDES, probability.T, strict=True)
        for first, last, _ in flags.ranges(["x" if p > HOLDING else "" for p in values])
    ]
    return sorted(found, key=lambda hold: (hold.first - hold.last, hold.first, hold.side))


def closeup(handling: Handling, hold: Hold) -> CloseUp:
    """Draw one hold."""
    model, t = handling.model, hold.frame
    hand = np.asarray(model.regions[f"{hold.side}_hand"])
    arms = _forearm_faces(model)
    moments = [column.at(t) for column in handling.columns]
    fitted = moments[-2] if handling.known else moments[-1]
    views = _viewpoints(fitted, hand, arms, handling.up)
    step = _CELL_PX + _GAP_PX
    shape = (_HEAD_PX + len(views) * step - _GAP_PX, len(moments) * step - _GAP_PX, 3)
    sheet = np.full(shape, _GROUND, np.uint8)
    for c, (column, moment) in enumerate(zip(handling.columns, moments, strict=True)):
        colours = _skin_colours(moment, arms)
        for row, view in enumerate(views):
            picture = draw(_painted(moment, arms, colours, view), _lens(_CELL_PX))
            y, x = _HEAD_PX + row * step, c * step
            sheet[y : y + _CELL_PX, x : x + _CELL_PX] = np.rint(255 * picture.over(_CELL))
        words = column.name
        if handling.known and c < len(moments) - 1:
            off = np.linalg.norm((moment.body - moments[-1].body)[hand], axis=1).mean()
            words += f", hand {1e3 * off:.1f} mm off"
        cv2.putText(sheet, words, (c * step + 3, 13), _FONT, 0.4, _INK, 1, cv2.LINE_AA)
    return CloseUp(hold, encode_jpeg(sheet / np.float32(255)), sheet.shape[1], sheet.shape[0])


def _lens(pixels: int) -> Intrinsics:
    focal, middle = pixels * _DISTANCE_M / _FIELD_M, (pixels - 1) / 2
    return Intrinsics(pixels, pixels, focal, focal, middle, middle)


def _forearm_faces(model: BodyModel) -> np.ndarray:
    """Faces (F, 3) of both forearms and hands: what a trunk would hide is what is looked at."""
    parts = [
        index
        for name, index in JOINT_INDEX.items()
        if name.endswith(("_elbow", "_wrist")) or index >= JOINT_INDEX["left_index1"]
    ]
    own = np.isin(model.skinning_weights.cpu().numpy().argmax(1), parts)
    faces = model.faces.cpu().numpy()
    return faces[own[faces].all(1)]


def _viewpoints(
    fitted: Moment, hand: np.ndarray, arms: np.ndarray, up: np.ndarray
) -> list[np.ndarray]:
    """camera_from_master (4, 4) of the two sides that show most of the skin beside the object."""
    target = fitted.body[hand].mean(0)
    near = np.zeros(len(fitted.body), bool)
    near[hand[fitted.distance(hand) < _NEAR_M]] = True
    showing = near[arms].any(1)
    lens, found = _lens(_SURVEY_PX), []
    for direction in _directions(up):
        pose = _looking(target, direction, up)
        drawn = render_scene(
            [Drawable(fitted.body, arms, pose), Drawable(fitted.vertices, fitted.faces, pose)], lens
        )
        skin = int(showing[drawn.face[drawn.body == 0]].sum())
        thing = int((drawn.body == 1).sum())
        found.append((np.sqrt(skin * min(thing, skin)) + 1e-3 * skin, direction, pose))
    order = sorted(range(len(found)), key=lambda i: (-found[i][0], i))
    chosen = order[:1]
    limit = np.cos(np.radians(_APART_DEG))
    for i in order:
        apart = all(found[i][1] @ found[j][1] < limit for j in chosen)
        if len(chosen) < VIEWS and apart:
            chosen.append(i)
    return [found[i][2] for i in chosen]


def _directions(up: np.ndarray) -> list[np.ndarray]:
    """Unit viewing directions all round, from slightly below to steeply above."""
    side = np.cross(up, [0.0, 0.0, 1.0] if abs(up[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    front = np.cross(side, up)
    return [
        -np.sqrt(1 - rise**2) * (np.cos(turn) * side + np.sin(turn) * front) - rise * up
        for rise in (-0.3, 0.1, 0.45, _STEEPEST)
        for turn in np.arange(12) * np.pi / 6
    ]


def _looking(target: np.ndarray, direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """camera_from_master (4, 4) of a camera that looks along ``direction`` at ``target``."""
    right = np.cross(direction, up)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(direction, right), direction])
    return rigid(turn, turn @ (direction * _DISTANCE_M - target))


def _skin_colours(moment: Moment, arms: np.ndarray) -> np.ndarray:
    """Colours (V, 3): skin that touches the object, or is inside it, has its own."""
    used = np.unique(arms)
    colours = np.tile(BODY_COLOUR, (len(moment.body), 1))
    colours[used[moment.distance(used) < CONTACT_M]] = TOUCHING_COLOUR
    return colours


def _painted(
    moment: Moment, arms: np.ndarray, colours: np.ndarray, view: np.ndarray
) -> list[Painted]:
    thing = np.tile(OBJECT_COLOUR, (len(moment.vertices), 1))
    return [
        Painted(moment.body, arms, colours, view),
        Painted(moment.vertices, moment.faces, thing, view),
    ]
