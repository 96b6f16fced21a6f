"""Errors of body_fit with and without the shape of another sequence (column ``shape_from``).

    python -m bench.shape_from [SETTINGS] [--only SEQUENCE ...]

SETTINGS (default: config/body/shape_from.yaml) must have run to the stage `person`. Each row with
``shape_from`` is fitted from all views with depth and from two colour views, alone and with the
shape that the other row has in all views with depth. Prints a table with a row per fit: rest shape
(mean vertex distance of the T-poses after rigid alignment), body joints and vertices, mm, seconds
of CPU time, and the note of a shape that was not used. Results are in ``shape_from`` of the
project's results.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np

from bench.command import exit_on_user_error
from bench.evaluate.body_errors import landmark_error
from bench.evaluate.part import number, truth_of
from intercap_core import artefacts
from intercap_core.body.loading import load_body_file
from intercap_core.commands.console import ListTable, standard_console
from intercap_core.evaluation import body
from intercap_core.evaluation.tracks import read_body
from intercap_core.evaluation.truth import Truth
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project, load_project
from intercap_core.schemas import BODY_FIT, SCENE
from intercap_core.stages import body_fit
from intercap_core.studio.subjects import Subject

TWO_VIEWS = ("k1", "k3")


def with_two_colour_views(project: Project) -> Project:
    """The same recordings seen by two cameras without depth."""
    frames = project.config.frames.model_copy(update={"cameras": TWO_VIEWS, "depth": False})
    results = project.results / "two_colour_views"
    config = project.config.model_copy(update={"frames": frames, "results": results})
    return dataclasses.replace(project, config=config)


def fit(project: Project, sequence: str, output: Path, shape_from: Path | None) -> float:
    """Fit one sequence; returns the seconds of CPU time."""
    for stage in ("frames", "detections", "scene", "person"):
        run_step(stage, project, sequence, keep=True)
    paths, models = project.paths(sequence), project.models(sequence)
    output.parent.mkdir(parents=True, exist_ok=True)
    begin = time.process_time()
    body_fit.run(
        frames=paths.frames,
        scene=paths.scene,
        person=paths.person,
        output=output,
        subject=models.subject,
        body_models=models.body_models,
        settings=project.config.body_fit,
        shape_from=shape_from,
    )
    return time.process_time() - begin


def errors_mm(project: Project, sequence: str, path: Path) -> tuple[float, float, float, str]:
    """Errors of rest shape, body joints and vertices, mm, and the note on the shape."""
    models = project.models(sequence)
    track = read_body(path, "body_fit", models.body_models, models.gender)
    with artefacts.read(project.paths(sequence).scene, SCENE) as scene:
        times, fps = scene["times"], float(scene.attributes["fps"])
    known = Truth.load(truth_of(project, sequence), times, fps, track.model.num_vertices)
    assert known.vertices is not None
    pairs = zip(track.vertices(), known.vertices, strict=True)
    vertices = np.mean([body.vertex_error(found, true) for found, true in pairs])
    joints = body.joint_error(track.joints, known.joints).mean()
    with artefacts.read(path, BODY_FIT) as written:
        betas, note = written["betas"][~written["failed"]].mean(0), written.attributes
    file = load_body_file(None, len(betas), num_expression=0)
    subject = Subject.load(models.subject.subject)
    rest = file.template + file.shape_directions @ betas
    true = subject.on_fitted_topology(subject.rest[None])[0]
    shape = landmark_error(rest, true, align=True)
    return 1e3 * shape, 1e3 * joints, 1e3 * vertices, str(note.get("shape_note", ""))


def main() -> None:
    """Fit, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path("config/body/shape_from.yaml")
    parser.add_argument("settings", type=Path, nargs="?", default=default)
    parser.add_argument("--only", nargs="+", default=[])
    chosen = parser.parse_args()
    project = load_project(chosen.settings)
    console = standard_console()
    table = ListTable("recording", "views", "shape of", "rest mm", "joints", "vertices", "s", "")
    for sequence, row in project.sequences.items():
        source = row.shape_from
        if source is None or (chosen.only and sequence not in chosen.only):
            continue
        folder = project.results / "shape_from"
        known = folder / f"{source}.h5"
        if not known.exists():
            fit(project, source, known, None)
        for views, some in (("all", project), ("two", with_two_colour_views(project))):
            for shape in (None, known):
                path = folder / views / f"{sequence}{'_reused' if shape else ''}.h5"
                seconds = fit(some, sequence, path, shape)
                *errors, note = errors_mm(some, sequence, path)
                cells = [number(float(error), 1) for error in (*errors, seconds)]
                table.add_row(sequence, views, source if shape else "", *cells, note)
                print(sequence, views, source if shape else "alone", *cells, note, flush=True)
    console.print(table)


if __name__ == "__main__":
    with exit_on_user_error():
        main()
