"""A project written for a folder of own recordings, which `check` then finds ready to run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from intercap_core.cli import app
from intercap_core.errors import UserError
from intercap_core.formats.detections.candidate_files import holds_instances
from intercap_core.formats.detections.coco import HEAD_BYTES
from intercap_core.formats.detections.keypoint_files import holds_people
from intercap_core.formats.detections.mask_files import is_mask
from intercap_core.project import Project, load_project
from tests.helpers.plain_capture import CAMERAS, write_rig

ROOT = Path(__file__).resolve().parents[2]
SIZE = (64, 48)
PERSON = {"people": [{"pose_keypoints_2d": [10.0, 20.0, 0.9] * 25}]}
INSTANCE = {"image_id": 0, "category_id": 47, "score": 0.9, "bbox": [1, 1, 9, 9],
            "segmentation": [[1, 1, 9, 1, 9, 9, 1, 9]]}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two sequences with a common calibration; keypoints in one's folder and in a common one."""
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "captures"
    for name in ("s02_cup_drink", "walk"):
        shots = root / name
        shots.mkdir(parents=True)
        images = write_rig(shots, SIZE, 60.0)
        for camera, path in images.items():
            for number in range(3):
                picture = np.random.default_rng(number).integers(0, 255, (*SIZE[::-1], 3))
                cv2.imwrite(str(path / f"{number:03d}.jpg"), picture)
            shutil.move(path, shots / camera)
        (shots / "recordings").rmdir()
    (root / "s02_cup_drink" / "rig.json").unlink()
    (root / "walk" / "rig.json").rename(root / "rig.json")
    for camera in CAMERAS:
        for place in ("s02_cup_drink/openpose", "keypoints/walk"):
            people = root / place / camera
            people.mkdir(parents=True)
            for number in range(3):
                (people / f"{number:03d}_keypoints.json").write_text(json.dumps(PERSON))
        results = root / "candidates" / "s02_cup_drink"
        results.mkdir(parents=True, exist_ok=True)
        (results / f"{camera}.json").write_text(json.dumps([INSTANCE]))
    (root / "meshes").mkdir()
    for number, name in ((1, "suitcase"), (9, "cup")):
        mesh = f"{number:02d}_{name}.ply"
        shutil.copy(ROOT / "config" / "objects" / mesh, root / "meshes" / mesh)
    return root


def init(*arguments: str) -> tuple[str, Project]:
    done = CliRunner().invoke(app, ["init", "captures", "--output", "lab", *arguments])
    assert done.exit_code == 0, done.exception or done.output
    return done.output, load_project(Path("lab/config.yaml"))


def test_what_can_be_seen_is_written(folder: Path) -> None:
    output, project = init()
    assert list(project.sequences) == ["s02_cup_drink", "walk"]
    row, alone = project.sequences.values()
    assert (row.layout, row.subject, row.object) == ("plain", "s02", "cup")
    assert row.calibration == alone.calibration == Path("captures/rig.json")
    assert row.keypoints == Path("captures/s02_cup_drink/openpose")
    assert row.candidates == Path("captures/candidates/s02_cup_drink")
    assert alone.keypoints == Path("captures/keypoints/walk")
    assert (alone.object, alone.candidates) == (None, None)
    assert set(project.objects) == {"cup", "suitcase"}
    assert "2 of 2 sequences are ready to run" in output


def test_large_files_of_a_data_set_are_recognised(tmp_path: Path) -> None:
    images = [{"id": number, "file_name": f"{number:0100d}.jpg"} for number in range(2000)]
    person = INSTANCE | {"keypoints": [10.0, 20.0, 0.9] * 17}
    content = json.dumps({"images": images, "annotations": [person]})
    assert len(content) > HEAD_BYTES
    (tmp_path / "left.json").write_text(content)
    assert holds_instances(tmp_path, "left", "plain") and holds_people(tmp_path, "left")


def test_what_cannot_be_seen_is_marked_and_has_a_default(folder: Path) -> None:
    output, project = init()
    assert {row.gender for row in project.subjects.values()} == {"neutral"}
    assert "FILL IN: gender" in Path("lab/subjects.tsv").read_text()
    table = Path("lab/sequences.tsv").read_text().splitlines()
    assert "FILL IN: the name of the sequence contains no object" in table[-2]
    assert "the names of 1 of 2 sequences (first: walk) state no subject" in output
    assert output.count("FILL IN") == 3


def write_masks(folder: Path) -> None:
    for camera in CAMERAS:
        (folder / camera).mkdir(parents=True)
        for number in range(3):
            mask = cv2.circle(np.zeros(SIZE[::-1], np.uint8), (30, 20), 9 + number, 255, -1)
            cv2.imwrite(str(folder / camera / f"{number:03d}.png"), mask)


