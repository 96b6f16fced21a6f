"""Images and detections read by the moment that they show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.synchronise import images_of_moments
from tests.helpers.synthetic_capture import ring, write_frames
from tests.helpers.synthetic_people import stick_person, write_detections

SETS, LATE = 5, 2


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> dict[str, Path]:
    """Frames and detections of three cameras; each set has another depth, person and mask."""
    folder = tmp_path_factory.mktemp("moments")
    rig = ring(3)[0]
    paths = {stage: folder / f"{stage}.h5" for stage in ("frames", "detections")}
    lens = rig[0].depth
    depths = [np.full((lens.height, lens.width), 1000 + t, np.uint16) for t in range(SETS)]
    jpegs = [b"image %d" % t for t in range(SETS)]
    write_frames(
        paths["frames"], rig, num_sets=SETS, depths=[np.stack(depths)] * 3, colours=[jpegs] * 3
    )
    people = [[[stick_person() + t]] * 3 for t in range(SETS)]
    cups = {(t, c): [("cup", b"mask %d" % t)] for t in range(SETS) for c in range(3)}
    write_detections(paths["detections"], rig, people, cups)
    return paths


@pytest.fixture(scope="module")
def image_of() -> np.ndarray:
    """The second camera's images are two sets old from set 3 on."""
    slip = np.zeros((SETS, 3), np.int32)
    slip[3:, 1] = LATE
    return images_of_moments(slip, np.ones((SETS, 3), bool))


def test_a_slipped_image_is_read_at_the_moment_it_shows(capture, image_of):
    assert image_of[:, 1].tolist() == [0, 1, 2, -1, -1]
    with Frames.open(capture["frames"]) as images:
        shown = images.showing(np.roll(image_of, 1, axis=0))
        assert shown.depth_available[:, 1].tolist() == [False, True, True, True, False]
        assert shown.depth(4, 1) is None and shown.colour(0, 1) is None
        assert np.array_equal(shown.depth(2, 1), images.depth(1, 1))
        assert np.array_equal(shown.depth(2, 0), images.depth(1, 0))
        assert np.array_equal(shown.time_s, images.time_s)


def test_detections_go_with_their_image(capture, image_of):
    found = Detections.load(capture["detections"])
    shown = found.showing(np.roll(image_of, 1, axis=0))
    assert len(shown.people(4, 1)) == 0 and shown.candidates(0, 1) == []
    assert not shown.candidates_found[0, 1]
    assert np.array_equal(shown.people(2, 1), found.people(1, 1))
    assert [c.rle for c in shown.candidates(3, 1)] == [c.rle for c in found.candidates(2, 1)]
    assert len(found.candidates(3, 1)) > 0


def test_moments_of_another_recording_are_refused(capture):
    with (
        Frames.open(capture["frames"]) as images,
        pytest.raises(UserError, match="re-run stage 'scene'"),
    ):
        images.showing(np.zeros((SETS + 1, 3), np.int32))
    with pytest.raises(UserError, match="the scene artefact 5 of 2"):
        Detections.load(capture["detections"]).showing(np.zeros((SETS, 2), np.int32))
