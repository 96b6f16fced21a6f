"""Images and detections read by the moment that they show."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.synchronise import images_of_moments
from tests.helpers.fitted_capture import Capture, make_capture

SETS, LATE = 5, 2


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Capture:
    return make_capture(tmp_path_factory.mktemp("moments"), total=SETS)


@pytest.fixture(scope="module")
def image_of() -> np.ndarray:
    """The second camera's images are two sets old from set 3 on."""
    slip = np.zeros((SETS, 3), np.int32)
    slip[3:, 1] = LATE
    return images_of_moments(slip, np.ones((SETS, 3), bool))


def test_a_slipped_image_is_read_at_the_moment_it_shows(capture, image_of):
    assert image_of[:, 1].tolist() == [0, 1, 2, -1, -1]
    with Frames.open(capture.paths["frames"]) as images:
        shown = images.showing(np.roll(image_of, 1, axis=0))
        assert shown.depth_available[:, 1].tolist() == [False, True, True, True, False]
        assert shown.depth(4, 1) is None and shown.colour(0, 1) is None
        assert np.array_equal(shown.depth(2, 1), images.depth(1, 1))
        assert np.array_equal(shown.depth(2, 0), images.depth(1, 0))
        assert np.array_equal(shown.time_s, images.time_s)


def test_detections_go_with_their_image(capture, image_of):
    found = Detections.load(capture.paths["detections"])
    shown = found.showing(np.roll(image_of, 1, axis=0))
    assert len(shown.people(4, 1)) == 0 and shown.candidates(0, 1) == []
    assert not shown.candidates_found[0, 1]
    assert np.array_equal(shown.people(2, 1), found.people(1, 1))
    assert [c.rle for c in shown.candidates(3, 1)] == [c.rle for c in found.candidates(2, 1)]
    assert len(found.candidates(3, 1)) > 0


def test_moments_of_another_recording_are_refused(capture):
    with (
        Frames.open(capture.paths["frames"]) as images,
        pytest.raises(UserError, match="re-run stage 'scene'"),
    ):
        images.showing(np.zeros((SETS + 1, 3), np.int32))
    with pytest.raises(UserError, match="the scene artefact 5 of 2"):
        Detections.load(capture.paths["detections"]).showing(np.zeros((SETS, 2), np.int32))
