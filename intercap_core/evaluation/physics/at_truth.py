"""Rest test at the true, the joint and the sequential poses of a virtual recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.evaluation.physics.judge import PhysicsTest
from intercap_core.evaluation.physics.rest_test import missing_library
from intercap_core.evaluation.tracks import read_object
from intercap_core.evaluation.truth import match_times
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.schemas import METRICS, TRUTH
from intercap_core.sequence_inputs import SequenceModels, SequencePaths


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
        if "physics/release_frame" not in metrics:
            return {}
        frames = metrics["physics/release_frame"]
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
