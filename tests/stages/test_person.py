"""Stage ``person``: the subject, its keypoints and its masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.config import PersonSettings
from intercap_core.errors import UserError
from intercap_core.formats.recordings.synchronise import images_of_moments
from intercap_core.geometry.camera import masks
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.person.sides import exchange_points
from intercap_core.person.subject_joints import steady_sides
from intercap_core.schemas import PERSON
from intercap_core.stages import person
from tests.helpers.synthetic_capture import ring, write_frames, write_scene
from tests.helpers.synthetic_people import seen_by, walking, write_detections

RIG, UP = ring()
T = 8
BODY = walking(T, np.array([-0.2, 0.1]), np.array([0.01, 0]))


def silhouette(keypoints: np.ndarray, grow: int = 25) -> np.ndarray:
    """A filled box around the body's points."""
    mask = np.zeros((1080, 1920), np.uint8)
    low = np.clip(keypoints[:25, :2].min(0) - grow, 0, None).astype(int)
    high = (keypoints[:25, :2].max(0) + grow).astype(int)
    mask[low[1] : high[1], low[0] : high[0]] = 1
    return mask


@pytest.fixture(scope="module")
def detected() -> np.ndarray:
    keypoints = seen_by(BODY, RIG, UP)
    keypoints[..., :2] += np.random.default_rng(0).normal(0, 3, keypoints[..., :2].shape)
    return keypoints


def alone(keypoints: np.ndarray) -> list:
    """One person per image with keypoints (T, C, 135, 3)."""
    return [[[of_view] for of_view in of_set] for of_set in keypoints]


def run(tmp_path, people, candidates=None, slip=None, note="") -> Path:
    slip = np.zeros((T, len(RIG)), int) if slip is None else slip
    image_of = images_of_moments(slip, np.ones(slip.shape, bool))
    person.run(
        frames=write_frames(tmp_path / "frames.h5", RIG, num_sets=T),
        detections=write_detections(tmp_path / "detections.h5", RIG, people, candidates, note),
        scene=write_scene(
            tmp_path / "scene.h5", RIG, np.arange(T) / 15, slip=slip, image_of=image_of
        ),
        output=tmp_path / "person.h5",
        settings=PersonSettings(segmentation="detector"),
    )
    return tmp_path / "person.h5"


def test_points_views_and_flags(tmp_path, detected):
    damaged = detected.copy()
    damaged[3, 1, 4, :2] += 150  # one wrist, in one view
    damaged[4, 2, 10, 2] = 0.1  # one knee that the detector does not believe
    people = alone(damaged)
    people[6] = [[] for _ in range(6)]
    people[7] = [[damaged[7, 0]], *[[] for _ in range(5)]]
    with artefacts.read(run(tmp_path, people), PERSON) as found:
        np.testing.assert_array_equal(found["missing"], [False] * 6 + [True] * 2)
        np.testing.assert_array_equal(found["person"][:6], 0)
        np.testing.assert_array_equal(found["person"][7], [0, -1, -1, -1, -1, -1])
        truth = apply(invert(UP), BODY.reshape(-1, 3)).reshape(T, 135, 3)
        error = np.linalg.norm(found["joints"] - truth, axis=-1)
        assert np.median(error[:6]) < 0.01 and error[:6].max() < 0.03
        assert np.isnan(error[6:]).all()
        views = found["joint_views"]
        assert views[3, 4] == 5 and views[4, 10] == 5 and (views[6:] == 0).all()
        assert not found["inlier"][3, 1, 4] and not found["inlier"][4, 2, 10]
        np.testing.assert_array_equal(found["inlier"].sum(1), views)
        assert 2 < np.nanmedian(found["joint_error"]) < 6
        assert (np.diff(found["mask_offsets"]) == 0).all() and len(
            found["mask_offsets"]
        ) == T * 6 + 1


def test_missing_neck_and_mid_hip_are_filled_in(tmp_path, detected):
    lacking = detected.copy()
    lacking[:, :, [1, 8]] = 0  # as COCO's layouts have it
    with artefacts.read(run(tmp_path, alone(lacking)), PERSON) as found:
        joints = found["joints"]
        assert not found["missing"].any() and (found["person"] == 0).all()
        assert (found["joint_views"][:, [1, 8]] == 0).all()
        assert (found["keypoints"][:, :, [1, 8], 2] == 0).all()
        np.testing.assert_allclose(joints[:, 1], joints[:, [2, 5]].mean(1), atol=1e-6)
        np.testing.assert_allclose(joints[:, 8], joints[:, [9, 12]].mean(1), atol=1e-6)


