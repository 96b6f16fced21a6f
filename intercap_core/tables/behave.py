"""The tables of a project for the BEHAVE data set."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from intercap_core.errors import UserError
from intercap_core.formats.recordings.behave import frame_folders
from intercap_core.formats.released import PERSON_MESH
from intercap_core.inputs.documents import read_json
from intercap_core.inputs.files import UnreadableFile
from intercap_core.tables.project_files import Draft, Row

SEQUENCE = re.compile(r"(Date\d{1,4})_(Sub\d{1,4})_([A-Za-z0-9]+)(?:_[A-Za-z0-9_-]+)?")


def is_release(root: Path) -> bool:
    """Whether the folder is a copy of the data set."""
    folder = root / "sequences"
    return folder.is_dir() and any(SEQUENCE.fullmatch(path.name) for path in folder.iterdir())


def draft(root: Path, *, dataset: str, results: Path | None = None) -> Draft:
    """List the sequences of the data set.

    Sequences without frames, calibration or mesh are left out with a remark. Raises UserError if
    no sequence is left.

    Args:
        root: folder with ``sequences``, ``calibs`` and ``objects``.
        results: folder of the data set's own results, which are converted instead of a joint fit:
            ``root`` (registrations in the frames' folders), or the parameters at 30 frames a second
            with their meshes. It has a folder for each sequence, directly or in ``sequences``.
            None = run the joint fit.
    """
    result = Draft(dataset)
    meshes: dict[str, dict[str, Any]] = {}
    folder = root / "sequences"
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = SEQUENCE.fullmatch(path.name)
        if not match or not path.is_dir() or len(path.name) > 80:  # as config.Name
            continue
        date, subject, object_name = match.groups()
        row, fault = _row(root, path, date, subject, object_name)
        mesh = _find_mesh(root, object_name)
        fault = fault or ("" if mesh else f"objects/{object_name} holds no mesh")
        if fault:
            result.remarks.append(f"{path.name} is left out: {fault}")
            continue
        gender = _gender(path)
        known = result.subjects.setdefault(subject, gender or "neutral")
        if gender is None:
            row.remarks.append(f"info.json states no gender: {subject} is {known}")
        elif gender != known:
            row.remarks.append(f"info.json states {gender}, another sequence of {subject} {known}")
        meshes[object_name] = {"mesh": mesh, "labels": [object_name]}
        if results is not None:
            _name_results(row, results)
        result.rows.append(row)
    if not result.rows:
        raise UserError(
            f"{root}: holds no sequences/Date<nn>_Sub<nn>_<object> with frames, calibration and "
            "mesh; give the folder that the data set was unpacked to"
            + "".join(f" ({remark})" for remark in result.remarks[:1])
        )
    result.objects = dict(sorted(meshes.items()))
    return result


def _row(root: Path, path: Path, date: str, subject: str, object_name: str) -> tuple[Row, str]:
    """The row of a sequence, and the reason why it cannot be used; "" = it can be used."""
    calibration = root / "calibs" / date / "config"
    row = Row(
        {
            "sequence": path.name,
            "subject": subject,
            "object": object_name,
            "layout": "behave",
            "recordings": path,
            "calibration": calibration,
        }
    )
    try:
        frames = frame_folders(path)
    except UserError as error:
        return row, str(error)
    if not frames:
        return row, "it holds no frame folders"
    if not calibration.is_dir():
        return row, f"there is no calibs/{date}/config"
    return row, ""


def _name_results(row: Row, results: Path) -> None:
    """Name the results of the row's sequence, or remark that there are none."""
    name = str(row.columns["sequence"])
    meshes = f"t*/{PERSON_MESH.as_posix()}"
    for folder in (results / "sequences" / name, results / name):
        if any(folder.glob(meshes)):
            row.columns["results"] = folder
            return
    row.remarks.append(f"{results} holds no {name}/{meshes}: the joint fit runs instead")


def _find_mesh(root: Path, object_name: str) -> Path | None:
    """The simplified mesh, which is closed, or else another one; None if there is none."""
    folder = root / "objects" / object_name
    patterns = ("*_f[0-9]*.ply", "*.ply", "*.obj")
    return next((path for pattern in patterns for path in sorted(folder.glob(pattern))), None)


def _gender(path: Path) -> str | None:
    try:
        content = read_json(path / "info.json")
    except UnreadableFile:
        return None
    gender = content.get("gender") if isinstance(content, dict) else None
    return gender if gender in ("female", "male", "neutral") else None
