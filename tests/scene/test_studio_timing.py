"""Start times, slips and time offsets on studio captures: keypoints of a virtual detector."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.scene.keypoint_timing import find_offsets
from intercap_core.scene.moments import find_moments
from intercap_core.scene.slips import find_slips
from intercap_core.scene.start_times import find_starts
from tests.helpers.synthetic_people import DelayedPeople
from tests.scene.keypoint_capture import KeypointCapture, keypoint_capture, subject_keypoints


@pytest.fixture(scope="module")
def captures() -> list[KeypointCapture]:
    return [
        keypoint_capture("stool_sit", seed=9301, subject="s02"),
        keypoint_capture("suitcase_carry", seed=9302, subject="s03", family="b"),
    ]


@pytest.fixture(scope="module")
def keypoints(captures) -> list[np.ndarray]:
    return [subject_keypoints(capture) for capture in captures]


def test_all_slips_and_no_others_are_found(captures, keypoints):
    for capture, points in zip(captures, keypoints, strict=True):
        slips = find_slips(points, capture.rig, capture.times, capture.fps)
        true = [(c, int(capture.slip[:, c].max())) for c in range(6) if capture.slip[:, c].any()]
        assert len(true) == 2
        assert sorted((i.camera, i.slip) for i in slips.intervals) == true
        assert not ((capture.slip == 0) & (slips.slip != 0)).any()


def test_offsets_are_accurate_to_two_milliseconds(captures, keypoints):
    errors, normalised = [], []
    for capture, points in zip(captures, keypoints, strict=True):
        offsets = find_offsets(points, capture.slip, capture.rig, capture.times)
        assert offsets.offset[0] == 0 and np.isfinite(offsets.sigma).all()
        errors.append((offsets.offset - capture.offset)[1:])
        normalised.append(errors[-1] / offsets.sigma[1:])
    assert np.sqrt(np.mean(np.square(errors))) < 0.002
    assert np.sqrt(np.mean(np.square(normalised))) < 2.0


def test_synchronised_captures_are_left_alone(captures):
    for capture in captures:
        people = DelayedPeople(capture.people, np.zeros(6, int))
        starts = find_starts(people, capture.rig, capture.times, people.available)
        assert not starts.apart and not starts.sets.any()


def assert_aligned(captures: list[KeypointCapture]) -> None:
    """Late starts are found beside the studio's own slips and offsets."""
    wrong, errors = [], []
    for n, capture in enumerate(captures):
        rng = np.random.default_rng(n)
        late = np.r_[0, np.round(rng.uniform(-0.9, 0.9, 5) * capture.fps).astype(int)]
        people = DelayedPeople(capture.people, late)
        available = people.available
        result = find_moments(people, capture.rig, capture.times, capture.fps, available, master=0)
        place = np.clip(np.arange(len(available))[:, None] - late, 0, len(available) - 1)
        true = np.take_along_axis(capture.slip, place, 0) + late
        known = ~result.starts.in_doubt
        assert known.sum() >= 5
        assert (result.image_of[:, ~known] == -1).all()
        wrong.append((result.slip != true)[available & known].mean())
        errors.append((result.timing.offset - capture.offset)[known])
    assert np.mean(wrong) < 0.05
    assert np.abs(np.concatenate(errors)).mean() < 0.002


def test_captures_with_late_starts_are_aligned(captures):
    assert_aligned(captures)


@pytest.mark.full
def test_other_subjects_and_rates_are_aligned():
    assert_aligned(
        [
            keypoint_capture("suitcase_carry", seed=9411, subject="s06"),
            keypoint_capture("toolbox_carry", seed=9412, subject="s01", fps=30, frames=90),
            keypoint_capture("football_kick", seed=9413, subject="s09", family="b"),
        ]
    )