def test_masks_follow_the_points_not_the_label_or_the_order(tmp_path, detected):
    people = alone(detected)
    own = silhouette(detected[0, 0])
    beside = np.roll(own, 600, axis=1)
    everything = np.ones_like(own)
    candidates = {
        (0, 0): [("person", masks.encode(beside)), ("person", masks.encode(own))],
        (0, 1): [("chair", masks.encode(silhouette(detected[0, 1])))],
        (0, 2): [
            ("person", masks.encode(everything)),
            ("dog", masks.encode(silhouette(detected[0, 2]))),
        ],
        (0, 3): [("person", masks.encode(np.roll(silhouette(detected[0, 3]), 700, axis=1)))],
    }
    with artefacts.read(run(tmp_path, people, candidates), PERSON) as found:
        chosen = artefacts.unpack_ragged(found["mask_offsets"], found["mask_rle"])
    assert chosen[0] == candidates[0, 0][1][1]
    assert chosen[1] == candidates[0, 1][0][1]
    assert chosen[2] == candidates[0, 2][1][1]
    assert chosen[3] == b"" and chosen[4] == b""


def test_camera_with_another_person_is_excluded_meanwhile(tmp_path, detected):
    """The detector returns one person an image; its keypoints and its mask in the third camera are
    somebody else's in three sets. They are in nothing, and the other views lose nothing."""
    other = seen_by(walking(T, np.array([0.9, 0.7]), np.zeros(2)), RIG, UP)
    wrong = np.zeros((T, 6), bool)
    wrong[2:5, 2] = True
    seen = np.where(wrong[..., None, None], other, detected)
    people = alone(seen)
    candidates = {
        (t, c): [("person", masks.encode(silhouette(seen[t, c])))]
        for t, c in np.argwhere(wrong | np.roll(wrong, 3, axis=0)).tolist()
    }
    with artefacts.read(run(tmp_path, people, candidates), PERSON) as found:
        np.testing.assert_array_equal(found["person"], np.where(wrong, -1, 0))
        assert (found["keypoints"][wrong] == 0).all() and not found["inlier"][wrong].any()
        np.testing.assert_allclose(found["keypoints"][~wrong], detected[~wrong].astype(np.float32))
        body = found["joint_views"][:, :25]
        assert (np.median(body, axis=1) == np.where(wrong.any(1), 5, 6)).all()
        truth = apply(invert(UP), BODY.reshape(-1, 3)).reshape(T, 135, 3)
        error = np.linalg.norm(found["joints"] - truth, axis=-1)
        assert error.max() < 0.03 and not found["missing"].any()
        chosen = artefacts.unpack_ragged(found["mask_offsets"], found["mask_rle"])
    for t, c in candidates:
        assert chosen[t * 6 + c] == (b"" if wrong[t, c] else candidates[t, c][0][1])


def test_slipped_images_are_used_at_their_moment(tmp_path, detected):
    """From set 3 on the fourth camera's images are two sets old; moments 6 and 7 lack them."""
    slip = np.zeros((T, 6), np.int32)
    slip[3:, 3] = 2
    late = [[[detected[t - slip[t, c], c]] for c in range(6)] for t in range(T)]
    candidates = {(5, 3): [("person", masks.encode(silhouette(detected[3, 3])))]}
    with artefacts.read(run(tmp_path, late, candidates, slip), PERSON) as found:
        there = found["person"] >= 0
        assert (~there).sum() == 2 and not there[6:, 3].any()
        seen = found["keypoints"][there]
        np.testing.assert_allclose(seen, detected[there].astype(np.float32))
        rles = artefacts.unpack_ragged(found["mask_offsets"], found["mask_rle"])
        assert rles[3 * 6 + 3] == candidates[5, 3][0][1]
        assert (found["joint_views"][:6] == 6).all() and (found["joint_views"][6:] <= 5).all()


def test_same_input_same_bytes(tmp_path, detected):
    first = run(tmp_path, alone(detected)).read_bytes()
    assert run(tmp_path, alone(detected)).read_bytes() == first


def test_missing_people_and_foreign_captures_are_rejected(tmp_path, detected):
    with pytest.raises(UserError, match=r"sequence test: .* no image has keypoints of anybody"):
        run(tmp_path, [[[] for _ in range(6)] for _ in range(T)])
    with pytest.raises(UserError, match=r"keypoints of anybody \(k2: all points lie outside\)"):
        run(tmp_path, [[[] for _ in range(6)] for _ in range(T)], note="all points lie outside")
    with pytest.raises(UserError, match="frame sets differ"):
        run(tmp_path, [[[detected[0, c]] for c in range(6)] for _ in range(T - 1)])
    people = alone(detected)
    with pytest.raises(UserError, match=r"camera k1, frame 0, candidate 0 \(cup\).*re-run"):
        run(tmp_path, people, {(0, 0): [("cup", b"11")]})


def test_two_views_undo_a_temporary_side_exchange(detected):
    views = Rig(RIG.cameras[:2])
    exchanged = detected[:, :2].copy()
    legs = np.tile([False, True, False, False], (3, 1))  # of person.sides.LIMBS
    exchanged[3:6, 0] = exchange_points(exchanged[3:6, 0], legs)
    found = steady_sides(exchanged, views, min_confidence=0.3)
    np.testing.assert_array_equal(found, detected[:, :2])
    # with more views their vote decides
    six = detected.copy()
    six[3:6, 0] = exchange_points(six[3:6, 0], legs)
    np.testing.assert_array_equal(steady_sides(six, RIG, min_confidence=0.3), six)