@pytest.mark.parametrize("masks", ["{sequence}/segmentation", "segmented/{sequence}"])
def test_detections_beside_folders_of_recordings(folder: Path, masks: str) -> None:
    """Sequences are named without the folder that all of them have; masks are no sequence."""
    (folder / "s02_cup_drink").rename(folder / "ann_cup")
    shutil.rmtree(folder / "candidates")
    for name in ("ann_cup", "walk"):
        (folder / name / "recordings").mkdir()
        for camera in CAMERAS:
            (folder / name / camera).rename(folder / name / "recordings" / camera)
        write_masks(folder / masks.format(sequence=name))
    output, project = init("--keypoints", str(folder / "keypoints"))
    assert list(project.sequences) == ["ann_cup", "walk"]
    ann, walk = project.sequences.values()
    assert (ann.object, ann.keypoints) == ("cup", Path("captures/ann_cup/openpose"))
    assert walk.keypoints == Path("captures/keypoints/walk")
    for name, row in project.sequences.items():
        assert row.candidates == Path("captures", masks.format(sequence=name))
    assert "the names of 2 of 2 sequences (first: ann_cup) state no subject" in output
    assert "2 of 2 sequences are ready to run" in output
    write_masks(folder / "tried" / "walk")
    assert "captures/tried/walk: holds masks, which no sequence uses" in init("--replace")[0]


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (np.repeat([[0, 255]], 40, 0).repeat(20, 1), True),
        (np.repeat([[0, 1, 2, 3]], 40, 0).repeat([25, 10, 5, 3], 1), True),
        (np.tile(np.arange(60), (40, 1)), False),  # a grey photograph
        (np.maximum(np.random.default_rng(0).normal(0, 900, (480, 640)), 0), False),  # depth
    ],
)
def test_masks_have_large_areas_of_few_values(
    tmp_path: Path, image: np.ndarray, expected: bool
) -> None:
    depth = image.max() > 255
    cv2.imwrite(str(tmp_path / "0.png"), image.astype(np.uint16 if depth else np.uint8))
    assert is_mask(tmp_path / "0.png") == expected


def test_meshes_and_recordings_of_one_name_get_different_names(folder: Path) -> None:
    (folder / "scans").mkdir()
    for name in ("cup", "person"):
        shutil.copy(folder / "meshes" / "09_cup.ply", folder / "scans" / f"{name}.ply")
    shutil.copytree(folder / "walk", folder / "s02 cup drink")
    (folder / "walk").rename(folder / "recordings")
    shutil.rmtree(folder / "keypoints")
    done = CliRunner().invoke(app, ["init", "captures", "--output", "lab"])
    project = load_project(Path("lab/config.yaml"))
    places = {name: entry.mesh.parent.name for name, entry in project.objects.items()}
    assert places == {
        "cup": "meshes", "suitcase": "meshes", "scans_cup": "scans", "scans_person": "scans"
    }  # fmt: skip
    folders = {name: row.recordings.name for name, row in project.sequences.items()}
    assert folders == {
        "recordings_2": "recordings",
        "s02_cup_drink": "s02 cup drink",
        "s02_cup_drink_2": "s02_cup_drink",
    }
    assert "scans/cup.ply is object scans_cup, because cup is the name of" in done.output
    assert "person is the name of people in detections" in done.output
    assert "recordings_2: recordings is the name of another sequence or of a folder" in done.output
    Path("lab/objects.yaml").write_text("person: {mesh: ../captures/scans/person.ply}\n")
    with pytest.raises(UserError, match=r"'person'.*reserved for people in detections"):
        load_project(Path("lab/config.yaml"))


def test_an_object_that_nothing_shows_is_noted(folder: Path) -> None:
    assert "will probably not be found" not in init()[0]
    shutil.rmtree(folder / "candidates")
    output, _ = init("--replace")
    assert (
        "no camera has depth and there are no segmentation masks (candidates) of object 'cup'"
        in output
    )


def test_a_missing_calibration_is_marked(folder: Path) -> None:
    (folder / "rig.json").unlink()
    done = CliRunner().invoke(app, ["init", "captures", "--output", "lab"])
    assert done.exit_code == 1 and done.exception is not None
    assert done.output.count("FILL IN: no calibration of left, right is found") == 2
    assert "0 of 2 sequences are ready to run" in done.output


def test_the_project_can_lie_in_the_folder_of_the_recordings(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(app, ["init", "."])
    assert done.exit_code == 0, done.output
    assert load_project(Path("config.yaml")).results == Path("results/captures")
    again = CliRunner().invoke(app, ["init", "."])
    assert "exists already" in str(again.exception) and "--replace" in str(again.exception)
