"""init, check and run as an installed wheel has them, for the releases of InterCap and BEHAVE.

The fixture ``recorded`` takes the same steps for own recordings, in a checkout and to the end.
"""

from __future__ import annotations

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

from intercap_core.entries import SequenceEntry
from intercap_core.formats.recordings.layouts import open_layout
from intercap_core.geometry.camera.rig import Rig
from intercap_core.studio.render import Aligner
from tests.helpers.flow import ONE, ROOT, Flow, share_kernels
from tests.helpers.release_folders import write_behave, write_intercap

FPS, FRAMES = 15, 6


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
    share_kernels(folder / "intercap_core", folder / "kernels")
    return folder


class Release:
    """Writers of one virtual recording as the releases have it: depth on the colour grid."""

    def __init__(self, flow: Flow) -> None:
        self.source = flow.results / "recordings" / ONE
        row = SequenceEntry(
            sequence=ONE, subject="s03", layout="plain", recordings=self.source,
            calibration=self.source / "calibration.yaml",
        )  # fmt: skip
        layout = open_layout(row)
        cameras = []
        for name in layout.names:
            with layout.open(name) as recording:
                cameras.append(recording.camera)
        self.aligners = [Aligner(camera) for camera in cameras]
        self.rig = Rig(
            tuple(replace(c, depth=c.colour, colour_from_depth=np.eye(4)) for c in cameras)
        )

    def colour(self, t: int, c: int) -> bytes | None:
        path = self.source / self.rig.names[c] / f"{t:06d}.jpg"
        return path.read_bytes() if path.exists() else None

    def depth(self, t: int, c: int) -> np.ndarray | None:
        path = self.source / self.rig.names[c] / "depth" / f"{t:06d}.png"
        return self.aligners[c].align(cv2.imread(str(path), -1)) if path.exists() else None

    def keypoints(self, c: int) -> dict[int, str]:
        """Content of a camera's keypoint files by frame."""
        name = self.rig.names[c]
        frames = sorted(int(path.stem) for path in (self.source / name).glob("*.jpg"))
        files = sorted((self.source / "keypoints" / name).iterdir())
        return {t: file.read_text() for t, file in zip(frames, files, strict=True)}

    def intercap(self, root: Path) -> list[str]:
        """Write InterCap's folders; returns the options of init."""
        numbers = {2 * t: t for t in range(FRAMES)}  # numbers count periods of 30 Hz
        write_intercap(
            root, self.rig, numbers=numbers, sequence="03/01/Seg_1",
            colour=lambda number, c: self.colour(numbers[number], c),
            depth=lambda number, c: self.depth(numbers[number], c),
        )  # fmt: skip
        for c, name in enumerate(self.rig.names):
            folder = root / "keypoints" / "03" / "01" / "Seg_1" / name
            folder.mkdir(parents=True)
            for t, text in self.keypoints(c).items():
                (folder / f"{2 * t:05d}_keypoints.json").write_text(text)
        return ["--keypoints", str(root / "keypoints")]

    def behave(self, root: Path) -> list[str]:
        """Write BEHAVE's folders; returns the options of init."""
        times = [f"{t / FPS:08.3f}" for t in range(FRAMES)]
        recordings, _ = write_behave(
            root, self.rig, times=times, colour=self.colour, depth=self.depth,
            sequence="Date03_Sub03_suitcase_carry",
        )  # fmt: skip
        for c in range(len(self.rig)):
            for t, text in self.keypoints(c).items():
                (recordings / f"t{times[t]}" / f"k{c}.color.json").write_text(text)
        mesh = root / "objects" / "suitcase" / "suitcase_f1000.ply"
        mesh.parent.mkdir(parents=True)
        shutil.copy(ROOT / "config" / "objects" / "01_suitcase.ply", mesh)
        return []


MODULE = """
from intercap_core.shipped import shipped
configfile: "lab/project/config.yaml"
module intercap:
    snakefile: str(shipped("workflow/Snakefile"))
    config: config
use rule * from intercap
"""


@pytest.mark.parametrize(
    ("layout", "sequence"),
    [
        pytest.param("intercap", "s03_o01_seg1", marks=pytest.mark.full),
        ("behave", "Date03_Sub03_suitcase_carry"),
    ],
)
def test_three_commands_need_no_checkout(
    packages: Path, flow: Flow, tmp_path: Path, layout: str, sequence: str
) -> None:
    """From an installed wheel; and its rules as a module of another workflow."""
    kernels = str(packages / "kernels")

    def run(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", *arguments], cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(packages), "NUMBA_CACHE_DIR": kernels},
            capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    options = getattr(Release(flow), layout)(tmp_path / "lab" / "release")
    settings = "lab/project/config.yaml"
    written = run("intercap_core.cli", "init", "lab/release", "--output", "lab/project", *options)
    assert written.splitlines()[1].split()[:2] == [sequence, layout]
    assert "1 of 1 sequences are ready to run" in run("intercap_core.cli", "check", settings)
    run("intercap_core.cli", "run", settings, "--cores", "2", "--", "--until", "frames")
    results = Path("lab/project/results") / layout / sequence
    assert [path.stem for path in (tmp_path / results).glob("*.h5")] == ["frames"]
    assert not (tmp_path / ".snakemake").exists()  # it works in the project's folder
    if layout == "behave":  # once
        (tmp_path / "Snakefile").write_text(MODULE)
        assert f"{results}/joint.h5" in run("snakemake", "--dry-run", "--cores", "1")
