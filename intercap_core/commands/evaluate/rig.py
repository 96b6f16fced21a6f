"""Part ``rig`` of `intercap dev evaluate`: camera poses found without a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from intercap_core.calibrate.draft import draft_rig
from intercap_core.calibrate.rig_poses import find_poses
from intercap_core.commands.calibrate import record
from intercap_core.commands.console import ListTable, standard_console
from intercap_core.commands.evaluate.part import (
    EvaluationPart,
    Figures,
    Measured,
    config_files,
    keyed,
    number,
    truth_of,
    with_spread,
)
from intercap_core.errors import UserError
from intercap_core.evaluation.rig_errors import RigErrors, figures, pose_errors
from intercap_core.formats.calibration.boards import parse_board
from intercap_core.project import Project
from intercap_core.studio.board import write_board_recording
from intercap_core.studio.stage import StudioStage

BOARD = "charuco:6x4:0.15:0.115:4X4_50"  # 0.9 by 0.6 m
_BOARD_SETS, _BOARD_FPS = 60, 2


def measure(project: Project, sequence: str) -> list[RigErrors]:
    """Errors of the poses by the person, and without depth also by a board."""
    row = project.sequences[sequence]
    paths = project.paths(sequence)
    depth = project.captures[sequence].depth
    found = [
        _errors(
            project, sequence, "person_depth" if depth else "person_colour",
            [(paths.frames, paths.detections)], board=False,
        )
    ]  # fmt: skip
    if not depth:
        folder = project.results / "boards" / sequence
        if not folder.exists():
            assert project.config.studio is not None  # rows of this part are virtual
            stage = StudioStage(
                project.captures[sequence], project.config.studio, project.object_of(sequence)
            )
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
        found.append(_errors(project, sequence, "board", recorded, board=True))
    return found


def _errors(
    project: Project,
    sequence: str,
    evidence: str,
    recorded: Sequence[tuple[Path, Path | None]],
    *,
    board: bool,
) -> RigErrors:
    height = project.subjects[project.sequences[sequence].subject].height
    try:
        found = find_poses(
            recorded,
            board=parse_board(BOARD) if board else None,
            height_m=height,
            distance=None,
        )
    except UserError as error:
        return RigErrors(sequence, evidence, np.zeros(0), np.zeros(0), str(error))
    poses = found.rig.master_from_colour
    errors = pose_errors(truth_of(project, sequence), found.rig.names, poses)
    sigma = np.array([found.sigma_m(c) for c in range(1, len(found.rig))])
    return RigErrors(sequence, evidence, errors, sigma)


Rigs = Measured[list[RigErrors]]


def _all(recordings: Sequence[list[RigErrors]]) -> Figures:
    return figures([rig for recording in recordings for rig in recording])


def flat(evaluations: Sequence[Rigs]) -> Figures:
    """Keys ``rig.<measure>``."""
    found: Figures = {}
    for measured in evaluations:
        found |= keyed(f"{measured.dataset}.", with_spread(_all, measured.errors))
    return found


def print_rigs(evaluations: Sequence[Rigs]) -> None:
    """Print a table with a row per calibration."""
    console = standard_console()
    table = ListTable(
        "recording", "by", "error mm", "worst", "estimated", "", title="poses without a calibration"
    )
    for found in evaluations:
        for rig in (rig for recording in found.errors for rig in recording):
            error, sigma = 1e3 * rig.error, 1e3 * rig.sigma
            cells = (
                [number(float(v), 1) for v in (error.mean(), error.max(), sigma.mean())]
                if len(error)
                else [""] * 3
            )
            table.add_row(rig.sequence, rig.evidence, *cells, rig.problem)
    console.print(table)


PART = EvaluationPart(
    name="rig",
    stage="detections",
    settings=config_files("rig", "config"),
    budget_minutes=4.0,
    measure=measure,
    flat=flat,
    print_tables=print_rigs,
)
