"""Start times, slips and time offsets on a studio capture: keypoints of a virtual detector."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.scene.keypoint_timing import find_offsets
from intercap_core.scene.moments import find_moments
from intercap_core.scene.slips import find_slips
from intercap_core.scene.start_times import find_starts
from tests.helpers.synthetic_people import DelayedPeople
from tests.scene.keypoint_capture import KeypointCapture, keypoint_capture, subject_keypoints

MORE = [
    dict(interaction="stool_sit", seed=9301, subject="s02"),
    dict(interaction="toolbox_carry", seed=9412, subject="s01", fps=30, frames=90),
]


@pytest.fixture(
    scope="module",
    params=[
        dict(interaction="suitcase_carry", seed=9302, subject="s03", family="b"),
        *(pytest.param(more, marks=pytest.mark.full) for more in MORE),
    ],
    ids=lambda options: options["interaction"],
)
def capture(request: pytest.FixtureRequest) -> KeypointCapture:
    return keypoint_capture(**request.param)


@pytest.fixture(scope="module")
def keypoints(capture: KeypointCapture) -> np.ndarray:
    return subject_keypoints(capture)


def test_all_slips_and_no_others_are_found(capture, keypoints):
    slips = find_slips(keypoints, capture.rig, capture.times, capture.fps)
    true = [(c, int(capture.slip[:, c].max())) for c in range(6) if capture.slip[:, c].any()]
    assert len(true) == 2
    assert sorted((i.camera, i.slip) for i in slips.intervals) == true
    assert not ((capture.slip == 0) & (slips.slip != 0)).any()


def test_offsets_are_accurate_to_two_milliseconds(capture, keypoints):
    offsets = find_offsets(keypoints, capture.slip, capture.rig, capture.times)
    assert offsets.offset[0] == 0 and np.isfinite(offsets.sigma).all()
    errors = (offsets.offset - capture.offset)[1:]
    assert np.sqrt(np.mean(errors**2)) < 0.002
    assert np.sqrt(np.mean((errors / offsets.sigma[1:]) ** 2)) < 2.0


def test_synchronised_captures_are_left_alone(capture):
    people = DelayedPeople(capture.people, np.zeros(6, int))
    starts = find_starts(people, capture.rig, capture.times, people.available)
    assert not starts.apart and not starts.sets.any()


def test_captures_with_late_starts_are_aligned(capture):
    """Late starts are found beside the studio's own slips and offsets."""
    late = np.random.default_rng(0).uniform(-0.9, 0.9, 5)
    late = np.r_[0, np.round(late * capture.fps).astype(int)]
    people = DelayedPeople(capture.people, late)
    available = people.available
    result = find_moments(people, capture.rig, capture.times, capture.fps, available, master=0)
    place = np.clip(np.arange(len(available))[:, None] - late, 0, len(available) - 1)
    true = np.take_along_axis(capture.slip, place, 0) + late
    known = ~result.starts.in_doubt
    assert known.sum() >= 5
    assert (result.image_of[:, ~known] == -1).all()
    assert (result.slip != true)[available & known].mean() < 0.05
    assert np.abs(result.timing.offset - capture.offset)[known].mean() < 0.002
