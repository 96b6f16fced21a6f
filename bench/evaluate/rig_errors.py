"""Errors of found camera poses against truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from bench.evaluate.scan_errors import align_points
from intercap_core import artefacts
from intercap_core.evaluation.body import vertex_error
from intercap_core.evaluation.known import finite, over_known
from intercap_core.evaluation.object_pose import posed_point
from intercap_core.evaluation.scene_errors import CUBE_SIDE_M, displacement, rig_centre
from intercap_core.evaluation.tracks import read_body, read_object
from intercap_core.evaluation.truth import Truth
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.schemas import JOINT, SCENE, TRUTH
from intercap_core.sequence_inputs import SequenceModels, SequencePaths


@dataclass(frozen=True, eq=False)
class ChainErrors:
    """Errors of the joint fit with given and with found camera poses, in this order.

    Each fit is first aligned to the truth by its cameras (:func:`truth_from_rig`), since the frame
    in which a rig is found is arbitrary.
    """

    body: np.ndarray
    """(2,) error of the skin (PVE), median over frames, metres."""
    object_: np.ndarray
    """(2,) error of the object's centre of mass, median over frames, metres."""

    @classmethod
    def measure(
        cls, given: SequencePaths, found: SequencePaths, truth: Path, models: SequenceModels
    ) -> ChainErrors:
        """Compare the artefacts of stage ``joint`` with the truth.

        Raises UserError if an artefact cannot be read or the truth is of another recording.
        """
        both = [_joint_errors(paths, truth, models) for paths in (given, found)]
        return cls(*np.transpose(both))


def _joint_errors(paths: SequencePaths, truth: Path, models: SequenceModels) -> tuple[float, float]:
    """Median error of the skin and of the object after ``joint``, metres."""
    assert models.object_ is not None  # of the recordings that are measured
    bodies = read_body(paths.joint, "joint", models.body_models, models.gender)
    track = read_object(paths.joint, "joint")
    with artefacts.read(paths.scene, SCENE) as scene, artefacts.read(paths.joint, JOINT) as fitted:
        times, fps = scene["times"], float(scene.attributes["fps"])
        known = Truth.load(truth, times, fps, bodies.model.num_vertices)
        order = [known.camera_names.index(name) for name in scene.text("camera_names")]
        moved = truth_from_rig(fitted["master_from_colour"], known.master_from_colour[order])
    assert known.vertices is not None  # virtual people have the topology of the fitted body
    skin = [
        vertex_error(apply(moved, vertices), true)
        for vertices, true in zip(bodies.vertices(), known.vertices, strict=True)
    ]
    centre = ObjectMesh.load(models.object_).centre_of_mass
    at, true_at = (posed_point(p.rotation, p.translation, centre) for p in (track, known))
    distance = np.linalg.norm(apply(moved, at) - true_at, axis=1)
    return float(np.median(skin)), float(np.median(distance))


def truth_from_rig(poses: np.ndarray, true_poses: np.ndarray) -> np.ndarray:
    """Rigid transform (4, 4) that best aligns a rig (C, 4, 4) with the true one.

    It minimises the displacement of a 2 m cube at the rig's true centre as all cameras see it.
    """
    # eight points whose covariance is that of the cube
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) * CUBE_SIDE_M / np.sqrt(12)
    cube = rig_centre(true_poses) + corners
    points = np.concatenate([apply(pose, cube) for pose in poses @ invert(true_poses)])
    return align_points(points, np.tile(cube, (len(poses), 1)))


@dataclass(frozen=True, eq=False)
class RigErrors:
    """One calibration of one rig."""

    evidence: str
    """Key of the figures: person_depth, person_colour, board or background."""
    error: np.ndarray
    """(C - 1,) displacement over a 2 m cube of the cameras but the master, metres; empty if the
    poses were not found."""
    sigma: np.ndarray
    """(C - 1,) estimated errors, metres: the same displacement."""
    problem: str = ""
    """Why the poses were not found."""
    chain: ChainErrors | None = None
    """Errors of all stages with these poses; None if the stages did not run."""


def pose_errors(truth: Path, names: Sequence[str], poses: np.ndarray) -> np.ndarray:
    """Displacement (C - 1,) of all cameras but the first, metres.

    ``poses`` (C, 4, 4): found poses of the cameras ``names`` in the frame of the first.
    """
    with artefacts.read(truth, TRUTH) as true:
        known = true.text("camera_names")
        order = [known.index(name) for name in names]
        return displacement(poses, true["master_from_colour"][order], 0)[1:]


def figures(rigs: Sequence[RigErrors]) -> dict[str, float]:
    """Figures of many rigs.

    Mean error by evidence, millimetres; share of rigs that were solved; error over estimate; error
    of the joint fit with found poses over that with given ones, median over recordings.
    """
    if not rigs:
        return {}
    found = {"solved_share": float(np.mean([len(r.error) > 0 for r in rigs]))}
    for evidence in dict.fromkeys(r.evidence for r in rigs):
        errors = np.concatenate([r.error for r in rigs if r.evidence == evidence])
        found[f"pose_{evidence}_mm"] = 1e3 * over_known(np.mean, errors)
    ratio = np.concatenate([r.error / r.sigma for r in rigs])
    chains = [r.chain for r in rigs if r.chain is not None]
    found |= {
        "error_over_estimate_median": over_known(np.median, ratio),
        "error_within_twice_estimate_share": over_known(np.mean, ratio <= 2),
        "body_pve_ratio": over_known(np.median, [c.body[1] / c.body[0] for c in chains]),
        "object_ratio": over_known(np.median, [c.object_[1] / c.object_[0] for c in chains]),
    }
    return finite(found)
