"""Left and right that a person states to be exchanged."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.annotation import ExchangedSides
from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.config import PersonSettings
from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import Triangulation
from intercap_core.person.sides import (
    LEGS,
    exchange_points,
    hold_sides,
    images_with_stated_sides,
    swap_sides,
)
from intercap_core.schemas import PERSON
from intercap_core.stages import person
from tests.helpers.synthetic_capture import ring, write_frames, write_scene
from tests.helpers.synthetic_people import seen_by, walking, write_detections

RIG, UP = ring()
T = 8
BODY = walking(T, np.array([-0.2, 0.1]), np.array([0.01, 0]))
TRUE = apply(invert(UP), BODY.reshape(-1, 3)).reshape(T, 135, 3)
NAMES = ("k1", "k2", "k3")
NO_DEPTH = np.zeros((RIG[0].depth.height, RIG[0].depth.width), np.uint16)


def joints(tmp_path, keypoints, *stated: ExchangedSides) -> np.ndarray:
    """The stage's points (T, 135, 3) of one person detected at keypoints (T, C, 135, 3)."""
    people = [[[own] for own in of_set] for of_set in keypoints]
    person.run(
        frames=write_frames(tmp_path / "frames.h5", RIG, num_sets=T),
        detections=write_detections(tmp_path / "detections.h5", RIG, people),
        scene=write_scene(tmp_path / "scene.h5", RIG, np.arange(T) / 15, [NO_DEPTH] * len(RIG)),
        output=tmp_path / "person.h5",
        settings=PersonSettings(segmentation="detector"),
        left_right=stated,
    )
    with artefacts.read(tmp_path / "person.h5", PERSON) as found:
        return found["joints"]


def test_images_are_those_of_the_stated_frames_and_cameras():
    image_of = np.array([[0, 0, -1], [1, 0, 1], [2, 1, 2], [3, 2, 3]])  # k2 slips by one
    stated = [ExchangedSides(start=1, end=3, camera="k2"), ExchangedSides(start=3, end=4)]
    found = images_with_stated_sides(stated, NAMES, image_of, "one")
    assert found.astype(int).tolist() == [[0, 0, 0], [0, 0, 0], [0, 1, 0], [1, 1, 1]]
    assert not images_with_stated_sides([], NAMES, image_of, "one").any()
    unknown = [ExchangedSides(start=0, end=1, camera="k9")]
    with pytest.raises(UserError, match=r"left_right\[0\] names camera 'k9'; .* k1, k2, k3"):
        images_with_stated_sides(unknown, NAMES, image_of, "one")


def test_stated_sides_decide_their_set():
    """The legs of all views were exchanged in two sets, in one of which a view's are stated."""
    rng = np.random.default_rng(1)
    given, points = rng.normal(size=(2, 3, 135, 3)), rng.normal(size=(2, 135, 3))
    legs = np.array([[False, True, False, False]] * 2)
    turned = np.swapaxes(exchange_points(np.swapaxes(given, 1, 2), legs), 1, 2)
    none = np.zeros(270)
    found = Triangulation(
        exchange_points(points, legs).reshape(-1, 3), np.ones((270, 3), bool), none, none
    )
    stated = np.zeros((2, 3), bool)
    assert hold_sides(turned, found, given, stated)[1] is found
    stated[1, 2] = True
    keypoints, held = hold_sides(turned, found, given, stated)
    np.testing.assert_array_equal(keypoints[0], turned[0])
    np.testing.assert_array_equal(keypoints[1], given[1])
    np.testing.assert_array_equal(held.points.reshape(2, 135, 3)[1], points[1])
    assert (held.points.reshape(2, 135, 3)[0, LEGS] != points[0, LEGS]).all()


def test_statement_decides_without_other_evidence(tmp_path):
    """All cameras exchange the sides throughout, and nothing shows where the front is."""
    keypoints = seen_by(BODY, RIG, UP)
    shown = [
        KEYPOINT_INDEX[f"{side}_{name}"]
        for side in ("left", "right")
        for name in ("shoulder", "hip")
    ]
    shown += [KEYPOINT_INDEX["neck"], KEYPOINT_INDEX["mid_hip"]]
    hidden = np.setdiff1d(np.arange(135), shown)
    keypoints[:, :, hidden, 2] = 0
    wrong = joints(tmp_path, swap_sides(keypoints))
    found = joints(tmp_path, swap_sides(keypoints), ExchangedSides(start=0, end=T))
    assert np.linalg.norm(wrong[:, shown[:4]] - TRUE[:, shown[:4]], axis=-1).min() > 0.2
    assert np.linalg.norm(found[:, shown] - TRUE[:, shown], axis=-1).max() < 0.01


def test_most_cameras_are_exchanged_back(tmp_path):
    cameras = (1, 2, 3, 4)
    keypoints = seen_by(BODY, RIG, UP)
    for c in cameras:
        keypoints[2:6, c] = swap_sides(keypoints[2:6, c])
    stated = [ExchangedSides(start=2, end=6, camera=RIG.names[c]) for c in cameras]
    found = joints(tmp_path, keypoints, *stated)
    assert np.linalg.norm(found[:, :25] - TRUE[:, :25], axis=-1).max() < 0.01
