"""Part ``rig`` of `intercap dev evaluate`: camera poses found without a calibration.

All stages run twice on recordings with depth and an object: with the given and the found poses.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.evaluate.board_recording import write_board_recording
from bench.evaluate.part import (
    EvaluationPart,
    Figures,
    Measured,
    config_files,
    keyed,
    truth_of,
    with_spread,
)
from bench.evaluate.rig_errors import ChainErrors, RigErrors, figures, pose_errors
from intercap_core.calibrate.draft import draft_rig
from intercap_core.calibrate.rig_poses import find_poses
from intercap_core.commands.calibrate import record
from intercap_core.errors import UserError
from intercap_core.formats.calibration.boards import parse_board
from intercap_core.formats.calibration.extrinsics import Extrinsics, write_rig_file
from intercap_core.geometry.camera.rig import Rig
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project
from intercap_core.stage_list import STAGES
from intercap_core.studio.stage import StudioStage

BOARD = "charuco:6x4:0.15:0.115:4X4_50"  # 0.9 by 0.6 m
_BOARD_SETS, _BOARD_FPS = 60, 2


def measure(project: Project, sequence: str) -> list[RigErrors]:
    """Errors of the poses by the person, and also by the background or, without depth, a board.

    A bare room has no background that determines poses.
    """
    row = project.sequences[sequence]
    paths = project.paths(sequence)
    depth = project.captures[sequence].depth
    assert project.config.studio is not None  # rows of this part are virtual
    stage = StudioStage(
        project.captures[sequence], project.config.studio, project.object_of(sequence)
    )
    recorded: list[tuple[Path, Path | None]] = [(paths.frames, paths.detections)]
    person = "person_depth" if depth else "person_colour"
    found = [_errors(project, sequence, person, recorded)]
    if depth and stage.furnishing != "bare":
        found.append(_errors(project, sequence, "background", recorded))
    if not depth:
        folder = project.results / "boards" / sequence
        if not folder.exists():
            part = folder.with_suffix(".part")
            write_board_recording(
                part, stage.rig.true, parse_board(BOARD), sets=_BOARD_SETS, fps=_BOARD_FPS, seed=1
            )
            part.rename(folder)
        nothing = dict.fromkeys(("keypoints", "candidates"))
        of_board = row.model_copy(
            update={"recordings": folder, "sequence": f"{sequence}_board", **nothing}
        )
        recorded = record(project, of_board, draft_rig(of_board, None, None), [])
        found.append(_errors(project, sequence, "board", recorded))
    return found


def _errors(
    project: Project,
    sequence: str,
    evidence: str,
    recorded: Sequence[tuple[Path, Path | None]],
) -> RigErrors:
    """Errors of the poses by ``evidence`` in frames and detections, see :class:`RigErrors`."""
    height = project.subjects[project.sequences[sequence].subject].height
    try:
        found = find_poses(
            recorded,
            board=parse_board(BOARD) if evidence == "board" else None,
            height_m=height,
            distance=None,
            background=evidence == "background",
        )
    except UserError as error:
        return RigErrors(evidence, np.zeros(0), np.zeros(0), str(error))
    poses = found.rig.master_from_colour
    errors = pose_errors(truth_of(project, sequence), found.rig.names, poses)
    sigma = np.array([found.sigma_m(c) for c in range(1, len(found.rig))])
    rig = RigErrors(evidence, errors, sigma)
    if evidence != "person_depth" or not project.sequences[sequence].object:
        return rig
    try:
        return dataclasses.replace(rig, chain=_chain_errors(project, sequence, found.rig))
    except UserError as error:
        return dataclasses.replace(rig, problem=str(error))


def _chain_errors(project: Project, sequence: str, rig: Rig) -> ChainErrors:
    """Run all stages to ``joint`` with the given poses and with those of ``rig``."""
    config = project.config.model_copy(update={"results": project.results, "dataset": "found"})
    path = config.results / "found" / f"{sequence}.json"
    path.parent.mkdir(exist_ok=True)
    by_name = dict(zip(rig.names, rig.master_from_colour, strict=True))
    write_rig_file(path, Extrinsics(rig.names[0], by_name))
    row = project.sequences[sequence].model_copy(update={"calibration": path})
    with_found = dataclasses.replace(project, config=config, sequences={sequence: row})
    stages = list(STAGES)
    for stage in stages[: stages.index("joint") + 1]:
        for some in (project, with_found):
            run_step(stage, some, sequence, keep=True)
    given, found = (some.paths(sequence) for some in (project, with_found))
    truth = truth_of(project, sequence)
    return ChainErrors.measure(given, found, truth, project.models(sequence))


Rigs = Measured[list[RigErrors]]


def _pooled_figures(recordings: Sequence[list[RigErrors]]) -> Figures:
    return figures([rig for recording in recordings for rig in recording])


def flat(evaluations: Sequence[Rigs]) -> Figures:
    """Keys ``rig.<measure>``."""
    found: Figures = {}
    for measured in evaluations:
        found |= keyed(f"{measured.dataset}.", with_spread(_pooled_figures, measured.errors))
    return found


PART = EvaluationPart(
    name="rig",
    stage="detections",
    settings=config_files("rig", "config"),
    budget_minutes=6.5,
    measure=measure,
    flat=flat,
    columns=(
        *(f"pose_{name}_mm" for name in ("person_depth", "person_colour", "board", "background")),
        "error_over_estimate_median",
        "body_pve_ratio",
        "object_ratio",
    ),
    problems=lambda rigs: [f"{rig.evidence}: {rig.problem}" for rig in rigs if rig.problem],
)  # fmt: skip
