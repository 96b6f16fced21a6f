"""Warnings about a mesh of the wrong size, symmetry or object, and about unknown labels."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from intercap_core.config import DetectionsSettings
from intercap_core.entries import SequenceEntry
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.object_track.mesh_check import label_doubt, mesh_doubts, scale_mesh, size_doubt
from intercap_core.object_track.whole import FrameResult
from intercap_core.stages import detections
from tests.helpers.synthetic_capture import ring, write_frames
from tests.object_track.scenes import observer_of

RIG, _ = ring(2)
AWAY_M, SIDE_PX = 2.0, 120
EXTENT_M = np.sqrt(2) * SIDE_PX * AWAY_M / RIG[0].colour.fx


def doubts_of(capture, images, mesh: ObjectMesh) -> list[str]:
    """Warnings about a track of ``mesh`` at the true poses."""
    observer = observer_of(capture, images, mesh=mesh)
    fits = [observer.fit(t, capture.poses[t], None) for t in range(3)]
    return mesh_doubts(observer, [FrameResult(fit) for fit in fits])


def test_the_right_mesh_gives_no_warning(capture, images, suitcase):
    assert doubts_of(capture, images, suitcase) == []


@pytest.mark.parametrize(("scale", "word"), [(1.1, "10% smaller"), (0.9, "10% larger")])
def test_a_tenth_of_the_size_gives_a_warning(capture, images, suitcase, scale, word):
    doubts = doubts_of(capture, images, scale_mesh(suitcase, scale))
    assert any(word in doubt for doubt in doubts), doubts


def test_a_wrong_symmetry_gives_a_warning(capture, images, suitcase):
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, -1], [1, 0]]
    turns = np.array([np.linalg.matrix_power(quarter, n) for n in range(4)])
    wrong = replace(suitcase, symmetry=SymmetryGroup(turns))
    assert any("symmetry" in doubt for doubt in doubts_of(capture, images, wrong))


@pytest.fixture(scope="module")
def squares(tmp_path_factory):
    """A wall two metres away, with squares on it that are labelled as a cup."""
    folder = tmp_path_factory.mktemp("size")
    shape = (4, RIG[0].depth.height, RIG[0].depth.width)
    wall = np.full(shape, round(AWAY_M * 1000), np.uint16)
    images = [[b"not read"] * 4] * 2
    frames = write_frames(
        folder / "frames.h5", RIG, num_sets=4, depths=[wall, wall], colours=images
    )
    x, y = 900, 500
    corners = [x, y, x + SIDE_PX, y, x + SIDE_PX, y + SIDE_PX, x, y + SIDE_PX]
    square = {"category_name": "cup", "score": 1.0, "segmentation": [corners]}
    for name in RIG.names:
        (folder / f"{name}.json").write_text(
            json.dumps([square | {"image_id": t} for t in range(4)])
        )
    detections.run(
        frames=frames,
        output=folder / "detections.h5",
        sequence=SequenceEntry(
            sequence="test", subject="s", object="o", recordings=folder,
            calibration=folder / "rig.json", candidates=folder,
        ),
        settings=DetectionsSettings(),
    )  # fmt: skip
    return frames, Detections.load(folder / "detections.h5")


def size_doubt_of(squares, diameter, labels=("cup",)):
    frames, detected = squares
    with Frames.open(frames) as recording:
        return size_doubt(recording, detected, diameter, labels)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_fitting_size_gives_no_warning(squares, factor):
    assert size_doubt_of(squares, factor * EXTENT_M) is None
    assert size_doubt_of(squares, 10 * factor * EXTENT_M, ("suitcase",)) is None


@pytest.mark.parametrize(("factor", "word"), [(10, "large"), (0.1, "small"), (1000, "large")])
def test_another_unit_gives_a_warning_with_both_sizes(squares, factor, word):
    text = size_doubt_of(squares, factor * EXTENT_M)
    assert f"times too {word}" in text and "labelled cup measure 0.3" in text
    ratio = float(text.split(": ")[1].split(" times")[0])
    assert ratio == pytest.approx(max(factor, 1 / factor), rel=0.15)


def test_unknown_labels_give_a_warning_with_counts(squares):
    _, detected = squares
    assert label_doubt(detected, ("bowl", "cup")) is None and label_doubt(detected, ()) is None
    assert "(bowl, mug), found cup (8);" in label_doubt(detected, ("bowl", "mug"))
