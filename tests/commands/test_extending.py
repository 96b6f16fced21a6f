"""The examples of docs/extending.md run in a copy of the package."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.extending import apply_chapter
from tests.helpers.flow import share_kernels
from tests.helpers.shared_folder import session_folder

ROOT = Path(__file__).resolve().parents[2]
CHAPTERS = {
    "A new keypoint layout": 1,
    "A new converter": 1,
    "A new recorder of bags": 2,
    "A new export format": 2,
}
"""Number of the files, besides the test, that each chapter writes or edits."""
FIXTURES = ("tests.output.conftest", "tests.output.export.conftest")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    """Files of each chapter in a copy of the package, in which the tests of all chapters pass."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(ROOT / "intercap_core", folder / "intercap_core")  # with compiled modules
    files = {title: apply_chapter(title, folder) for title in CHAPTERS}
    share_kernels(folder / "intercap_core", folder / "kernels")
    session = session_folder(tmp_path_factory)  # has the captures that the examples export
    tests = [path for of in files.values() for path in of if path.name.startswith("test_")]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider",
         f"--basetemp={session / 'extending'}",
         *(word for name in FIXTURES for word in ("-p", name)), *map(str, tests)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}",
             "NUMBA_CACHE_DIR": str(folder / "kernels"), "PYTEST_XDIST_WORKER": "extending"},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return {title: [path for path in of if path not in tests] for title, of in files.items()}


@pytest.mark.parametrize(("title", "count"), CHAPTERS.items())
def test_a_chapter_takes_one_file_and_its_name_in_a_list(
    title: str, count: int, files: dict[str, list[Path]]
) -> None:
    assert len(files[title]) == count
