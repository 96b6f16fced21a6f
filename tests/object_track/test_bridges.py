"""Lost frames: in the hand that held the object, or on the straight way, as the images say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.bridges import Bridge, Gap, straight
from intercap_core.object_track.filled import Filled, fill
from intercap_core.object_track.frame_result import FrameResult
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.view import View, ViewGeometry
from intercap_core.object_track.whole import WholeTrack
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import FPS, ObjectCapture

FRAMES = 9
WRIST, INDEX, PINKY = (KEYPOINT_NAMES.index(f"right_{n}") for n in ("wrist", "index1", "pinky1"))
PALM = np.array([[0.0, 0, 0], [0.09, 0.03, 0.01], [0.08, -0.04, 0]])  # wrist and knuckles


def hand_of(poses: np.ndarray, grasp: np.ndarray) -> np.ndarray:
    """Joints (T, 135, 3) of a right hand that moves as ``poses`` (T, 4, 4) do, from which the hand
    is at ``grasp`` (3,)."""
    joints = np.full((len(poses), 135, 3), np.nan)
    place = (PALM + grasp) @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    joints[:, [WRIST, INDEX, PINKY]] = place
    return joints


def arc(count: int) -> np.ndarray:
    """Poses (T, 4, 4) on half a circle of 30 cm, in which they turn with it."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    angle = np.linspace(0, np.pi, count)
    poses[:, :3, :3] = Rotation.from_euler("z", angle[:, None]).as_matrix()
    poses[:, 0, 3], poses[:, 1, 3] = 0.3 * np.cos(angle), 0.3 * np.sin(angle)
    return poses


@pytest.fixture(scope="module")
def suitcase() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["suitcase"]).simplified(600)


def ways_of(mesh: ObjectMesh, poses: np.ndarray, joints: np.ndarray) -> list[Bridge]:
    times = np.arange(FRAMES) / 30
    return Gap(mesh, poses, times, joints, 1, FRAMES - 2).bridges()


def test_in_a_hand_it_goes_where_the_hand_goes(suitcase: ObjectMesh) -> None:
    poses = arc(FRAMES)
    direct, held = ways_of(suitcase, poses, hand_of(poses, np.array([0.05, 0, 0])))
    assert held.log_ratio == pytest.approx(0) and direct.log_ratio < -3
    np.testing.assert_allclose(held.poses, poses[2:-2], atol=1e-9)
    assert np.linalg.norm((direct.poses - poses[2:-2])[:, :3, 3], axis=1).max() > 0.1
    # the less is known, the longer before and after it was seen; nothing by the straight way
    sure = held.information[:, 0, 0]
    assert (np.diff(sure)[:2] < 0).all() and (np.diff(sure)[2:] > 0).all()
    assert not direct.information.any()


def test_where_the_ends_differ_in_the_hand_it_slips_on_the_way(suitcase: ObjectMesh) -> None:
    poses = arc(FRAMES)
    joints = hand_of(poses, np.array([0.05, 0, 0]))
    slipped = poses.copy()
    slip = 0.015 * np.linspace(0, 1, FRAMES - 2)
    slipped[1:-1, :3, 3] += slip[:, None] * poses[1:-1, :3, 2]
    found = ways_of(suitcase, slipped, joints)[1]
    np.testing.assert_allclose(found.poses, slipped[2:-2], atol=1e-3)


def test_a_frame_without_the_hand_lies_between(suitcase: ObjectMesh) -> None:
    poses = arc(FRAMES)
    joints = hand_of(poses, np.array([0.05, 0, 0]))
    joints[4] = np.nan
    direct, held = ways_of(suitcase, poses, joints)
    assert not held.information[2].any() and held.information[[0, 1, 3, 4], 0, 0].all()
    np.testing.assert_array_equal(held.poses[2], direct.poses[2])
    joints[2:-2] = np.nan  # unknown in all lost frames
    assert len(ways_of(suitcase, poses, joints)) == 1
    joints[-2] = np.nan  # of what a hand does from one end to the other nothing is known
    assert len(ways_of(suitcase, poses, joints)) == 1


