"""A project written for a small copy of the InterCap release, loaded and run."""

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
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig
from intercap_core.project import load_project
from intercap_core.stages import frames as frames_stage
from intercap_core.tables.calibration_choice import choose_calibration
from intercap_core.tables.intercap import find_stated_calibration
from tests.helpers.kinect_files import row
from tests.helpers.release_folders import write_intercap
from tests.helpers.synthetic_capture import (
    COLOUR,
    FURNITURE,
    perturbed,
    ring,
    room_depth,
    to_millimetres,
)

ROOT = Path(__file__).resolve().parents[2]
LENS = COLOUR.scaled(0.1)
FIRST = "subject01_motion03_seg1"


def on_colour_grid(rig: Rig, factor: float) -> Rig:
    lens = COLOUR.scaled(factor)
    return Rig(tuple(replace(c, colour=lens, depth=lens, colour_from_depth=np.eye(4)) for c in rig))


def colour(number: int, c: int) -> bytes:
    image = np.full((LENS.height, LENS.width, 3), (10 * c, 7 * number % 255, 90), np.uint8)
    cv2.circle(image, (60 + 20 * c, 50), 20, (255, 255, 255), -1)
    return cv2.imencode(".jpg", image)[1].tobytes()


def flat(number: int, c: int) -> np.ndarray:
    return np.full((LENS.height, LENS.width), 2000 + c, np.uint16)


def write_keypoints(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "0_keypoints.json").write_text('{"people": []}')


@pytest.fixture
def release(tmp_path, monkeypatch) -> Path:
    """Three sequences, of which one annotation folder too many, and one without recordings."""
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "InterCap"
    rig = on_colour_grid(ring(2)[0], 0.1)
    cases = (
        ("01/03/Seg_1", range(12), "calibration_first"),
        ("03/09/Seg_0", [0, 1, 2, 5, 6, 7], "calibration_third"),
        ("09/03/Seg_0", range(3), "calibration_second"),
    )
    for sequence, numbers, calibration in cases:
        write_intercap(
            root, rig, numbers=numbers, colour=colour, depth=flat, sequence=sequence,
            calibration=calibration,
        )  # fmt: skip
        write_keypoints(root / "keypoints" / sequence / "k1")
    annotate(root, "subject01_motion03_seg1", contact="3\n6\n\n10\n400\n\n")
    annotate(root, "subject01_motion03_seg1_v2", contact="2\n5\n")
    annotate(root, "subject03_motion09_seg0", contact="4\n7\n", frame=3)
    annotate(root, "subject05_motion01_seg0", contact="1\n9\n")
    meshes = root / "objs"
    meshes.mkdir()
    for number, name in ((3, "football"), (9, "cup")):
        shutil.copy(ROOT / "config" / "objects" / f"{number:02d}_{name}.ply", meshes / "x.ply")
        (meshes / "x.ply").rename(meshes / f"{number:02d}.ply")
    shutil.copytree(ROOT / "config" / "objects", tmp_path / "config" / "objects")
    shutil.copy(ROOT / "config" / "objects.yaml", tmp_path / "config" / "objects.yaml")
    return root


def annotate(root: Path, name: str, *, contact: str | None, frame: int = 0) -> Path:
    folder = root / "obj_track" / "configs" / name
    folder.mkdir(parents=True, exist_ok=True)
    if contact is not None:
        (folder / "contact.txt").write_text(contact)
    (folder / "config.ini").write_text(
        "\n[init_trans]\ntrans = -0.16 1.07 2.86\n\n[init_rot]\nrot = 1.75 0.28  -0.2\n\n"
        f"[init_frame_id]\nid = {frame}\n"
    )
    return folder


def tables(*arguments: str):
    return CliRunner().invoke(app, ["init", *arguments], catch_exceptions=True)


def write(*arguments: str) -> str:
    given = ("InterCap", "--output", "config/intercap", "--keypoints", "InterCap/keypoints")
    done = tables(*given, *arguments)
    assert done.exit_code == 0, done.exception or done.output
    return done.output


def test_the_project_written_is_ready_to_run(release):
    output = write()
    project = load_project(Path("config/intercap/config.yaml"))
    assert list(project.sequences) == ["s01_o03_seg1", "s03_o09_seg0", "s09_o03_seg0"]
    first = project.sequences["s01_o03_seg1"]
    assert (first.subject, first.object, first.layout) == ("s01", "football", "intercap")
    assert first.recordings == Path("InterCap/RGBD_Images/01/03/Seg_1")
    found = {name: row.calibration.name for name, row in project.sequences.items()}
    assert found == {
        "s01_o03_seg1": "calibration_first",
        "s03_o09_seg0": "calibration_third",
        "s09_o03_seg0": "calibration_second",
    }
    genders = {name: row.gender for name, row in project.subjects.items()}
    assert genders == {"s01": "male", "s03": "female", "s09": "female"}
    assert [str(fault) for fault in check_sequences(project).faults] == []
    assert "1 sequences of" in output and "have no images" in output
    for name, entry in project.sequences.items():
        frames_stage.run(sequence=entry, output=Path(f"{name}.h5"), settings=project.config.frames)


