"""`intercap calibrate` on image files of a board."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from intercap_core.commands.calibrate import calibrate
from intercap_core.errors import UserError
from intercap_core.evaluation.scene_errors import displacement
from intercap_core.formats.calibration.boards import parse_board
from intercap_core.formats.calibration.files import read_calibration
from intercap_core.geometry.camera.rig import Rig
from intercap_core.project import Project, load_project
from intercap_core.studio.board import write_board_recording

from .board_rig import ring

BOARD = "charuco:5x4:0.2:0.15:4X4_50"
RIG = Rig(ring(6, (960, 720)).cameras[:3])  # neighbours see the board at once


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    folder = tmp_path_factory.mktemp("rig")
    write_board_recording(folder / "board", RIG, parse_board(BOARD), sets=30, seed=2, fps=2)
    lenses = {
        camera.name: {
            "image_size": [camera.colour.width, camera.colour.height],
            "camera_matrix": camera.colour.matrix.tolist(),
            "distortion_coefficients": camera.colour.distortion.tolist(),
        }
        for camera in RIG
    }
    (folder / "lenses.json").write_text(json.dumps({"cameras": lenses}))
    (folder / "config.yaml").write_text(
        "dataset: d\nsequences: s.tsv\nsubjects: p.tsv\nobjects: o.yaml\nresults: results\n"
    )
    (folder / "o.yaml").write_text("{}\n")
    (folder / "p.tsv").write_text("subject\tgender\nann\tneutral\n")
    (folder / "s.tsv").write_text(
        "sequence\tsubject\trecordings\tlayout\tcalibration\nb\tann\tboard\tplain\tfound.json\n"
    )
    return load_project(folder / "config.yaml")


def run(project: Project, **changes: object) -> tuple[Path, Path]:
    lenses = project.path.parent / "lenses.json"
    arguments: dict = {"output": None, "lenses": lenses, "board": BOARD, "recordings": [],
                       "distance": None, "master": None, "replace": False}  # fmt: skip
    return calibrate(project, "b", **(arguments | changes))


def test_a_board_gives_poses_that_the_stages_read(project):
    path, page = run(project)
    found = read_calibration(path)
    poses = np.stack([found.extrinsics.master_from_colour[name] for name in RIG.names])
    assert displacement(poses, RIG.master_from_colour, 0).max() < 0.005
    assert "from above" in page.read_text()
    with pytest.raises(UserError, match="exists and is not replaced"):
        run(project)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"board": "charuco:5x4:0.2:0.15:6X6_50"}, "visible to no camera"),
        ({"board": None}, "a person is detected by 0 of 3 cameras"),
        ({"master": "left"}, "expected one of k1, k2, k3"),
        ({"distance": "k1:k2"}, "expected CAMERA:CAMERA:METRES"),
        ({"distance": "k1:left:2"}, "expected one of k1, k2, k3"),
    ],
)
def test_nothing_is_written_for_wrong_input(project, tmp_path, changes, words):
    output = tmp_path / "found.json"
    with pytest.raises(UserError) as caught:
        run(project, output=output, **changes)
    assert words in str(caught.value) and not output.exists()
