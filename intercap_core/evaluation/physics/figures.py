"""Figures of the physics of several sequences, and displacements at the true poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.evaluation.figures import Figures, SequenceMetrics, pooled
from intercap_core.evaluation.physics.carriers import Carrier
from intercap_core.evaluation.physics.judge import PhysicsTest
from intercap_core.evaluation.physics.rest_test import missing_library
from intercap_core.evaluation.tracks import read_object
from intercap_core.evaluation.truth import match_times
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.schemas import METRICS, TRUTH
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

# Mean displacement of objects over 35 frames that the project page of HUMOTO (Lu et al., ICCV 2025)
# states, millimetres. Its protocol: all objects of a scene, held or not, of one sequence each, in
# PyBullet. HUMOTO has two values, for the sequences that were compared with BEHAVE and ParaHome.
PUBLISHED_MM = {"HUMOTO": (11.0, 22.0), "BEHAVE": (102.0,), "ParaHome": (283.0,)}


def physics_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """Figures of the sequences whose physics was tested; empty if none was.

    - ``releases``: number of releases of an object at rest.
    - ``displacement_mm``, ``displacement_p95_mm``: mean and 95th percentile over the releases.
    - ``penetration_mm``, ``penetration_p98_mm``: mean and 98th percentile of the depth of the
      collision shape below floor and support, over the frames with a floor.
    - ``unsupported_share``, ``unknown_share``, ``undetermined_share``: frames in which nothing
      carries the object, something unknown holds it, and the carrier is not determined.
    - ``bad_share``: frames in which physics contradicts the pose.
    """
    carrier = pooled(sequences, "physics/carrier")
    if carrier is None:
        return {}
    shares = {
        f"{name}_share": float(np.mean([str(c) == kind for c in carrier]))
        for name, kind in (
            ("unsupported", Carrier.UNSUPPORTED),
            ("unknown", Carrier.UNKNOWN),
            ("undetermined", Carrier.UNDETERMINED),
        )
    }
    moved, depth, bad = (
        pooled(sequences, f"physics/{key}")
        for key in ("release_displacement", "penetration", "bad")
    )
    assert moved is not None and depth is not None and bad is not None
    result: Figures = {"releases": float(len(moved)), **shares, "bad_share": float(bad.mean())}
    if len(moved):
        result["displacement_mm"] = 1e3 * float(moved.mean())
        result["displacement_p95_mm"] = 1e3 * float(np.percentile(moved, 95))
    depth = depth[np.isfinite(depth)]
    if len(depth):
        result["penetration_mm"] = 1e3 * float(depth.mean())
        result["penetration_p98_mm"] = 1e3 * float(np.percentile(depth, 98))
    return result


def displacements(
    paths: SequencePaths, models: SequenceModels, truth: Path
) -> dict[str, np.ndarray]:
    """Displacements (N,), metres, of the object released at its poses of three kinds.

    "truth", "joint" and "sequential" (stage ``object_track``): in the frames that stage ``metrics``
    released, with the supports that each pose has. Frames without a support under one of the poses
    are left out. Empty without releases. The result at the true poses is the lower bound of the
    method: they stand on the estimated floor, and the catalogue's mesh is not the true one.

    Raises UserError if a file cannot be read.
    """
    with artefacts.read(paths.metrics, METRICS) as metrics:
        frames = metrics["physics/release_frame"] if "physics/release_frame" in metrics else []
    if not len(frames) or models.object_ is None or missing_library():
        return {}
    test = PhysicsTest(ObjectMesh.load(models.object_), paths)
    with artefacts.read(truth, TRUTH) as file:
        at = match_times(truth, file["times"], test.times, test.fps)
        true = rigid(file["rotation"][at], file["translation"][at])
    tracked = read_object(paths.object_track, "object_track")
    found = {
        name: np.array([test.displacement(poses[t], test.sigma[t]) for t in frames])
        for name, poses in (
            ("truth", true),
            ("joint", test.poses),
            ("sequential", rigid(tracked.rotation, tracked.translation)),
        )
    }
    known = np.isfinite(list(found.values())).all(axis=0)
    return {name: moved[known] for name, moved in found.items()}
