"""Lost frames: carried in a hand, or on the straight path, as the images show."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.bridges import Bridge, FilledTrack, Gap, fill_lost
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.whole import FrameResult, FrameStatus, WholeTrack
from tests.helpers.object_capture import ObjectCapture
from tests.object_track.scenes import Still, images_of, mesh_of, observer_of

FRAMES = 9
WRIST, INDEX, PINKY = (KEYPOINT_NAMES.index(f"right_{n}") for n in ("wrist", "index1", "pinky1"))
PALM = np.array([[0.0, 0, 0], [0.09, 0.03, 0.01], [0.08, -0.04, 0]])  # wrist and knuckles


def hand_of(poses: np.ndarray, grasp: np.ndarray) -> np.ndarray:
    """Joints (T, 135, 3) of a right hand at ``grasp`` (3,) of an object that moves by ``poses``."""
    joints = np.full((len(poses), 135, 3), np.nan)
    place = (PALM + grasp) @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    joints[:, [WRIST, INDEX, PINKY]] = place
    return joints


@pytest.fixture
def arc() -> np.ndarray:
    """Poses (T, 4, 4) on half a circle of 30 cm that turn with it."""
    turns = Rotation.from_euler("z", np.linspace(0, np.pi, FRAMES)[:, None])
    return rigid(turns.as_matrix(), turns.apply([0.3, 0, 0]))


def gap_of(mesh: ObjectMesh, poses: np.ndarray, joints: np.ndarray, before: int) -> Gap:
    """Gap after frame ``before`` that ends as long before the last frame."""
    count = len(poses)
    ends = before, count - 1 - before
    observer = Observer(
        mesh, lambda t: [], [[]] * count, ObjectTrackSettings(), np.arange(count) / 30, joints
    )
    return Gap(observer, poses, np.arange(before + 1, ends[1]), *ends, ends)


def bridges_of(mesh: ObjectMesh, poses: np.ndarray, joints: np.ndarray) -> list[Bridge]:
    return gap_of(mesh, poses, joints, 1).bridges()


def test_a_held_object_moves_with_the_hand(suitcase, arc):
    direct, in_hand = bridges_of(suitcase, arc, hand_of(arc, np.array([0.05, 0, 0])))
    assert in_hand.log_ratio == pytest.approx(0) and direct.log_ratio < -3
    np.testing.assert_allclose(in_hand.poses, arc[2:-2], atol=1e-9)
    assert np.linalg.norm((direct.poses - arc[2:-2])[:, :3, 3], axis=1).max() > 0.1
    # information falls with the time before and after; the straight path gives none
    information = in_hand.information[:, 0, 0]
    assert (np.diff(information)[:2] < 0).all() and (np.diff(information)[2:] > 0).all()
    assert not direct.information.any()


def test_a_slip_in_the_hand_is_spread_over_the_gap(suitcase, arc):
    joints = hand_of(arc, np.array([0.05, 0, 0]))
    slipped = arc.copy()
    slip = 0.015 * np.linspace(0, 1, FRAMES - 2)
    slipped[1:-1, :3, 3] += slip[:, None] * arc[1:-1, :3, 2]
    found = bridges_of(suitcase, slipped, joints)[1]
    np.testing.assert_allclose(found.poses, slipped[2:-2], atol=1e-3)


def test_frames_without_the_hand_are_on_the_straight_path(suitcase, arc):
    joints = hand_of(arc, np.array([0.05, 0, 0]))
    joints[4] = np.nan
    direct, in_hand = bridges_of(suitcase, arc, joints)
    assert not in_hand.information[2].any() and in_hand.information[[0, 1, 3, 4], 0, 0].all()
    np.testing.assert_array_equal(in_hand.poses[2], direct.poses[2])
    joints[2:-2] = np.nan  # unknown in all lost frames
    assert len(bridges_of(suitcase, arc, joints)) == 1
    joints[-2] = np.nan  # unknown after the gap
    assert len(bridges_of(suitcase, arc, joints)) == 1


def test_a_straight_path_is_the_shortest_turn_and_line(suitcase):
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[3, :3, 3] = [0.3, 0, 0]
    poses[3, :3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    (path,) = gap_of(suitcase, poses, np.full((4, 135, 3), np.nan), 0).bridges()
    np.testing.assert_allclose(path.poses[:, 0, 3], [0.1, 0.2])
    angle = Rotation.from_matrix(path.poses[:, :3, :3]).magnitude()
    np.testing.assert_allclose(np.degrees(angle), [30, 60])


def filled_of(
    capture: ObjectCapture, joints: np.ndarray, lost: np.ndarray, blind: range
) -> tuple[FilledTrack, Observer]:
    observer = observer_of(capture, images_of(capture, blind), joints=joints)
    poses = capture.poses.copy()
    poses[lost, :3, 3] += 3.0  # poses of lost frames are not used
    return fill_lost(observer, poses, lost), observer


def away_and_back(poses: np.ndarray) -> np.ndarray:
    """Poses (T, 4, 4) that swing 30 cm aside and return to the first."""
    found = np.tile(poses[0], (len(poses), 1, 1))
    found[:, :3, 3] += 0.3 * np.sin(np.linspace(0, np.pi, len(poses)))[:, None] * [0.6, 0.8, 0]
    return found


@pytest.fixture(scope="module")
def still(suitcase) -> Still:
    return Still.make(suitcase, 7, cameras=3)


BETWEEN = np.array([False, True, True, True, True, True, False])


def test_images_show_that_it_stayed_while_the_hand_left(suitcase, still):
    joints = hand_of(away_and_back(still.poses), suitcase.centre_of_mass)
    found, _ = filled_of(still, joints, BETWEEN, range(0))
    np.testing.assert_allclose(found.poses, still.poses, atol=1e-9)
    assert not found.sure.any() and not found.hand.any()


def test_a_hand_is_not_sure_if_no_image_confirms_it(suitcase, still):
    """One hand leaves and returns; then the other hand stays meanwhile."""
    away = hand_of(away_and_back(still.poses), suitcase.centre_of_mass)
    both = hand_of(still.poses, suitcase.centre_of_mass)
    left = [KEYPOINT_NAMES.index(f"left_{name}") for name in ("wrist", "index1", "pinky1")]
    both[:, left] = away[:, [WRIST, INDEX, PINKY]]
    for joints in (away, both):
        assert not filled_of(still, joints, BETWEEN, range(1, 6))[0].sure.any()


@pytest.mark.parametrize(
    ("first", "expected"), [(0, FrameStatus.LOST), (2, FrameStatus.BRIDGED), (4, FrameStatus.LOST)]
)
def test_a_hand_carries_it_through_hidden_frames(suitcase, first, expected):
    """At the start, in the middle and at the end; only known poses on both sides confirm it."""
    capture = ObjectCapture.make(suitcase, 7, speed=0.06, turn_deg=8.0)
    joints = hand_of(capture.poses, suitcase.centre_of_mass)
    joints += 0.003 * np.random.default_rng(3).normal(size=joints.shape)
    lost = np.isin(np.arange(7), np.arange(first, first + 3))
    found, observer = filled_of(capture, joints, lost, range(first, first + 3))
    off = np.linalg.norm((found.poses - capture.poses)[:, :3, 3], axis=1)
    assert off.max() < 0.03 and (found.sure == lost * (first == 2)).all()
    status = np.where(lost, FrameStatus.LOST, FrameStatus.SEEN)
    frames = [
        FrameResult(observer.fit(t, pose, None), FrameStatus(status[t]))
        for t, pose in enumerate(capture.poses)
    ]
    final = WholeTrack(observer).refine(frames)
    expected = np.where(lost, expected, FrameStatus.SEEN)
    assert [frame.status for frame in final] == expected.tolist()
    off = np.array([frame.fit.pose for frame in final]) - capture.poses
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.03


def test_a_hand_does_not_surely_carry_it_over_a_second(suitcase):
    capture = ObjectCapture.make(suitcase, 20, speed=0.03, turn_deg=2.0, cameras=1)
    joints = hand_of(capture.poses, suitcase.centre_of_mass)
    lost = np.ones(20, bool)
    lost[[0, -1]] = False
    assert not filled_of(capture, joints, lost, range(1, 19))[0].sure.any()


def test_a_symmetric_object_keeps_turning_in_the_hand():
    """Turned by 126 degrees unseen; the frame after is found in an equivalent pose."""
    board = mesh_of("skateboard")
    assert not board.symmetry.trivial
    capture = ObjectCapture.make(
        board, 12, speed=0.02, turn_deg=14.0, label="skateboard", cameras=2
    )
    joints = hand_of(capture.poses, board.centre_of_mass)
    lost = np.zeros(12, bool)
    lost[2:10] = True
    poses = capture.poses.copy()
    poses[10:] = poses[10:] @ board.symmetry.discrete[1]
    observer = observer_of(capture, images_of(capture, range(2, 10)), joints=joints)
    found = fill_lost(observer, poses, lost)
    steps = Rotation.from_matrix(found.poses[1:, :3, :3] @ found.poses[:-1, :3, :3].swapaxes(1, 2))
    np.testing.assert_allclose(np.degrees(steps.magnitude()), 14, atol=2)
    np.testing.assert_allclose(found.poses, capture.poses, atol=0.02)
