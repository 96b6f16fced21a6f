"""Rest test of finished recordings at deliberately wrong poses.

    python -m bench.physics SETTINGS [SETTINGS ...]

Adds errors to the fitted pose of each rest on a known support, and counts the rests whose pose the
test contradicts, accepts, and does not judge.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from intercap_core.commands.console import ListTable, standard_console
from intercap_core.evaluation.physics.judge import BAD_REST_M, PhysicsTest
from intercap_core.geometry.camera.transforms import rotation_exp
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.project import Project, load_project

VERDICTS = ("contradicted", "accepted", "not judged")
# Errors: metres up and aside, degrees about a horizontal axis.
ERRORS = {
    "none": (0.0, 0.0, 0.0),
    "60 mm up": (0.06, 0.0, 0.0),
    "60 mm down": (-0.06, 0.0, 0.0),
    "60 mm aside": (0.0, 0.06, 0.0),
    "20 degrees": (0.0, 0.0, 20.0),
    "40 degrees": (0.0, 0.0, 40.0),
    "180 degrees": (0.0, 0.0, 180.0),
}


def wrong_pose(
    test: PhysicsTest, pose: np.ndarray, error: tuple[float, float, float]
) -> np.ndarray:
    """A pose (4, 4) master_from_object with an error about and of its centre of mass."""
    up = test.up_from_master[2, :3]
    side = np.cross(up, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    turn = rotation_exp(np.radians(error[2]) * side)
    centre, result = test.mesh.centre_at(pose), pose.copy()
    result[:3, :3] = turn @ pose[:3, :3]
    shift = error[0] * up + error[1] * side
    result[:3, 3] = turn @ (pose[:3, 3] - centre) + centre + shift
    return result


def verdict(test: PhysicsTest, pose: np.ndarray, sigma: float) -> str:
    """What the rest test says about a pose (4, 4) master_from_object."""
    moved = test.displacement(pose, sigma)
    if np.isnan(moved):
        return "not judged"
    return "contradicted" if moved > BAD_REST_M else "accepted"


def tests(project: Project) -> Iterator[PhysicsTest]:
    """Physics of each recording with a joint fit and an object."""
    for name in project.sequences:
        paths, object_ = project.paths(name), project.models(name).object_
        if paths.joint.exists() and object_ is not None:
            yield PhysicsTest(ObjectMesh.load(object_), paths)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("settings", nargs="+", type=Path)
    counts = {name: dict.fromkeys(VERDICTS, 0) for name in ERRORS}
    for path in parser.parse_args(arguments).settings:
        for test in tests(load_project(path)):
            for rest in (rest for rest in test.rests() if rest.support.known):
                t = (rest.first + rest.last) // 2
                for error, amount in ERRORS.items():
                    pose = wrong_pose(test, test.poses[t], amount)
                    counts[error][verdict(test, pose, test.sigma[t])] += 1
    table = ListTable("error", *VERDICTS, title="rests by the verdict of the rest test")
    for error, by_verdict in counts.items():
        table.add_row(error, *(str(by_verdict[name]) for name in VERDICTS))
    standard_console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
