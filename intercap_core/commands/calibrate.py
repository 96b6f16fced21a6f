"""`intercap calibrate`: camera poses of a rig from its recordings."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from intercap_core.calibrate.advice import advise, describe_floor
from intercap_core.calibrate.draft import RigDraft, draft_rig, write_calibration
from intercap_core.calibrate.found_rig import FoundRig
from intercap_core.calibrate.rig_poses import find_poses
from intercap_core.commands.console import ListTable, print_plain, standard_console
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.boards import parse_board
from intercap_core.formats.recordings.frames import Frames
from intercap_core.output.site.calibration_page import calibration_page
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project
from intercap_core.scene.floor import floor_under_feet


def calibrate(
    project: Project,
    sequence: str,
    *,
    output: Path | None,
    lenses: Path | None,
    board: str | None,
    recordings: Sequence[Path],
    distance: str | None,
    master: str | None,
    replace: bool,
    background: bool = False,
) -> tuple[Path, Path]:
    """Find the poses, write them and a page, and print a summary.

    Returns the paths of the calibration and of the page. Raises UserError as :func:`find_poses`,
    and if the output exists.
    """
    project.require_sequence(sequence)
    row = project.sequences[sequence]
    path = output or row.calibration
    if path.exists() and not replace:
        raise UserError(
            f"{path}: exists and is not replaced; name another file (--output), or give --replace"
        )
    parsed_board = None if board is None else parse_board(board)
    parsed_distance = None if distance is None else _parse_distance(distance)
    draft = draft_rig(row, lenses, master)
    for name in parsed_distance[:2] if parsed_distance else ():
        if name not in draft.names:
            known = ", ".join(draft.names)
            raise UserError(f"--distance names camera {name!r}; expected one of {known}")
    used = project.config.frames.cameras
    left_out = [name for name in draft.names if used and name not in used]
    if left_out:
        raise UserError(
            f"{project.path}: frames.cameras leaves out {', '.join(left_out)}, and calibrate finds "
            "the poses of all recorded cameras; remove the setting, or their recordings"
        )
    paths = record(project, row, draft, recordings)
    found = find_poses(
        paths,
        board=parsed_board,
        height_m=project.subjects[row.subject].height,
        distance=parsed_distance,
        without_lens=draft.without_lens,
        keep_lenses=draft.content is None,
        background=background,
    )
    with Frames.open(paths[0][0]) as frames:
        ground, up = floor_under_feet(found.rig, found.residuals.body, frames.gravity)
    rows, advice = _rows(found), advise(found, ground, up.direction)
    floor = describe_floor(ground, up.source, up.deviation_deg, found.rig.names[0])
    page = project.results / "calibrate" / sequence / "calibration.html"
    html = calibration_page(sequence, found, up.direction, rows, advice, floor)
    order = [found.rig.names.index(name) for name in draft.names]
    write_calibration(path, _with_lenses(draft, found), found.rig.master_from_colour[order])
    page.write_text(html, encoding="utf-8")
    _print(rows, [f"scale by {found.scale}", floor, *(item.text for item in advice)])
    return path, page


def record(
    project: Project, row: SequenceEntry, draft: RigDraft, folders: Sequence[Path]
) -> list[tuple[Path, Path | None]]:
    """Run stages ``frames`` and ``detections`` of the row and of further recordings of the rig.

    The stages read a calibration, so they get one with the cameras in a row, 1 m apart: neither
    frames nor detections depend on the poses. Results are in ``calibrate`` of the project's results
    and are kept for the next run.

    Args:
        folders: further recordings with the same layout and cameras, without keypoints.

    Returns:
        Paths of both artefacts, of the row first; None = without detections.
    """
    places = project.results / "calibrate"
    in_a_row = np.tile(np.eye(4), (len(draft.names), 1, 1))
    in_a_row[:, 0, 3] = np.arange(len(draft.names))
    start = places / row.sequence / "start.json"
    write_calibration(start, draft, in_a_row)
    unused = dict.fromkeys(("calibration_scale", "calibration_up", "calibration_floor"))
    rows = {row.sequence: row.model_copy(update={"calibration": start, **unused})}
    for number, folder in enumerate(folders, 1):
        name = f"{row.sequence}_{number}"
        nothing = dict.fromkeys(("keypoints", "candidates", "annotation"))
        rows[name] = rows[row.sequence].model_copy(
            update={"sequence": name, "recordings": folder, **nothing}
        )
    config = project.config.model_copy(update={"results": project.results, "dataset": "calibrate"})
    own = dataclasses.replace(project, config=config, sequences=rows)
    detected = project.config.detections.keypoint_model is not None
    paths = []
    for name, own_row in rows.items():
        run_step("frames", own, name, keep=True)
        people = None
        if own_row.keypoints is not None or detected:
            people = run_step("detections", own, name, keep=True)
        paths.append((own.artefact(name, "frames"), people))
    return paths


def _parse_distance(text: str) -> tuple[str, str, float]:
    names = text.split(":")
    try:
        first, second, metres = names[0], names[1], float(names[2])
    except (IndexError, ValueError):
        metres = 0.0
    if len(names) != 3 or not 0 < metres < np.inf or first == second:
        raise UserError(
            f"--distance {text!r}: expected CAMERA:CAMERA:METRES, for example k1:k2:2.35"
        )
    return first, second, metres


def _with_lenses(draft: RigDraft, found: FoundRig) -> RigDraft:
    """The draft with estimated lenses."""
    if draft.content is None or not found.new_lenses:
        return draft
    entries = dict(draft.content["cameras"])
    for name, estimate in found.new_lenses.items():
        lens = estimate.lens
        entries[name] = entries[name] | {
            "camera_matrix": lens.matrix.tolist(),
            "distortion_coefficients": lens.distortion.tolist(),
        }
    return RigDraft(draft.names, draft.content | {"cameras": entries}, frozenset())


def _rows(found: FoundRig) -> list[dict[str, str]]:
    """Table of the cameras."""

    def number(value: float) -> str:
        return "–" if np.isnan(value) else f"{value:.1f}"

    return [
        {
            "name": name,
            "sigma": "reference" if c == 0 else f"{1e3 * found.sigma_m(c):.1f}",
            "joints": str(found.joints[c]),
            "joint_error": number(found.residuals.joint_px[c]),
            "boards": str(found.boards[c] or ""),
            "corner_error": number(found.residuals.corner_px[c]),
            "lag": str(found.lags[c] or ""),
        }
        for c, name in enumerate(found.rig.names)
    ]


def _print(rows: list[dict[str, str]], lines: list[str]) -> None:
    console = standard_console()
    table = ListTable(
        "camera",
        "estimated error, mm",
        "joints",
        "error, px",
        "boards",
        "error, px",
        "late, frames",
    )
    for row in rows:
        table.add_row(*row.values())
    console.print(table)
    for line in lines:
        print_plain(console, line)
