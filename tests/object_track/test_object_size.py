"""A mesh of another unit is noticed by what the masks measure."""

from __future__ import annotations

import json

import numpy as np
import pytest

from intercap_core.config import DetectionsSettings, SequenceEntry
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.object_track.object_size import label_doubt, size_doubt
from intercap_core.stages import detections
from tests.helpers.synthetic_capture import ring, write_frames

RIG, _ = ring(2)
AWAY_M, SIDE_PX = 2.0, 120
EXTENT_M = np.sqrt(2) * SIDE_PX * AWAY_M / RIG[0].colour.fx


@pytest.fixture(scope="module")
def evidence(tmp_path_factory):
    """A wall two metres off, and on it squares that are called a cup."""
    folder = tmp_path_factory.mktemp("size")
    shape = (4, RIG[0].depth.height, RIG[0].depth.width)
    wall = np.full(shape, round(AWAY_M * 1000), np.uint16)
    frames = write_frames(folder / "frames.h5", RIG, num_sets=4, depths=[wall, wall])
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


def doubt(evidence, diameter, labels=("cup",)):
    frames, found = evidence
    with Frames.open(frames) as recording:
        return size_doubt(recording, found, RIG, diameter, labels)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_a_mesh_that_fits_is_not_doubted(evidence, factor):
    assert doubt(evidence, factor * EXTENT_M) is None


@pytest.mark.parametrize(("factor", "word"), [(10, "large"), (0.1, "small"), (1000, "large")])
def test_another_unit_is_told_with_both_sizes(evidence, factor, word):
    told = doubt(evidence, factor * EXTENT_M)
    assert f"times too {word}" in told and "labelled cup measures 0.3" in told
    ratio = float(told.split(": ")[1].split(" times")[0])
    assert ratio == pytest.approx(max(factor, 1 / factor), rel=0.15)


def test_without_a_label_nothing_is_said(evidence):
    assert doubt(evidence, 10 * EXTENT_M, ("suitcase",)) is None


def test_labels_of_other_things_are_told_with_their_counts(evidence):
    _, found = evidence
    assert label_doubt(found, ("bowl", "cup")) is None and label_doubt(found, ()) is None
    told = label_doubt(found, ("bowl", "mug"))
    assert "none" not in told and "(bowl, mug), found cup (8);" in told
