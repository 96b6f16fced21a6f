"""Inputs that reproduce public bug reports, and further members of each kind."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from intercap_core.commands.check_recordings import RecordingCheck, check_row
from intercap_core.project import Project, load_project
from tests.conftest import PROJECT_ROOT

SEQUENCE = "s01_box"  # of all cases


def open_case(name: str, folder: Path) -> Project:
    """Copy a case to ``folder`` and open it; skips the test where the cases are not."""
    cases = Path(os.environ.get("INTERCAP_CASES", PROJECT_ROOT.parent / "shared" / "cases"))
    if not (cases / name).is_dir():
        pytest.skip(f"{cases / name} is not here; set INTERCAP_CASES to the folder that holds it")
    shutil.copytree(cases / name, folder / name, copy_function=shutil.copyfile)
    for path in [folder / name, *(folder / name).rglob("*")]:
        path.chmod(0o755 if path.is_dir() else 0o644)
    return load_project(folder / name / "config.yaml")


def check(project: Project) -> RecordingCheck:
    return check_row(project, project.sequences[SEQUENCE])
