"""The tables of a project for the BEHAVE data set."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from intercap_core.errors import UserError
from intercap_core.formats.recordings.behave import frame_folders
from intercap_core.formats.released import PERSON_MESH
from intercap_core.inputs.documents import read_json
from intercap_core.inputs.files import Unreadable
from intercap_core.tables.project_files import Draft, Row

SEQUENCE = re.compile(r"(Date\d{1,4})_(Sub\d{1,4})_([A-Za-z0-9]+)(?:_[A-Za-z0-9_-]+)?")
LONGEST_NAME = 80  # of config.Name
GENDERS = ("female", "male", "neutral")


def draft(root: Path, *, dataset: str, results: Path | None = None) -> Draft:
    """List the sequences of ``root``, which holds ``sequences``, ``calibs`` and ``objects``.

    ``results`` (what the data set itself found) holds a folder for each sequence, or
    ``sequences`` with these: ``root`` itself, whose folders of frames hold registrations, or the
    parameters at 30 fps.
    Sequences without frames or calibration, and objects without a mesh, are left out with a remark.
    Raises UserError where nothing is left.
    """
    result = Draft(dataset)
    meshes: dict[str, dict[str, Any]] = {}
    folder = root / "sequences"
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = SEQUENCE.fullmatch(path.name)
        if not match or not path.is_dir() or len(path.name) > LONGEST_NAME:
            continue
        date, subject, thing = match.groups()
        row, fault = _row(root, path, date, subject, thing)
        mesh = _mesh(root, thing)
        fault = fault or ("" if mesh else f"objects/{thing} holds no mesh")
        if fault:
            result.remarks.append(f"{path.name} is left out: {fault}")
            continue
        gender = _gender(path)
        known = result.subjects.setdefault(subject, gender or "neutral")
        if gender is None:
            row.remarks.append(f"info.json states no gender: {subject} is {known}")
        elif gender != known:
            row.remarks.append(f"info.json says {gender}, another sequence of {subject} {known}")
        meshes[thing] = {"mesh": mesh, "labels": [thing]}
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


def _row(root: Path, path: Path, date: str, subject: str, thing: str) -> tuple[Row, str]:
    calibration = root / "calibs" / date / "config"
    row = Row(
        {
            "sequence": path.name,
            "subject": subject,
            "object": thing,
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
    places = [results / "sequences" / name, results / name]
    meshes = f"t*/{PERSON_MESH.as_posix()}"
    there = next((place for place in places if any(place.glob(meshes))), None)
    if there is None:
        row.remarks.append(f"{results} holds no {name}/{meshes}: our joint fit is made")
        return
    row.columns["results"] = there


def _mesh(root: Path, thing: str) -> Path | None:
    """The simplified mesh, which is closed, before the textured scan."""
    folder = root / "objects" / thing
    for pattern in ("*_f[0-9]*.ply", "*.ply", "*.obj"):
        found = sorted(folder.glob(pattern)) if folder.is_dir() else []
        if found:
            return found[0]
    return None


def _gender(path: Path) -> str | None:
    try:
        content = read_json(path / "info.json")
    except Unreadable:
        return None
    gender = content.get("gender") if isinstance(content, dict) else None
    return gender if gender in GENDERS else None
