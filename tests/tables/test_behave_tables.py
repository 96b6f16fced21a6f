"""A project written for a small copy of BEHAVE, loaded, checked and read."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from intercap_core.cli import app
from intercap_core.commands.check import check_sequences
from intercap_core.errors import UserError
from intercap_core.formats.released import PERSON_MESH
from intercap_core.geometry.camera.rig import Rig
from intercap_core.project import load_project
from intercap_core.stages import frames as frames_stage
from tests.helpers.release_folders import write_behave
from tests.helpers.synthetic_capture import COLOUR, ring

ROOT = Path(__file__).resolve().parents[2]
LENS = COLOUR.scaled(0.1)
SEQUENCES = (
    "Date01_Sub01_stool_move",
    "Date01_Sub02_suitcase",
    "Date03_Sub01_stool_sit",
    "Date04_Sub01_plasticcontainer",
)


def colour(t: int, c: int) -> bytes:
    image = np.full((LENS.height, LENS.width, 3), (20 * c, 30 * t, 90), np.uint8)
    cv2.circle(image, (60 + 20 * c, 40 + 5 * t), 20, (255, 255, 255), -1)
    return cv2.imencode(".jpg", image)[1].tobytes()


def flat(t: int, c: int) -> np.ndarray:
    return np.full((LENS.height, LENS.width), 2000 + c, np.uint16)


@pytest.fixture
def release(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "BEHAVE"
    cameras = ring(4)[0]
    rig = Rig(
        tuple(replace(c, colour=LENS, depth=LENS, colour_from_depth=np.eye(4)) for c in cameras)
    )
    for sequence in SEQUENCES:
        write_behave(
            root, rig, times=("0001.000", "0002.000"), colour=colour, depth=flat, sequence=sequence
        )
        (root / "sequences" / sequence / "t0001.000" / "k1.color.json").write_text("{}")
    for number, name in ((10, "stool"), (1, "suitcase")):
        folder = root / "objects" / name
        folder.mkdir(parents=True)
        shutil.copy(
            ROOT / "config" / "objects" / f"{number:02d}_{name}.ply", folder / f"{name}_f1000.ply"
        )
        (folder / f"{name}.obj").write_text("")
    return root


def set_gender(root: Path, sequence: str, gender: object) -> None:
    path = root / "sequences" / sequence / "info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "gender": gender}))


def write(*arguments: str):
    return CliRunner().invoke(app, ["init", "BEHAVE", "--output", "config/behave", *arguments])


def test_the_project_written_is_ready_to_run(release):
    set_gender(release, "Date01_Sub02_suitcase", "female")
    set_gender(release, "Date03_Sub01_stool_sit", "../../etc")
    done = write()
    assert done.exit_code == 0, done.exception
    assert "Date04_Sub01_plasticcontainer is left out: objects/plasticcontainer" in done.output
    assert "Date03_Sub01_stool_sit: info.json states no gender: Sub01 is male" in done.output
    project = load_project(Path("config/behave/config.yaml"))
    assert list(project.sequences) == list(SEQUENCES[:3])
    row = project.sequences["Date03_Sub01_stool_sit"]
    assert (row.subject, row.object, row.layout) == ("Sub01", "stool", "behave")
    assert row.calibration == Path("BEHAVE/calibs/Date03/config")
    genders = {name: subject.gender for name, subject in project.subjects.items()}
    assert genders == {"Sub01": "male", "Sub02": "female"}
    assert project.objects["stool"].mesh.name == "stool_f1000.ply"
    assert project.objects["stool"].labels == ("stool",)
    assert [str(fault) for fault in check_sequences(project).faults] == []
    for name, entry in project.sequences.items():
        frames_stage.run(sequence=entry, output=Path(f"{name}.h5"), settings=project.config.frames)


def test_the_data_sets_results_are_named_on_request(release):
    folder = release / "sequences" / SEQUENCES[0]
    registered = folder / "t0002.000" / PERSON_MESH
    registered.parent.mkdir(parents=True)
    registered.touch()
    done = write("--results", "BEHAVE")
    assert f"{SEQUENCES[1]}: BEHAVE holds no {SEQUENCES[1]}/t*/person" in done.output
    project = load_project(Path("config/behave/config.yaml"))
    named = {name: row.results for name, row in project.sequences.items() if row.results}
    assert named == {SEQUENCES[0]: Path("BEHAVE/sequences") / SEQUENCES[0]}
    shutil.move(folder, release.parent / SEQUENCES[0])
    # elsewhere, as the parameters at 30 fps with meshes beside them would be
    shutil.copytree(release / "sequences" / SEQUENCES[2], folder)
    assert write("--results", ".", "--replace").exit_code == 0
    project = load_project(Path("config/behave/config.yaml"))
    assert project.sequences[SEQUENCES[0]].results == Path(SEQUENCES[0])
    assert [str(fault) for fault in check_sequences(project).faults] == []
    done = write("--results", "nowhere", "--replace")
    assert isinstance(done.exception, UserError) and "no such folder" in str(done.exception)


def test_incomplete_sequences_are_left_out_with_a_remark(release):
    shutil.rmtree(release / "calibs" / "Date01")
    for path in (release / "sequences" / "Date03_Sub01_stool_sit").glob("t*"):
        shutil.rmtree(path)
    done = write()
    assert isinstance(done.exception, UserError)
    assert "there is no calibs/Date01/config" in str(done.exception)


def test_options_of_other_layouts_are_refused(release):
    done = write("--meshes", "BEHAVE/objects")
    assert isinstance(done.exception, UserError) and "--meshes" in str(done.exception)
    done = CliRunner().invoke(app, ["init", "nowhere", "--output", "x"])
    assert "no such folder" in str(done.exception)
    done = write("--dataset", "../x")
    assert "--dataset is '../x'" in str(done.exception)
