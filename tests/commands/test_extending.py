"""The examples of docs/extending.md run in a copy of the package."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.extending import apply_chapter

ROOT = Path(__file__).resolve().parents[2]


def run_chapter(title: str, folder: Path) -> list[Path]:
    """Put a chapter into a copy of the package and run its test; returns the other files."""
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "intercap_core", folder / "intercap_core", ignore=ignored)
    files = apply_chapter(title, folder)
    tests = [path for path in files if path.name.startswith("test_")]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *map(str, tests)],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return [path for path in files if path not in tests]


@pytest.mark.parametrize("title", ["A new keypoint layout", "A new converter"])
def test_keypoints_of_another_detector_take_one_file(title: str, tmp_path: Path) -> None:
    assert len(run_chapter(title, tmp_path)) == 1
