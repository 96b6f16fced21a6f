"""Close-ups of hand contacts: the joint fit next to the per-stage fits and, if known, truth.

A hold is a run of frames in which the joint fit's probability of contact of a hand exceeds 0.5. It
is drawn at its middle frame from two viewpoints that show most of hand and object. A column of the
picture is one result; all columns have the same viewpoints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.evaluation.contact import vertex_contact
from intercap_core.evaluation.proximity import BodySurface, PosedObject
from intercap_core.evaluation.tracks import read_body, read_object
from intercap_core.evaluation.truth import Truth
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.geometry.solve.time_series import runs
from intercap_core.output.site import drawing
from intercap_core.output.site.embed import span
from intercap_core.output.site.overlays import BODY_COLOUR, OBJECT_COLOUR
from intercap_core.schemas import CONTACT_M, JOINT, SCENE
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

SIDES = ("left", "right")
TOUCHING_COLOUR = (0.86, 0.20, 0.26)
_CELL_PX = 200
_DISTANCE_M = 0.8  # of the viewer from the hand


@dataclass(frozen=True, eq=False)
class Column:
    """Body and object of one result over T frames, master frame, metres."""

    name: str
    body: Callable[[int], np.ndarray]
    """Returns the body's vertices (V, 3) of a frame."""
    mesh: ObjectMesh
    rotation: np.ndarray
    """(T, 3, 3) master_from_object."""
    translation: np.ndarray
    """(T, 3) master_from_object."""

    def at(self, t: int) -> PosedPair:
        """Pose body and object in frame ``t``."""
        vertices = self.mesh.vertices @ self.rotation[t].T + self.translation[t]
        return PosedPair(self.body(t).astype(np.float64), vertices, self.mesh)


@dataclass(frozen=True, eq=False)
class PosedPair:
    """Body and object in one frame, master frame, metres."""

    body: np.ndarray
    """(V, 3)"""
    vertices: np.ndarray
    """(Vo, 3) of the object."""
    mesh: ObjectMesh
    """The object in its own frame."""

    @cached_property
    def _object(self) -> PosedObject:
        return PosedObject(self.vertices, self.mesh.faces, watertight=self.mesh.watertight)

    def distance(self) -> np.ndarray:
        """Return signed distances (V,) of the body's vertices to the object."""
        return self._object.signed_distance(self.body, np.eye(3), np.zeros(3))

    def touching(self, faces: np.ndarray) -> np.ndarray:
        """Return the mask (V,) of the vertices of a body with ``faces`` (F, 3) in contact."""
        body = BodySurface(self.body, faces, SurfaceTree(self.body, faces))
        reach = 1.01 * CONTACT_M
        return vertex_contact(self._object.contact_distance(body, np.eye(3), np.zeros(3), reach))


@dataclass(frozen=True, eq=False)
class Handling:
    """Results of one sequence with their contact of both hands."""

    model: BodyModel
    columns: tuple[Column, ...]
    """The last column is the truth if ``has_truth``."""
    has_truth: bool
    probability: np.ndarray
    """(T, 2) probability of contact of the left and right hand."""
    up: np.ndarray
    """(3,) unit vector, master frame."""


@dataclass(frozen=True)
class Hold:
    """A run of frames in which one hand touches the object."""

    side: str
    first: int
    last: int
    """Included."""

    @property
    def frame(self) -> int:
        """Frame that is drawn."""
        return (self.first + self.last) // 2

    @property
    def caption(self) -> str:
        """Caption of a picture."""
        frames = span(self.first, self.last)
        return f"{self.side} hand, frames {frames}, drawn at {self.frame}"


def read_handling(paths: SequencePaths, models: SequenceModels, *, truth: Path | None) -> Handling:
    """Read the artefacts of a sequence with an object; ``truth``: file, None if unknown.

    Raises UserError as reading does.
    """
    assert models.object_ is not None
    mesh = ObjectMesh.load(models.object_)
    columns = []
    for name, body_stage, object_stage in (
        ("per-stage", "body_fit", "object_track"),
        ("joint", "joint", "joint"),
    ):
        body = read_body(getattr(paths, body_stage), body_stage, models.body_models, models.gender)
        pose = read_object(getattr(paths, object_stage), object_stage)
        columns.append(Column(name, body.frame, mesh, pose.rotation, pose.translation))
    model = body.model
    with artefacts.read(paths.joint, JOINT) as joint:
        regions = joint.text("region_names")
        hands = [regions.index(f"{side}_hand") for side in SIDES]
        probability = joint["contact_probability"][:, hands]
    with artefacts.read(paths.scene, SCENE) as scene:
        times, fps = scene["times"], float(scene.attributes["fps"])
        up = scene["zup_from_master"][2, :3].astype(float)
    has_truth = False
    if truth is not None:
        true = Truth.load(truth, times, fps, model.num_vertices)
        if true.vertices is not None:
            has_truth = True
            mesh = replace(mesh, vertices=true.object_vertices, faces=true.object_faces)
            at = true.vertices.__getitem__
            columns.append(Column("truth", at, mesh, true.rotation, true.translation))
    return Handling(model, tuple(columns), has_truth, probability, up)