def test_annotations_count_frame_sets(release):
    output = write()
    project = load_project(Path("config/intercap/config.yaml"))
    annotation = project.annotation("s01_o03_seg1")
    # From 1 in the file, from 0 here; the end is cut to the twelve frames that there are.
    assert [(c.part, c.start, c.end) for c in annotation.contact] == [
        ("any", 2, 6), ("any", 9, 12)
    ]  # fmt: skip
    assert annotation.object_pose.frame == 0
    assert annotation.object_pose.rotation_vector == (1.75, 0.28, -0.2)
    assert annotation.object_pose.translation == (-0.16, 1.07, 2.86)
    # Frames 3 and 4 were lost: frame 5 is set 3, and the pose of frame 3 is given there.
    lost = project.annotation("s03_o09_seg0")
    assert [(c.start, c.end) for c in lost.contact] == [(3, 5)]
    assert lost.object_pose.frame == 3
    assert project.sequences["s09_o03_seg0"].annotation is None
    table = Path("config/intercap/sequences.tsv").read_text()
    other = "annotations/alternatives/s01_o03_seg1_1.yaml"
    assert f"# subject01_motion03_seg1_v2 annotates this sequence as well: {other}" in table
    assert (Path("config/intercap") / other).is_file() and other in output


@pytest.mark.parametrize("given", [(), ("--objects", str(ROOT / "config/objects.yaml"))])
def test_poses_are_left_out_without_the_releases_meshes(release, given):
    if not given:
        shutil.rmtree(release / "objs")
    output = write(*given)
    project = load_project(Path("config/intercap/config.yaml"))
    assert project.annotation("s01_o03_seg1").object_pose is None
    assert project.objects["football"].mesh == ROOT / "config/objects/03_football.ply"
    assert "not the release's own" in output


def test_detections_are_found_by_usual_names(release, tmp_path):
    for name in ("s01_o03_seg1", "03/09/Seg_0", "subject09_motion03_seg00"):
        write_keypoints(tmp_path / "kp" / name / "k1")
    write("--keypoints", "kp")
    project = load_project(Path("config/intercap/config.yaml"))
    found = [row.keypoints for row in project.sequences.values()]
    assert found == [
        Path("kp/s01_o03_seg1"), Path("kp/03/09/Seg_0"), Path("kp/subject09_motion03_seg00")
    ]  # fmt: skip


def test_the_releases_results_are_named_on_request(release, tmp_path):
    (tmp_path / "Res" / "03" / "09" / "Seg_0").mkdir(parents=True)
    write("--results", "Res")
    project = load_project(Path("config/intercap/config.yaml"))
    named = {name: row.results for name, row in project.sequences.items() if row.results}
    assert named == {"s03_o09_seg0": Path("Res/03/09/Seg_0")}


def test_existing_files_are_kept_without_replace(release):
    write()
    table = Path("config/intercap/sequences.tsv")
    table.write_text("mine")
    again = tables("InterCap", "--output", "config/intercap")
    assert isinstance(again.exception, UserError)
    assert "config.yaml: exists already" in str(again.exception)
    assert "--replace" in str(again.exception) and table.read_text() == "mine"
    write("--replace")
    assert table.read_text() != "mine"


def pose_in_millimetres(release):
    folder = annotate(release, FIRST, contact=None)
    text = (folder / "config.ini").read_text()
    (folder / "config.ini").write_text(text.replace("2.86", "2860"))


def broken_pose(release):
    folder = annotate(release, FIRST, contact=None)
    (folder / "config.ini").write_text("[init_trans]\ntrans = 1 2\n")


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"contact": "3\nsix\n"}, "contact.txt is not a list of frame numbers"),
        ({"contact": "3\n6\n9\n"}, "the last start has no end"),
        ({"contact": "9\n2\n"}, "9 to 2 is no interval"),
        ({"contact": "90\n99\n"}, "no image from 90 to 99"),
        ({"contact": None, "frame": 50}, "pose in frame 50, which has no image"),
        (broken_pose, "config.ini has no"),
        (pose_in_millimetres, "millimetres"),
    ],
)
def test_broken_annotations_are_left_out_with_a_remark(release, fault, words):
    fault(release) if callable(fault) else annotate(release, FIRST, **fault)
    assert words in write()
    assert words in Path("config/intercap/sequences.tsv").read_text()
    load_project(Path("config/intercap/config.yaml")).annotation("s01_o03_seg1")


