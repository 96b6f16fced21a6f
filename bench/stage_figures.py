"""Figures of one stage's artefact: errors against truth, and flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.evaluate import capture_errors, track_errors
from intercap_core import artefacts
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import BODY, KEYPOINT_NAMES
from intercap_core.evaluation import body, contact, object_errors
from intercap_core.evaluation import truth as truths
from intercap_core.evaluation.proximity import BodySurface, PosedObject
from intercap_core.evaluation.tracks import read_body, read_object
from intercap_core.evaluation.truth import Truth
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.project import Project
from intercap_core.schemas import CONTACT_M, METRIC_REGIONS, PERSON, SCENE

Figures = dict[str, float]
# Keypoints that lie in a joint of the same name; those of the skin have no true joint.
JOINT_KEYPOINTS = tuple(k for k, name in enumerate(KEYPOINT_NAMES[BODY]) if name in JOINT_INDEX)
SIDED = tuple(k for k in JOINT_KEYPOINTS if KEYPOINT_NAMES[k].startswith(("left_", "right_")))
FLAGS = "flagged"
CAPTURE_FIGURES = {
    "extrinsics_after_mm": "extrinsics mm",
    "extrinsics_floor_only_mm": "extrinsics (bare floor) mm",
    "offset_error_ms": "offsets ms",
    "slips_missed": "slips missed",
    "slips_false": "slips false",
    "ground_error_mm": "floor mm",
}
OBJECT_FIGURES = {
    "translation_median_mm": "object mm",
    "translation_p95_mm": "object p95 mm",
    "rotation_median_deg": "object deg",
    "rotation_p95_deg": "object p95 deg",
    "lost_share": "object lost",
}


@dataclass(frozen=True)
class Written:
    """Artefacts of one sequence by stage, including replayed artefacts."""

    project: Project
    sequence: str
    artefacts: dict[str, Path]

    @property
    def truth(self) -> Path:
        path = self.project.sequences[self.sequence].truth
        assert path is not None
        return path

    @property
    def mesh(self) -> ObjectMesh:
        return ObjectMesh.load(self.project.objects[self.project.sequences[self.sequence].object])

    @property
    def gender(self) -> str:
        return self.project.subjects[self.project.sequences[self.sequence].subject].gender

    def true(self, num_vertices: int = 0) -> Truth:
        """The truth at the times of the sequence's frame sets."""
        with artefacts.read(self.artefacts["scene"], SCENE) as scene:
            times, fps = scene["times"], float(scene.attributes["fps"])
        return Truth.load(self.truth, times, fps, num_vertices)


def figures_of(stage: str, written: Sequence[Written]) -> Figures:
    """Figures of a stage's artefacts over several sequences; ``flagged`` counts frames.

    Raises KeyError for a stage without figures.
    """
    return _OF_STAGE[stage](written)


def _scene(written: Sequence[Written]) -> Figures:
    """Figures of the scene; flags are weak camera pairs and cameras with a note."""
    errors = [
        capture_errors.measure(w.artefacts["frames"], w.artefacts["scene"], w.truth)
        for w in written
    ]
    found = _named(capture_errors.figures(errors), CAPTURE_FIGURES)
    flags = 0
    for one in written:
        with artefacts.read(one.artefacts["scene"], SCENE) as scene:
            flags += int(scene["pair_weak"].sum()) + sum(bool(n) for n in scene.text("note"))
    return found | {FLAGS: float(flags)}


def _person(written: Sequence[Written]) -> Figures:
    errors, right, known, missing = [], [], [], 0
    for one in written:
        with artefacts.read(one.artefacts["person"], PERSON) as person:
            points = person["joints"].astype(np.float64)
            missing += int(person["missing"].sum())
        true = one.true()
        errors.append(keypoint_errors(points, true.joints).ravel())
        right.append(sides_right(points, true.joints).ravel())
        known.append(np.isfinite(points[:, :67]).all(-1).ravel())
    every = np.concatenate(errors)
    return {
        "keypoints mm": 1e3 * float(np.nanmean(every)),
        "keypoints p95 mm": 1e3 * float(np.nanpercentile(every, 95)),
        "sides right": float(np.concatenate(right).mean()),
        "keypoints known": float(np.concatenate(known).mean()),
        FLAGS: float(missing),
    }


def _object_track(written: Sequence[Written]) -> Figures:
    errors = [
        track_errors.measure(w.artefacts["scene"], w.artefacts["object_track"], w.truth, w.mesh)
        for w in written
    ]
    found = _named(object_errors.figures(errors), OBJECT_FIGURES)
    return found | {FLAGS: float(sum(e.flagged.sum() for e in errors))}


