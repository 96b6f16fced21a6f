"""What the scripts promise: real contact, no sinking in, feet that stand, objects that rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from intercap_core.config import ObjectEntry, StudioCapture, StudioSettings
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.surfaces import sample_surface
from intercap_core.schemas import CONTACT_REGIONS
from intercap_core.studio.capture import region_contact
from intercap_core.studio.hands import OPEN, Hand, shape
from intercap_core.studio.skeleton import REACH_FREE, PuppetSkeleton, turn
from intercap_core.studio.stage import StageState, StudioStage
from intercap_core.studio.subjects import Subject


@dataclass(frozen=True)
class Case:
    """What one interaction promises. ``contact``: frames (first, last) at 15 fps in which the body
    touches the object all the time; ``rests``: script times in which it does not move."""

    thing: str
    subject: str
    seed: int
    regions: set[str]
    contact: tuple[int, int]
    rests: tuple[tuple[float, float], ...]
    on_floor: bool = True
    pressed_m: float = 0.006  # how deep flesh gives way at most
    object_m_s: float = 2.5
    joint_m_s: float = 4.5
    joint_m_s2: float = 100.0


CASES = {
    "suitcase_carry": Case(
        "suitcase", "s01", 11, {"right_hand"}, (17, 36), ((0.0, 1.05), (2.5, 3.0))
    ),
    "cup_drink": Case(
        "cup", "s02", 12, {"right_hand", "mouth"}, (17, 36), ((0.0, 1.05), (2.5, 3.0)),
        on_floor=False,
    ),
    "bottle_drink": Case(
        "bottle", "s03", 5, {"right_hand", "mouth"}, (17, 36), ((0.0, 1.05), (2.5, 3.0)),
        on_floor=False,
    ),
    "football_check": Case(
        "football", "s04", 21, {"right_hand", "left_hand"}, (16, 37), ((0.0, 0.93), (2.53, 3.0)),
        on_floor=False,
    ),
    "bottle_check": Case(
        "bottle", "s01", 8, {"right_hand", "left_hand"}, (16, 37), ((0.0, 0.93), (2.53, 3.0)),
        on_floor=False,
    ),
    "cup_pass": Case(
        "cup", "s10", 23, {"right_hand"}, (16, 37), ((0.0, 0.93), (2.59, 3.0)), on_floor=False
    ),
    "football_pass": Case(
        "football", "s08", 24, {"right_hand", "left_hand"}, (16, 37), ((0.0, 0.93), (2.59, 3.0)),
        on_floor=False,
    ),
    "racquet_swing": Case(
        "tennis_racquet", "s03", 5, {"right_hand"}, (16, 37), ((0.0, 0.93), (2.57, 3.0)),
        on_floor=False, object_m_s=10.0, joint_m_s=6.5, joint_m_s2=150.0,
    ),
    "umbrella_swing": Case(
        "umbrella", "s09", 25, {"right_hand"}, (16, 37), ((0.0, 0.93), (2.57, 3.0)),
        on_floor=False, object_m_s=6.5,
    ),
    "racquet_glide": Case(
        "tennis_racquet", "s03", 6, {"right_hand"}, (16, 37), ((0.0, 0.93), (2.57, 3.0)),
        on_floor=False, object_m_s=10.0, joint_m_s=6.5, joint_m_s2=150.0,
    ),
    "umbrella_turn": Case(
        "umbrella", "s09", 26, {"right_hand"}, (16, 37), ((0.0, 0.93), (2.57, 3.0)),
        on_floor=False, object_m_s=6.5,
    ),
    "bottle_regrasp": Case(
        "bottle", "s08", 27, {"right_hand"}, (21, 37), ((0.0, 1.36), (2.53, 3.0)), on_floor=False
    ),
    "stool_sit": Case(
        "stool", "s05", 13, {"seat", "right_hand"}, (22, 30), ((0.0, 2.9),), pressed_m=0.018
    ),
    "chair_sit": Case(
        "chair", "s10", 193616834, {"seat", "back", "right_hand"}, (22, 33), ((0.0, 3.0),),
        pressed_m=0.02,
    ),
    "toolbox_carry": Case(
        "toolbox", "s02", 2, {"right_hand"}, (17, 36), ((0.0, 1.05), (2.5, 3.0))
    ),
    "football_kick": Case("football", "s08", 5, {"right_foot"}, (13, 15), ((0.0, 1.55),)),
    "skateboard_ride": Case(
        "skateboard", "s01", 11, {"left_foot", "right_foot"}, (12, 33), ((0.0, 0.80), (2.17, 3.0))
    ),
}  # fmt: skip


Entry = Callable[[str], ObjectEntry]


@pytest.fixture(scope="module", params=list(CASES))
def played(
    request: pytest.FixtureRequest, object_entry: Entry
) -> tuple[str, StudioStage, StageState]:
    name = request.param
    case = CASES[name]
    capture = StudioCapture(interaction=name, subject=case.subject, seed=case.seed, frames=45)
    stage = StudioStage(capture, StudioSettings(captures={}, cameras=2), object_entry(case.thing))
    return name, stage, stage.at(stage.set_times)


def signed_distance(stage: StudioStage, points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return stage.prop.surface.signed_distance((points - pose[:3, 3]) @ pose[:3, :3])


def test_nothing_enters_the_object(played: tuple[str, StudioStage, StageState]) -> None:
    _, stage, moment = played
    for t in range(2, stage.frames, 5):
        for surface in (moment.body[t], moment.clothed[t]):
            distance = signed_distance(stage, surface, moment.stage_from_object[t])
            inside = distance[distance < 0]
            assert inside.size == 0 or -inside.mean() < 0.002


def test_the_object_does_not_enter_the_body(played: tuple[str, StudioStage, StageState]) -> None:
    """A board is thinner than the way between two vertices of the skin, and so may be a step."""
    _, stage, moment = played
    thing = stage.prop
    samples = sample_surface(thing.vertices, thing.faces, 2000).of(thing.vertices, thing.faces)
    for t in range(1, stage.frames, 4):
        pose = moment.stage_from_object[t]
        body = DistanceField(moment.body[t], stage.puppet.subject.faces)
        assert -body.signed_distance(samples @ pose[:3, :3].T + pose[:3, 3]).min() < 0.015


def test_flesh_is_pressed_in_by_no_more_than_it_gives(
    played: tuple[str, StudioStage, StageState],
) -> None:
    """Before the tissue gives way: millimetres at a hand, a centimetre and a half on a seat."""
    name, stage, _ = played
    performed = stage.interaction.perform(np.arange(0.0, 3.0, 0.12))
    skin = stage.puppet.skin(performed.world, performed.pelvis).vertices
    deepest = min(
        signed_distance(stage, points, pose).min()
        for points, pose in zip(skin, performed.stage_from_object, strict=True)
    )
    assert -deepest < CASES[name].pressed_m


def test_expected_regions_touch_for_long(played: tuple[str, StudioStage, StageState]) -> None:
    name, stage, moment = played
    expected, (first, last) = CASES[name].regions, CASES[name].contact
    contact = region_contact(stage, moment)
    touching = {r for r, on in zip(CONTACT_REGIONS, contact.T, strict=True) if on.any()}
    assert expected <= touching
    assert contact[first:last].any(1).all()
    assert not contact[:5].any()


def test_hands_stay_out_of_the_body(played: tuple[str, StudioStage, StageState]) -> None:
    """As far as flesh gives way, but for a thumb that passes the hip as one sits down."""
    _, stage, moment = played
    part = stage.subject.weights.toarray().argmax(1)
    faces = stage.subject.faces
    for elbow, wrist, first in ((18, 20, 25), (19, 21, 40)):
        hand = (part == wrist) | ((part >= first) & (part < first + 15))
        rest = faces[~(hand | (part == elbow))[faces].any(1)]
        depths = []
        for t in range(2, stage.frames, 4):
            surface = DistanceField(moment.body[t], rest, watertight=False, threads=2)
            depths.append(-surface.signed_distance(moment.body[t][hand]).min())
        assert max(depths) < 0.055 and np.median(depths) < 0.015


def test_planted_feet_do_not_slide_or_sink(played: tuple[str, StudioStage, StageState]) -> None:
    _, stage, moment = played
    ankle, _, pitch = stage.interaction.footwork.feet(stage.set_times)
    height = stage.puppet.ankle_height
    stands = np.zeros(stage.frames, bool)
    for side, joint in enumerate((7, 8)):
        planted = (ankle[:, side, 2] < height[side] + 1e-6) & (np.abs(pitch[:, side]) < 1e-6)
        steps = np.diff(moment.joints[:, joint], axis=0)[planted[:-1] & planted[1:]]
        assert (np.abs(steps) < 0.0005).all()
        stands |= planted
    lowest = moment.body[..., 2].min(1)
    assert lowest.min() > -0.006  # a heel may dip a little as the foot rolls
    assert np.median(np.abs(lowest[stands])) < 0.002


def test_a_resting_object_does_not_move(played: tuple[str, StudioStage, StageState]) -> None:
    name, stage, moment = played
    for start, end in CASES[name].rests:
        assert end - start >= 0.4
        resting = (stage.set_times >= start) & (stage.set_times <= end)
        poses = moment.stage_from_object[resting]
        assert np.abs(poses - poses[0]).max() < 1e-12
    lowest = (stage.prop.vertices @ moment.stage_from_object[-1, 2, :3]).min()
    if CASES[name].on_floor:
        assert abs(lowest + moment.stage_from_object[-1, 2, 3]) < 1e-6


def test_object_and_hand_move_together_without_a_jump(
    played: tuple[str, StudioStage, StageState],
) -> None:
    name, stage, _ = played
    case = CASES[name]
    times = np.arange(0, 3, 0.01)
    performed = stage.interaction.perform(times)
    speed = np.linalg.norm(np.diff(performed.stage_from_object[:, :3, 3], axis=0), axis=1) / 0.01
    assert speed.max() < case.object_m_s
    joints = stage.puppet.skeleton.forward(performed.world, performed.pelvis)
    assert np.linalg.norm(np.diff(joints, axis=0), axis=-1).max() / 0.01 < case.joint_m_s
    assert np.linalg.norm(np.diff(joints, 2, axis=0), axis=-1).max() / 1e-4 < case.joint_m_s2


def test_a_kicked_ball_slides_then_rolls_then_stops(object_entry: Entry) -> None:
    case = CASES["football_kick"]
    capture = StudioCapture(interaction="football_kick", subject=case.subject, seed=case.seed,
                            frames=45)  # fmt: skip
    stage = StudioStage(capture, StudioSettings(captures={}, cameras=1), object_entry(case.thing))
    times = np.arange(2.0, 3.0, 0.02)
    pose = stage.interaction.perform(times).stage_from_object
    speed = np.linalg.norm(np.diff(pose[:, :2, 3], axis=0), axis=1) / 0.02
    between = np.swapaxes(pose[:-1, :3, :3], 1, 2) @ pose[1:, :3, :3]
    spin = np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)) / 0.02
    assert (np.diff(speed) < 1e-3).all()
    assert speed[-1] == 0
    rolls = speed > 0.1
    np.testing.assert_allclose(spin[rolls] * 0.11, speed[rolls], rtol=0.02)


def test_a_longer_recording_is_slower_and_a_short_one_shows_the_highlight(
    object_entry: Entry,
) -> None:
    case = CASES["stool_sit"]
    speeds = []
    for frames in (45, 90):
        capture = StudioCapture(
            interaction="stool_sit", subject=case.subject, seed=case.seed, frames=frames
        )
        stage = StudioStage(
            capture, StudioSettings(captures={}, cameras=1), object_entry(case.thing)
        )
        script = stage.interaction.script_times(stage.set_times, stage.duration)
        speeds.append(np.diff(script)[0] * 15)
    assert speeds == pytest.approx([1.0, 0.5])
    short = stage.interaction.script_times(np.array([0.0, 0.2]), 0.2)
    assert short[0] <= stage.interaction.highlight <= short[1]


def test_wrong_object_or_subject_is_refused(object_entry: Entry) -> None:
    settings = StudioSettings(captures={}, cameras=1)
    capture = StudioCapture(interaction="cup_drink", subject="s01", seed=1, frames=3)
    with pytest.raises(UserError, match="needs object 'cup'"):
        StudioStage(capture, settings, object_entry("stool"))
    nobody = capture.model_copy(update={"subject": "nobody"})
    with pytest.raises(UserError, match="no subject 'nobody'"):
        StudioStage(nobody, settings, object_entry("cup"))


def test_limb_reaches_its_target_and_bends_to_the_pole() -> None:
    skeleton = PuppetSkeleton(Subject.load("s03").rest_joints)
    rng = np.random.default_rng(0)
    names = ("left_hip", "left_knee", "left_ankle")
    length = skeleton.length(*names)
    root = rng.normal(size=(50, 3))
    direction = rng.normal(size=(50, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    target = root + direction * rng.uniform(0.4, REACH_FREE, (50, 1)) * length
    pole = rng.normal(size=(50, 3))
    upper, lower = skeleton.limb(names, root, target, pole, np.array([1.0, 0, 0]))
    knee = root + upper @ skeleton.bone(*names[:2])
    end = knee + lower @ skeleton.bone(*names[1:])
    np.testing.assert_allclose(end, target, atol=1e-9)
    across = pole - direction * (pole * direction).sum(1, keepdims=True)
    assert (((knee - root) * across).sum(1) > 0).all()
    np.testing.assert_allclose(np.linalg.det(upper), 1, atol=1e-9)


def test_fingers_flex_towards_the_palm() -> None:
    for side in (0, 1):
        hand = Hand(Subject.load("s04"), side)
        fist = shape((60, 70, 40), (20, 20, 20), 40)
        open_tips, fist_tips = (
            hand.skin(hand.local(h)[None])[0][hand.moved[1][2]].mean(0) for h in (OPEN, fist)
        )
        assert (fist_tips - open_tips) @ hand.palm > 0.01
        assert (fist_tips - open_tips) @ hand.out < -0.02


def test_turn_is_a_rotation_about_its_vector() -> None:
    vector = np.array([0.3, -0.2, 0.9])
    np.testing.assert_allclose(turn(vector) @ vector, vector, atol=1e-12)