@pytest.mark.parametrize(
    ("missing", "words"),
    [
        ("RGBD_Images", "no recordings that are recognised"),
        ("Data", "--calibrations"),
        ("Data/calibration_third", "s03_o09_seg0 needs calibration_third"),
        ("objs/09.ply", "no such mesh of object 'cup'"),
    ],
)
def test_an_incomplete_release_is_refused(release, missing, words):
    path = release / missing
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    done = tables("InterCap", "--output", "config/intercap")
    assert isinstance(done.exception, UserError) and words in str(done.exception)
    assert not Path("config/intercap").exists()


def test_odd_names_of_folders_are_ignored_or_refused(release):
    for name in ("..", "01/..", "Seg_1; rm", "Seg_\t3"):
        (release / "RGBD_Images" / "01" / "03" / name.replace("/", "_")).mkdir(exist_ok=True)
    (release / "RGBD_Images" / "0x1" / "03" / "Seg_1").mkdir(parents=True)
    write()
    assert len(load_project(Path("config/intercap/config.yaml")).sequences) == 3
    # What a table cannot hold is refused.
    shutil.move(release, release.with_name("Inter\tCap"))
    done = tables("Inter\tCap", "--output", "config/other")
    assert isinstance(done.exception, UserError) and "tab" in str(done.exception)


def test_calibrations_that_the_release_states():
    unstated = {
        (s, o) for s in range(1, 11) for o in range(1, 11) if not find_stated_calibration(s, o)
    }
    assert unstated == {(4, 5), (4, 6), (4, 7)}
    assert find_stated_calibration(4, 4) == find_stated_calibration(3, 7) == "first"
    assert find_stated_calibration(10, 1) == find_stated_calibration(4, 8) == "second"
    assert find_stated_calibration(3, 8) == find_stated_calibration(7, 7) == "third"


def rooms(tmp_path: Path, moved: tuple[float, float]) -> tuple[SequenceEntry, dict[str, Path]]:
    """A recording of ``calibration_third``; that of the first has cameras moved (m, degrees)."""
    true, zup_from_master = ring(4)
    true = on_colour_grid(true, 0.15)
    rng = np.random.default_rng(0)
    depths = [to_millimetres(room_depth(c, zup_from_master, FURNITURE), rng) for c in true]

    def picture(number: int, c: int) -> bytes:
        return cv2.imencode(".jpg", np.zeros((*depths[c].shape, 3), np.uint8))[1].tobytes()

    def seen(number: int, c: int) -> np.ndarray:
        image = depths[c].copy()
        image[:, 20 * number : 20 * number + 30] = 900  # somebody walks by
        return image

    other = perturbed(Rig(true.cameras[:3]), rng, *moved)
    other = Rig((*true.cameras[:2], other[2], true[3]))
    given = dict(numbers=range(5), colour=picture, depth=seen, sequence="04/05/Seg_0")
    folders = {}
    for name, rig in (("first", other), ("second", other), ("third", true)):
        recordings, folders[name] = write_intercap(
            tmp_path / "InterCap", rig, calibration=f"calibration_{name}", **given
        )
    return row(recordings, folders["first"], layout="intercap"), folders


def test_depth_images_decide_an_unstated_calibration(tmp_path, monkeypatch):
    sequence, folders = rooms(tmp_path, (0.03, 1.0))
    best, residual_m = choose_calibration(sequence, folders)
    assert best == "third" and residual_m["third"] < 0.7 * residual_m["first"]
    monkeypatch.chdir(tmp_path)
    write_keypoints(tmp_path / "kp" / "04/05/Seg_0" / "k1")
    objects = str(ROOT / "config/objects.yaml")
    done = tables("InterCap", "--output", "out", "--objects", objects, "--keypoints", "kp")
    assert done.exit_code == 0
    table = Path("out/sequences.tsv").read_text()
    assert "# the release does not state this calibration; third is the best" in table
    assert "calibration_third" in table


def test_equal_calibrations_are_not_decided(tmp_path):
    sequence, folders = rooms(tmp_path, (0.0, 0.0))
    assert choose_calibration(sequence, folders)[0] is None
    (folders["second"] / "Color.json").write_text(json.dumps({}))
    assert choose_calibration(sequence, folders)[0] is None
