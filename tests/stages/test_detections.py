"""Stage ``detections`` from files to the artefact and its reader."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from intercap_core.config import DetectionsSettings
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.geometry.camera import masks
from intercap_core.stages import detections
from tests.helpers.synthetic_capture import ring, write_frames

RIG, _ = ring(2)
WIDTH, HEIGHT = 1920, 1080


def run(folder: Path, output: str = "detections.h5", **paths: Path) -> Path:
    row = SequenceEntry(
        sequence="test", subject="s", object="o", recordings=folder,
        calibration=folder / "rig.json", **paths,
    )  # fmt: skip
    detections.run(
        frames=folder / "frames.h5", output=folder / output, sequence=row,
        settings=DetectionsSettings(),
    )  # fmt: skip
    return folder / output


def people_file(path: Path, x: list[float]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    people = [{"pose_keypoints_2d": [v, 5.0, 0.9] * 25} for v in x]
    path.write_text(json.dumps({"people": people}))


def result(image: int, width: int, label: str) -> dict:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[100:200, 300 : 300 + width] = 1
    segmentation = {"size": [HEIGHT, WIDTH], "counts": masks.encode(mask).decode()}
    return {
        "image_id": image, "category_name": label, "score": 0.5, "segmentation": segmentation
    }  # fmt: skip


def test_files_reach_the_sets_that_hold_their_image(tmp_path):
    index = np.array([[0, 0], [1, 2], [2, -1], [3, 3]])
    dropped = np.array([False, False, False, True])
    write_frames(
        tmp_path / "frames.h5", RIG, num_sets=4, colour_index=index, dropped=dropped,
        colours=[[b"unread"] * 4] * 2,
    )  # fmt: skip
    keypoints, candidates = tmp_path / "keypoints", tmp_path / "candidates"
    people_file(keypoints / "k1" / "000000000000_keypoints.json", [10])
    people_file(keypoints / "k1" / "000000000001_keypoints.json", [11, 12])
    (keypoints / "k1" / "000000000002_keypoints.json").write_text('{"peop')
    people_file(keypoints / "k1" / "000000000003_keypoints.json", [99])
    candidates.mkdir()
    (candidates / "k2.json").write_text(json.dumps([result(2, 7, "person"), result(2, 9, "cup")]))
    output = run(tmp_path, keypoints=keypoints, candidates=candidates)
    read = Detections.load(output)
    assert read.camera_names == ("k1", "k2") and read.num_sets == 4
    np.testing.assert_array_equal(read.keypoints_found[:, 0], [True, True, False, False])
    assert not read.keypoints_found[:, 1].any()
    np.testing.assert_array_equal(read.candidates_found[:, 1], [True, True, False, False])
    np.testing.assert_array_equal(read.people(1, 0)[:, 3, 0], [11, 12])
    assert len(read.people(2, 0)) == len(read.people(3, 0)) == 0
    found = read.candidates(1, 1)
    assert [c.label for c in found] == ["person", "cup"] and [c.index for c in found] == [0, 1]
    assert [c.runs.area for c in found] == [700, 900]
    assert found[1].mask()[150, 305] and found[1].mask().sum() == 900
    assert read.candidates(0, 1) == [] and read.candidates(0, 0) == []
    assert "000000000002_keypoints.json" in read.notes[0]
    assert "no candidates candidates/k1.json" in read.notes[0]
    assert "keypoints/k2" in read.notes[1]
    again = run(tmp_path, "again.h5", keypoints=keypoints, candidates=candidates)
    assert again.read_bytes() == output.read_bytes()


def test_no_detections_at_all_is_an_error(tmp_path):
    write_frames(tmp_path / "frames.h5", RIG, num_sets=2)
    for paths in ({}, {"keypoints": tmp_path / "none", "candidates": tmp_path / "none"}):
        with pytest.raises(UserError, match="sequence test: no detections"):
            run(tmp_path, **paths)
    assert not (tmp_path / "detections.h5").exists()
