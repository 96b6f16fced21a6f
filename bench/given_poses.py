"""Errors of an object's track without, with one and with more annotated poses.

    intercap run config/object/two_cameras_2.yaml -- --until object_track
    python -m bench.given_poses

The object is tracked again from the stored artefacts. The annotated poses are true poses with an
error of one centimetre and five degrees, in frames in which the stored track is lost.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from bench.command import add_figures, exit_on_user_error
from intercap_core import artefacts
from intercap_core.annotation import ObjectPose
from intercap_core.commands.evaluate.objects import measure
from intercap_core.errors import UserError
from intercap_core.evaluation import object_errors
from intercap_core.evaluation.object_errors import ObjectErrors
from intercap_core.evaluation.truth import match_times
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.pipeline import stage_inputs
from intercap_core.project import Project, load_project
from intercap_core.schemas import OBJECT_TRACK, SCENE, TRUTH
from intercap_core.stage_list import STAGES
from intercap_core.stages import object_track

OFF_M, OFF_DEGREES = 0.01, 5.0
_COLUMNS = ("lost", "unseen", "mm", "p95", "deg", "there mm", "p95", "deg", "carried", "flagged")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "settings", type=Path, nargs="?", default=Path("config/object/two_cameras_2.yaml")
    )
    parser.add_argument("--sequences", nargs="*", help="those whose track is truly lost, else")
    parser.add_argument("--poses", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("results/bench.json"))
    arguments = parser.parse_args()
    with exit_on_user_error():
        project = load_project(arguments.settings)
        compare(project, arguments.sequences, arguments.poses, arguments.seed, arguments.output)


def compare(
    project: Project, names: Sequence[str] | None, counts: Sequence[int], seed: int, output: Path
) -> None:
    """Print the errors of the tracks with each number of poses and add them to ``output``.

    Without ``names``, all sequences whose track is lost in some frame are evaluated.
    """
    table = Table("sequence", "poses", *_COLUMNS, box=None)
    table.title = "errors over all frames, and there: in those that are lost without poses"
    for name in names or _lost_sequences(project):
        before = measure(project, name)
        for count in (0, *counts):
            frames = spread_over(before.lost, count)
            poses = poses_from_truth(project, name, frames, seed)
            errors, carried, lost = track(project, name, poses)
            own = figures(errors, before.lost) | {
                "carried_share": float(carried.mean()),
                "said_lost_share": float(lost.mean()),
            }
            table.add_row(name, str(count), *(f"{value:.3g}" for value in own.values()))
            add_figures(output, f"given_poses.{project.config.dataset}.{name}.{count}", own)
    Console(width=140).print(table)


def _lost_sequences(project: Project) -> list[str]:
    there = [name for name in project.sequences if project.artefact(name, "object_track").is_file()]
    return [name for name in there if measure(project, name).lost.any()]


def spread_over(lost: np.ndarray, count: int) -> list[int]:
    """Indices of ``count`` frames, evenly spaced over the ``lost`` frames (T,)."""
    frames = np.flatnonzero(lost)
    if count > len(frames):
        raise UserError(f"{count} poses were asked for, and {len(frames)} frames are lost")
    return [int(frames[int((i + 0.5) * len(frames) / count)]) for i in range(count)]


def poses_from_truth(
    project: Project, name: str, frames: Sequence[int], seed: int
) -> list[ObjectPose]:
    """True poses of ``frames`` with errors of :data:`OFF_M` and :data:`OFF_DEGREES`.

    Every error has its own direction.
    """
    truth, entry = project.sequences[name].truth, project.object_of(name)
    assert truth is not None and entry is not None
    centre = ObjectMesh.load(entry).centre_of_mass
    with (
        artefacts.read(project.artefact(name, "scene"), SCENE) as scene,
        artefacts.read(truth, TRUTH) as true,
    ):
        at = match_times(truth, true["times"], scene["times"], float(scene.attributes["fps"]))
        rotation, translation = true["rotation"][at], true["translation"][at]
    found = []
    for t in frames:
        axis, aside = np.random.default_rng([seed, t]).normal(size=(2, 3))
        turn = Rotation.from_rotvec(np.radians(OFF_DEGREES) * axis / np.linalg.norm(axis))
        turned = turn.as_matrix() @ rotation[t]
        place = rotation[t] @ centre + translation[t] + OFF_M * aside / np.linalg.norm(aside)
        found.append(
            ObjectPose(
                frame=t,
                rotation_vector=tuple(Rotation.from_matrix(turned).as_rotvec().tolist()),
                translation=tuple((place - turned @ centre).tolist()),
                sigma_m=OFF_M,
                sigma_degrees=OFF_DEGREES,
            )
        )
    return found


def track(
    project: Project, name: str, poses: Sequence[ObjectPose]
) -> tuple[ObjectErrors, np.ndarray, np.ndarray]:
    """Errors of the track with these poses, and its masks (T,) of bridged and lost frames."""
    passed = stage_inputs.arguments(project, name, "object_track", project.annotation(name))
    inputs = {stage: project.artefact(name, stage) for stage in STAGES["object_track"].reads}
    truth, entry = project.sequences[name].truth, project.object_of(name)
    assert truth is not None and entry is not None
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "object_track.h5"
        object_track.run(**inputs, **passed | {"output": output, "poses": poses})
        errors = object_errors.measure(inputs["scene"], output, truth, ObjectMesh.load(entry))
        with artefacts.read(output, OBJECT_TRACK) as found:
            lost = found["lost"]
            carried = found["carried"] if "carried" in found else np.zeros_like(lost)
    return errors, carried, lost


def figures(errors: ObjectErrors, there: np.ndarray) -> dict[str, float]:
    """Shares, millimetres and degrees over all frames and over the mask ``there`` (T,)."""
    all_ = object_errors.figures([errors])
    found = {key: all_[key] for key in ("lost_share", "lost_unnoticed_share")}
    for prefix, frames in (("", np.ones_like(there)), ("there_", there)):
        shift, turn = 1e3 * errors.translation[frames], errors.rotation[frames]
        if len(shift):
            found[f"{prefix}median_mm"] = float(np.median(shift))
            found[f"{prefix}p95_mm"] = float(np.sort(shift)[int(0.95 * (len(shift) - 1))])
            found[f"{prefix}median_deg"] = float(np.median(turn))
    return found


if __name__ == "__main__":
    main()