def _body_fit(written: Sequence[Written]) -> Figures:
    return _bodies("body_fit", written)


def _bodies(stage: str, written: Sequence[Written]) -> Figures:
    surface, joints, hands, flagged = [], [], [], 0
    for one in written:
        models = one.project.config.body_models
        track = read_body(one.artefacts[stage], stage, models, one.gender)
        true = one.true(track.model.num_vertices)
        errors = truths.body_errors(true, track, 1.0)  # no accelerations
        joints.append(errors["body_mpjpe"])
        hands.append(errors["hand_mpjpe"].ravel())
        flagged += int(track.flagged.sum())
        if true.vertices is not None:
            pairs = zip(track.vertices(), true.vertices, strict=True)
            surface.append(np.array([body.vertex_error(v, known) for v, known in pairs]))
    found = {"MPJPE mm": joints, "hands mm": hands} | ({"PVE mm": surface} if surface else {})
    return {name: 1e3 * float(np.concatenate(v).mean()) for name, v in found.items()} | {
        FLAGS: float(flagged)
    }


def _joint(written: Sequence[Written]) -> Figures:
    found = _bodies("joint", written)
    shift, turn, touching, truly = [], [], [], []
    for one in written:
        mesh, track = one.mesh, read_object(one.artefacts["joint"], "joint")
        fitted = read_body(
            one.artefacts["joint"], "joint", one.project.config.body_models, one.gender
        )
        true = one.true()
        errors = truths.object_errors(true.rotation, true.translation, track, mesh, 1.0)
        shift.append(errors["object_translation"])
        turn.append(errors["object_rotation"])
        surface = PosedObject(mesh.vertices, mesh.faces, watertight=mesh.watertight)
        faces = fitted.model.faces.numpy()
        tree = SurfaceTree(fitted.model.template.numpy(), faces)
        touched = np.stack(
            [
                contact.vertex_contact(
                    surface.contact_distance(
                        BodySurface(vertices.astype(np.float64), faces, tree),
                        track.rotation[t],
                        track.translation[t],
                        1.01 * CONTACT_M,
                    )
                )
                for t, vertices in enumerate(fitted.vertices())
            ]
        )
        regions = fitted.model.regions
        touching.append(contact.region_contact(touched, regions, METRIC_REGIONS).ravel())
        truly.append(true.contact_region.ravel())
    counts = contact.confusion(np.concatenate(touching), np.concatenate(truly))
    return found | {
        "object mm": 1e3 * float(np.median(np.concatenate(shift))),
        "object p95 mm": 1e3 * float(np.percentile(np.concatenate(shift), 95)),
        "object p95 deg": float(np.percentile(np.concatenate(turn), 95)),
        "contact F1": contact.f1(counts),
    }


def _named(found: Figures, names: dict[str, str]) -> Figures:
    return {name: found[key] for key, name in names.items() if key in found}


_OF_STAGE = {
    "scene": _scene,
    "person": _person,
    "object_track": _object_track,
    "body_fit": _body_fit,
    "joint": _joint,
}
STAGES_WITH_FIGURES = tuple(_OF_STAGE)


def keypoint_errors(points: np.ndarray, true_joints: np.ndarray) -> np.ndarray:
    """Distance (T, K) of ``JOINT_KEYPOINTS`` of (T, 135, 3) from the joints (T, 55, 3).

    NaN for unknown keypoints. Includes the 10 to 20 mm by which detector and body model define a
    joint differently.
    """
    true = true_joints[:, [JOINT_INDEX[KEYPOINT_NAMES[k]] for k in JOINT_KEYPOINTS]]
    return np.linalg.norm(points[:, list(JOINT_KEYPOINTS)] - true, axis=-1)


def sides_right(points: np.ndarray, true_joints: np.ndarray) -> np.ndarray:
    """Mask (T, S) of the ``SIDED`` keypoints nearer to the joint of their own side.

    ``points`` is (T, 135, 3), ``true_joints`` (T, 55, 3). True for unknown keypoints.
    """
    own, other = (
        np.linalg.norm(
            points[:, list(SIDED)] - true_joints[:, [JOINT_INDEX[n] for n in names]], axis=-1
        )
        for names in (
            [KEYPOINT_NAMES[k] for k in SIDED],
            [_mirrored(KEYPOINT_NAMES[k]) for k in SIDED],
        )
    )
    return ~(own > other)


def _mirrored(name: str) -> str:
    side, _, part = name.partition("_")
    return f"{'right' if side == 'left' else 'left'}_{part}"