def test_straight_is_the_shortest_way_and_holds_at_the_ends() -> None:
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = [[9, 9, 9], [0.0, 0, 0], [9, 9, 9], [9, 9, 9], [0.3, 0, 0], [9, 9, 9]]
    poses[4, :3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    found = straight(poses, np.array([False, True, False, False, True, False]))
    np.testing.assert_allclose(found[:, 0, 3], [0, 0, 0.1, 0.2, 0.3, 0.3])
    angle = Rotation.from_matrix(found[:, :3, :3]).magnitude()
    np.testing.assert_allclose(np.degrees(angle), [0, 0, 30, 60, 90, 90])


# --- with images --------------------------------------------------------------------------------


def observer_of(capture: ObjectCapture, joints: np.ndarray, blind: set[int]) -> Observer:
    images = []
    for t in range(len(capture.poses)):
        views = []
        for c, camera in enumerate(capture.rig):
            depth, person, candidates = capture.image(t, c)
            geometry = ViewGeometry.for_object(camera, capture.mesh.diameter, time_offset_s=0.0)
            views.append(
                View.build(geometry, None, person, [], detected=False)
                if t in blind
                else View.build(geometry, depth, person, candidates)
            )
        images.append(views)
    labels = [[[k.label for k in view.candidates] for view in own] for own in images]
    settings = ObjectTrackSettings()
    return Observer(
        capture.mesh, images.__getitem__, labels, settings, (capture.label,), joints=joints
    )


def filled_of(
    capture: ObjectCapture, joints: np.ndarray, lost: np.ndarray, blind: set[int]
) -> tuple[Filled, Observer]:
    observer = observer_of(capture, joints, blind)
    poses = capture.poses.copy()
    poses[lost, :3, 3] += 3.0  # what a lost frame says is not read
    return fill(observer, poses, lost, capture.times, 0.2), observer


def away_and_back(poses: np.ndarray) -> np.ndarray:
    """Poses (T, 4, 4) that swing 30 cm aside and return to the first."""
    found = np.tile(poses[0], (len(poses), 1, 1))
    found[:, :3, 3] += 0.3 * np.sin(np.linspace(0, np.pi, len(poses)))[:, None] * [0.6, 0.8, 0]
    return found


class Still(ObjectCapture):
    """An object that stands."""

    def pose_at(self, t: float) -> np.ndarray:
        return super().pose_at(0.0)


def test_images_tell_what_stands_from_what_went_with_the_hand(suitcase: ObjectMesh) -> None:
    """At both ends the hand is where it was: it went away and returned, the object stood."""
    capture = Still.make(suitcase, 7)
    joints = hand_of(away_and_back(capture.poses), suitcase.centre_of_mass)
    lost = np.array([False, True, True, True, True, True, False])
    found, _ = filled_of(capture, joints, lost, set())
    np.testing.assert_allclose(found.poses, capture.poses, atol=1e-9)
    assert not found.sure.any() and not found.hand.any()


def test_where_nothing_tells_them_apart_no_hand_surely_has_it(suitcase: ObjectMesh) -> None:
    capture = Still.make(suitcase, 7)
    joints = hand_of(away_and_back(capture.poses), suitcase.centre_of_mass)
    lost = np.array([False, True, True, True, True, True, False])
    found, _ = filled_of(capture, joints, lost, set(range(1, 6)))
    assert not found.sure.any()


def test_what_a_hand_carries_out_of_sight_is_not_lost(suitcase: ObjectMesh) -> None:
    capture = ObjectCapture.make(suitcase, 7, speed=0.06, turn_deg=8.0)
    rng = np.random.default_rng(3)
    joints = hand_of(capture.poses, suitcase.centre_of_mass)
    joints += 0.003 * rng.normal(size=joints.shape)
    lost = np.array([False, False, True, True, True, False, False])
    found, observer = filled_of(capture, joints, lost, {2, 3, 4})
    off = np.linalg.norm((found.poses - capture.poses)[:, :3, 3], axis=1)
    assert off.max() < 0.03 and found.sure[lost].all() and not found.sure[~lost].any()
    fits = [observer.fit(t, pose, None) for t, pose in enumerate(capture.poses)]
    frames = [FrameResult(fit, lost=bool(lost[t])) for t, fit in enumerate(fits)]
    final = WholeTrack(observer, capture.times, 1 / FPS / 0.3).refine(frames)
    assert not any(frame.lost for frame in final)
    off = [
        np.linalg.norm((frame.fit.pose - true)[:3, 3])
        for frame, true in zip(final, capture.poses, strict=True)
    ]
    assert max(off) < 0.03


def test_of_two_hands_that_part_neither_surely_has_it(suitcase: ObjectMesh) -> None:
    capture = Still.make(suitcase, 7)
    away = hand_of(away_and_back(capture.poses), suitcase.centre_of_mass)
    there = hand_of(capture.poses, suitcase.centre_of_mass)
    joints = there.copy()
    left = [KEYPOINT_NAMES.index(f"left_{name}") for name in ("wrist", "index1", "pinky1")]
    joints[:, left] = away[:, [WRIST, INDEX, PINKY]]
    lost = np.array([False, True, True, True, True, True, False])
    found, _ = filled_of(capture, joints, lost, set(range(1, 6)))
    assert not found.sure.any()


def test_what_is_taken_up_elsewhere_much_later_is_not_surely_carried(suitcase: ObjectMesh) -> None:
    """The images are blind for over a second; the hand is at the object at both ends."""
    capture = ObjectCapture.make(suitcase, 20, speed=0.03, turn_deg=2.0)
    joints = hand_of(capture.poses, suitcase.centre_of_mass)
    lost = np.ones(20, bool)
    lost[[0, -1]] = False
    assert not filled_of(capture, joints, lost, set(range(1, 19)))[0].sure.any()


def test_a_symmetric_object_turns_on_in_the_hand() -> None:
    """Two-fold; turned by 126 degrees unseen, the frame after is found the other way round."""
    board = ObjectMesh.load(catalogue()["skateboard"]).simplified(600)
    assert not board.symmetry.trivial
    capture = ObjectCapture.make(board, 12, speed=0.02, turn_deg=14.0, label="skateboard")
    joints = hand_of(capture.poses, board.centre_of_mass)
    lost = np.zeros(12, bool)
    lost[2:10] = True
    poses = capture.poses.copy()
    poses[10:] = poses[10:] @ board.symmetry.discrete[1]
    observer = observer_of(capture, joints, set(range(2, 10)))
    found = fill(observer, poses, lost, capture.times, 0.2)
    steps = Rotation.from_matrix(found.poses[1:, :3, :3] @ found.poses[:-1, :3, :3].swapaxes(1, 2))
    np.testing.assert_allclose(np.degrees(steps.magnitude()), 14, atol=2)
    np.testing.assert_allclose(found.poses, capture.poses, atol=0.02)