def holds(probability: np.ndarray) -> list[Hold]:
    """Return the holds of both hands by their probability of contact (T, 2), longest first."""
    found = [
        Hold(side, first, last)
        for side, values in zip(SIDES, probability.T, strict=True)
        for first, last in runs(values > 0.5)
    ]
    return sorted(found, key=lambda hold: (hold.first - hold.last, hold.first, hold.side))


def closeup(handling: Handling, hold: Hold) -> drawing.EncodedImage:
    """Draw one hold: a row for each viewpoint, a column for each result."""
    model, t = handling.model, hold.frame
    hand = np.asarray(model.regions[f"{hold.side}_hand"])
    arms = _forearm_faces(model)
    pairs = [column.at(t) for column in handling.columns]
    fitted = pairs[-2] if handling.has_truth else pairs[-1]
    views = _viewpoints(fitted, hand, arms, handling.up)
    gap, head = 4, 18  # px
    step = _CELL_PX + gap
    sheet = np.full((head + len(views) * step - gap, len(pairs) * step - gap, 3), 225, np.uint8)
    white = np.ones((_CELL_PX, _CELL_PX, 3), np.float32)
    for c, (column, pair) in enumerate(zip(handling.columns, pairs, strict=True)):
        # skin that touches the object, or is inside it, is red
        touching = pair.touching(model.faces.numpy())[:, None]
        skin = np.where(touching, TOUCHING_COLOUR, BODY_COLOUR)
        for row, view in enumerate(views):
            body = drawing.ColouredMesh(pair.body, arms, view, colours=skin)
            object_ = drawing.ColouredMesh(
                pair.vertices, pair.mesh.faces, view, colours=OBJECT_COLOUR
            )
            picture = drawing.draw([body, object_], _lens(_CELL_PX))
            y, x = head + row * step, c * step
            sheet[y : y + _CELL_PX, x : x + _CELL_PX] = np.rint(255 * picture.over(white))
        label = column.name
        if handling.has_truth and c < len(pairs) - 1:
            off = np.linalg.norm((pair.body - pairs[-1].body)[hand], axis=1).mean()
            label += f", hand {1e3 * off:.1f} mm off"
        drawing.put_text(sheet, label, (c * step + 3, 13), 0.4, (40, 44, 52))
    return drawing.encode_jpeg(sheet / np.float32(255), hold.caption)


def _lens(pixels: int) -> Intrinsics:
    return drawing.pinhole(pixels, pixels, pixels * _DISTANCE_M / 0.25)  # shows 0.25 m at the hand


def _forearm_faces(model: BodyModel) -> np.ndarray:
    """Return faces (F, 3) of both forearms and hands. Other parts would occlude the contact."""
    parts = [
        index
        for name, index in JOINT_INDEX.items()
        if name.endswith(("_elbow", "_wrist")) or index >= JOINT_INDEX["left_index1"]
    ]
    shown = np.isin(model.skinning_weights.numpy().argmax(1), parts)
    faces = model.faces.numpy()
    return faces[shown[faces].all(1)]


def _viewpoints(
    fitted: PosedPair, hand: np.ndarray, arms: np.ndarray, up: np.ndarray
) -> list[np.ndarray]:
    """Choose camera_from_master (4, 4) of two viewpoints at least 60 degrees apart.

    The score of a viewpoint is the geometric mean of the visible areas of the hand's skin near the
    object and of the object. The object counts at most as much as the skin.
    """
    target = fitted.body[hand].mean(0)
    near = np.zeros(len(fitted.body), bool)
    near[hand[fitted.distance()[hand] < 0.03]] = True  # skin within 30 mm of the object
    showing = near[arms].any(1)  # by face
    lens, candidates = _lens(48), []
    for direction in _directions(up):
        pose = drawing.look_at(target, direction, up, _DISTANCE_M)
        drawn = render_scene(
            [Drawable(fitted.body, arms, pose), Drawable(fitted.vertices, fitted.mesh.faces, pose)],
            lens,
        )
        skin = int(showing[drawn.face[drawn.body == 0]].sum())
        visible = int((drawn.body == 1).sum())
        score = np.sqrt(skin * min(visible, skin)) + 1e-3 * skin  # ranks views without object too
        candidates.append((score, direction, pose))
    order = sorted(range(len(candidates)), key=lambda i: (-candidates[i][0], i))
    chosen = order[:1]
    limit = np.cos(np.radians(60.0))  # least angle between both viewpoints
    for i in order:
        apart = all(candidates[i][1] @ candidates[j][1] < limit for j in chosen)
        if len(chosen) < 2 and apart:
            chosen.append(i)
    return [candidates[i][2] for i in chosen]


def _directions(up: np.ndarray) -> list[np.ndarray]:
    """Return 48 unit viewing directions all around, from slightly below to steeply above."""
    side = np.cross(up, [0.0, 0.0, 1.0] if abs(up[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    front = np.cross(side, up)
    return [
        -np.sqrt(1 - rise**2) * (np.cos(turn) * side + np.sin(turn) * front) - rise * up
        for rise in (-0.3, 0.1, 0.45, 0.8)
        for turn in np.arange(12) * np.pi / 6
    ]
