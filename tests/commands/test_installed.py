"""init, check and run as an installed wheel has them, for recordings in three layouts."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from intercap_core.geometry.camera.rig import Rig
from tests.helpers.plain_capture import write_rig
from tests.helpers.release_folders import write_behave, write_intercap
from tests.helpers.synthetic_capture import COLOUR, ring

ROOT = Path(__file__).resolve().parents[2]
LENS = COLOUR.scaled(0.1)
PEOPLE = json.dumps({"people": [{"pose_keypoints_2d": [10.0, 20.0, 0.9] * 25}]})


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which the wheel's files are unpacked."""
    folder = tmp_path_factory.mktemp("packages")
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"][
        "targets"
    ]["wheel"]
    parts = {name: name for name in wheel["packages"]} | wheel["force-include"]
    for source, target in parts.items():
        (folder / target).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / source).is_dir():
            shutil.copytree(ROOT / source, folder / target)
        else:
            shutil.copy(ROOT / source, folder / target)
    return folder


def colour(number: int, c: int) -> bytes:
    image = np.full((LENS.height, LENS.width, 3), (20 * c, 30, 90), np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def depth(number: int, c: int) -> np.ndarray:
    return np.full((LENS.height, LENS.width), 2000 + c, np.uint16)


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    """A folder with a recording in the plain layout, in InterCap's and in BEHAVE's."""
    folder = tmp_path / "lab" / "captures"
    rig = Rig(tuple(replace(c, colour=LENS, depth=LENS, colour_from_depth=np.eye(4))
                    for c in ring(2)[0]))  # fmt: skip
    write_intercap(folder / "a", rig, numbers=range(2), colour=colour, depth=depth, sequence="one")
    write_behave(folder / "b", rig, times=("1.000", "2.000"), colour=colour, depth=depth)
    (folder / "c").mkdir()
    for path in write_rig(folder / "c", (LENS.width, LENS.height), 90.0).values():
        (path / "0.jpg").write_bytes(colour(0, 0))
        (path / "1.jpg").write_bytes(colour(1, 0))
        path = folder / "c" / "recordings" / "keypoints" / path.name
        path.mkdir(parents=True)
        (path / "0_keypoints.json").write_text(PEOPLE)
    first = folder / "a" / "RGBD_Images" / "one" / "keypoints" / "k1"
    first.mkdir(parents=True)
    (first / "00000_keypoints.json").write_text(PEOPLE)
    for place in (folder / "b" / "sequences").glob("*/t1.000"):
        (place / "k0.color.json").write_text(PEOPLE)
    return folder


MODULE = """
from intercap_core.shipped import shipped
configfile: "lab/project/config.yaml"
module intercap:
    snakefile: str(shipped("workflow/Snakefile"))
    config: config
use rule * from intercap
"""


def test_three_commands_need_no_checkout(packages: Path, captures: Path, tmp_path: Path) -> None:
    """From an installed wheel; and its rules as a module of another workflow."""

    def run(*arguments: str, folder: Path) -> str:
        done = subprocess.run(
            [sys.executable, "-m", *arguments],
            cwd=folder, env={**os.environ, "PYTHONPATH": str(packages)},
            capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    def intercap(*arguments: str, folder: Path) -> str:
        return run("intercap_core.cli", *arguments, folder=folder)

    written = intercap("init", "captures", "--output", "project", folder=captures.parent)
    rows = [line.split() for line in written.splitlines()[1:4]]
    assert [row[1] for row in rows] == ["intercap", "behave", "plain"]
    settings = "lab/project/config.yaml"
    assert "3 of 3 sequences are ready to run" in intercap("check", settings, folder=tmp_path)
    planned = intercap("run", settings, "--", "--dry-run", folder=tmp_path)
    assert "results/captures/a_RGBD_Images_one/joint.h5" in planned
    assert not (tmp_path / ".snakemake").exists()  # it works in the project's folder
    (tmp_path / "Snakefile").write_text(MODULE)
    planned = run("snakemake", "--dry-run", "--cores", "1", folder=tmp_path)
    assert "lab/project/results/captures/a_RGBD_Images_one/joint.h5" in planned
