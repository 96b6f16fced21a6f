"""Motions of the scripts: contact, penetration, planted feet, resting objects, speeds, slip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from intercap_core.evaluation.motion import SLIP_S, Floor, slip_speed, support
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.surfaces import sample_surface
from intercap_core.schemas import CONTACT_REGIONS
from intercap_core.studio.capture import CONTACT_M, region_contact, support_height
from intercap_core.studio.interactions.alone import BeamWalk
from intercap_core.studio.interactions.slipping import (
    GlidingSwing,
    Regrasp,
)
from intercap_core.studio.stage import StageState, StudioStage
from tests.studio.studio_stage import make_stage

FPS = 15
CARRIED = ((0.0, 1.05), (2.5, 3.0))
SCANNED = ((0.0, 0.74),)
CHECKED, PASSED, SWUNG = (((0.0, 0.93), (end, 3.0)) for end in (2.53, 2.59, 2.57))


@dataclass(frozen=True)
class Case:
    """Promises of one interaction."""

    subject: str
    seed: int
    regions: set[str]
    """Body regions that touch the object."""
    contact: tuple[int, int]
    """First and last frame at 15 fps between which the body always touches the object."""
    rests: tuple[tuple[float, float], ...]
    """Script times in which the object does not move."""
    on_floor: bool = True
    object_m_s: float = 2.5
    joint_m_s: float = 4.5
    joint_m_s2: float = 100.0


PALMS = {"right_hand", "left_hand"}
DRUNK = {"right_hand", "mouth"}
RACQUET = {"on_floor": False, "object_m_s": 10.0, "joint_m_s": 6.5, "joint_m_s2": 150.0}
UMBRELLA = {"on_floor": False, "object_m_s": 6.5}
TURNED = {"on_floor": False, "object_m_s": 3.5, "joint_m_s": 6.0, "joint_m_s2": 260.0}
CASES = {
    "suitcase_carry": Case("s01", 11, {"right_hand"}, (17, 36), CARRIED),
    "cup_drink": Case("s02", 12, DRUNK, (17, 36), CARRIED, on_floor=False),
    "racquet_glide": Case("s03", 6, {"right_hand"}, (16, 37), SWUNG, **RACQUET),
    "stool_sit": Case(
        "s05", 13, {"seat", "right_hand"}, (22, 30), ((0.0, 2.9),)
    ),
    "football_kick": Case("s08", 5, {"right_foot"}, (13, 15), ((0.0, 1.55),)),
    "skateboard_ride": Case(
        "s01", 11, {"left_foot", "right_foot"}, (12, 33), ((0.0, 0.80), (2.17, 3.0))
    ),
}  # fmt: skip
# Second tier
MORE_CASES = {
    "bottle_check": Case("s01", 8, PALMS, (16, 37), CHECKED, on_floor=False),
    "football_pass": Case("s08", 24, PALMS, (16, 37), PASSED, on_floor=False),
    "bottle_drink": Case("s03", 5, DRUNK, (17, 36), CARRIED, on_floor=False),
    "football_check": Case("s04", 21, PALMS, (16, 37), CHECKED, on_floor=False),
    "cup_pass": Case("s10", 23, {"right_hand"}, (16, 37), PASSED, on_floor=False),
    "racquet_swing": Case("s03", 5, {"right_hand"}, (16, 37), SWUNG, **RACQUET),
    "umbrella_swing": Case("s09", 25, {"right_hand"}, (16, 37), SWUNG, **UMBRELLA),
    "bottle_regrasp": Case(
        "s08", 27, {"right_hand"}, (21, 37), ((0.0, 1.36), (2.53, 3.0)), on_floor=False
    ),
    "umbrella_turn": Case("s09", 26, {"right_hand"}, (16, 37), SWUNG, **UMBRELLA),
    "chair_sit": Case("s10", 193616834, {"seat", "back", "right_hand"}, (22, 33), ((0.0, 3.0),)),
    "toolbox_carry": Case("s02", 2, {"right_hand"}, (17, 36), CARRIED),
    "bottle_scan": Case("s03", 9208, {"right_hand"}, (13, 40), SCANNED, **TURNED),
    "chair_scan": Case("s09", 9207, PALMS, (13, 40), SCANNED, **TURNED),
    "skateboard_scan": Case("s10", 9202, PALMS, (13, 40), SCANNED, **TURNED),
    "racquet_scan": Case("s08", 9205, {"right_hand"}, (13, 40), SCANNED, **RACQUET),
}


@dataclass(frozen=True)
class Played:
    """One interaction at frames ``sets`` of a recording of 45 sets at 15 fps."""

    case: Case
    stage: StudioStage
    sets: np.ndarray
    state: StageState

    def signed_distance(self, points: np.ndarray, n: int) -> np.ndarray:
        """Signed distances of the points (N, 3) near the object at the n-th of the sets."""
        pose = self.state.stage_from_object[n]
        return near_object(self.stage, points, pose)


def near_object(stage: StudioStage, points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Signed distances of the points that are within 1 cm of the object's bounding box."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    low, high = stage.bounds
    return stage.prop.surface.signed_distance(
        local[((local > low - 0.01) & (local < high + 0.01)).all(1)]
    )


@pytest.fixture(
    scope="module",
    params=[*CASES, *(pytest.param(name, marks=pytest.mark.full) for name in MORE_CASES)],
)
def played(request: pytest.FixtureRequest) -> Played:
    case = (CASES | MORE_CASES)[request.param]
    stage = make_stage(request.param, case.subject, case.seed)
    sets = np.arange(1, stage.frames, 2)
    return Played(case, stage, sets, stage.at(stage.set_times[sets]))


def test_no_skin_and_no_cloth_is_inside_the_object(played: Played) -> None:
    for n in range(0, len(played.sets), 4):
        for surface in (played.state.body[n], played.state.clothed[n]):
            distance = played.signed_distance(surface, n)
            inside = distance[distance < 0]
            assert inside.size == 0 or -inside.mean() < 0.002


def test_the_object_does_not_enter_the_body(played: Played) -> None:
    """By more than 15 mm: a thin board fits between two vertices of the skin."""
    prop = played.stage.prop
    samples = sample_surface(prop.vertices, prop.faces, 2000).of(prop.vertices, prop.faces)
    for n in range(0, len(played.sets), 4):
        body = DistanceField(played.state.body[n], played.stage.subject.faces)
        placed = apply(played.state.stage_from_object[n], samples)
        assert -body.signed_distance(placed).min() < 0.015


def test_expected_regions_touch_all_the_time(played: Played) -> None:
    first, last = played.case.contact
    contact = region_contact(played.stage, played.state)
    touching = {r for r, on in zip(CONTACT_REGIONS, contact.T, strict=True) if on.any()}
    assert played.case.regions <= touching
    during = (played.sets >= first) & (played.sets < last)
    assert during.any() and contact[during].any(1).all()
    assert not contact[played.sets < 5].any()


def test_hands_stay_out_of_the_body(played: Played) -> None:
    """As far as flesh gives way, except for a thumb that passes the hip as the person sits down."""
    stage, faces = played.stage, played.stage.subject.faces
    part = stage.subject.weights.toarray().argmax(1)
    for elbow, wrist, first in ((18, 20, 25), (19, 21, 40)):
        hand = (part == wrist) | ((part >= first) & (part < first + 15))
        rest = faces[~(hand | (part == elbow))[faces].any(1)]
        depths = []
        for body in played.state.body[::4]:
            surface = DistanceField(body, rest, watertight=False)
            depths.append(-surface.signed_distance(body[hand]).min())
        assert max(depths) < 0.055 and np.median(depths) < 0.015


def test_planted_feet_do_not_slide_or_sink(played: Played) -> None:
    stage, state = played.stage, played.state
    ankle, _, pitch = stage.interaction.footwork.feet(stage.set_times[played.sets])
    height = stage.puppet.ankle_height
    stands = np.zeros(len(played.sets), bool)
    for side, joint in enumerate((7, 8)):
        planted = (ankle[:, side, 2] < height[side] + 1e-6) & (np.abs(pitch[:, side]) < 1e-6)
        still = (np.diff(ankle[:, side], axis=0) == 0).all(1)
        steps = np.diff(state.joints[:, joint], axis=0)[planted[:-1] & planted[1:] & still]
        assert (np.abs(steps) < 0.0005).all()
        stands |= planted
    lowest = state.body[..., 2].min(1)
    assert lowest.min() > -0.006  # a heel may dip a little as the foot rolls
    assert np.median(np.abs(lowest[stands])) < 0.002


def test_a_resting_object_does_not_move(played: Played) -> None:
    times = np.arange(0.0, 3.0, 1 / FPS)
    poses = played.stage.interaction.perform(times).script_from_object
    for start, end in played.case.rests:
        assert end - start >= 0.4
        resting = poses[(times >= start) & (times <= end)]
        assert np.abs(resting - resting[0]).max() < 1e-12
    if played.case.on_floor:
        last = poses[-1]
        assert abs((played.stage.prop.vertices @ last[2, :3]).min() + last[2, 3]) < 1e-6


def test_object_and_joints_move_without_a_jump(played: Played) -> None:
    case, stage, step = played.case, played.stage, 0.01
    performed = stage.interaction.perform(np.arange(0, 3, step))
    speed = np.linalg.norm(np.diff(performed.script_from_object[:, :3, 3], axis=0), axis=1) / step
    assert speed.max() < case.object_m_s
    joints = stage.puppet.skeleton.forward(performed.world, performed.pelvis)
    assert np.linalg.norm(np.diff(joints, axis=0), axis=-1).max() / step < case.joint_m_s
    assert np.linalg.norm(np.diff(joints, 2, axis=0), axis=-1).max() / step**2 < case.joint_m_s2


# --- the beam ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("subject", "seed"), [("s03", 9001), ("s12", 9003)])
def test_feet_stand_on_the_beam_and_pass_each_other(subject: str, seed: int) -> None:
    stage = make_stage("beam_walk", subject, seed)
    state, script = stage.at(stage.set_times), stage.interaction
    assert isinstance(script, BeamWalk)
    assert script.beam_height_m[0] <= script.height <= script.beam_height_m[1]
    (beam,) = script.furniture
    assert beam.high[1] - beam.low[1] == pytest.approx(2 * BeamWalk.beam_half_m)
    levels = support_height(stage, state)
    np.testing.assert_allclose(levels[[0, -1]], 0.0, atol=1e-6)
    np.testing.assert_allclose(levels.max(0), script.height, atol=1e-6)
    clothed, floor = stage.subject.on_fitted_topology(state.clothed), Floor(np.eye(3)[2], 0.0)
    for side, foot in enumerate(("left_foot", "right_foot")):
        carrying = support(clothed[:, stage.fitted.regions[foot]], floor, FPS, levels[:, side])
        standing, on_beam = carrying.any(1), levels[1:, side] > script.height / 2
        assert standing[on_beam].mean() > 0.3 and standing[~on_beam].mean() > 0.3
    pelvis = state.joints[:, 0, 2]
    assert pelvis[len(pelvis) // 2] - pelvis[0] == pytest.approx(script.height, abs=0.05)
    points = apply(invert(stage.stage_from_script), state.clothed)
    inside = np.minimum(points - beam.low, np.array(beam.high) - points).min(-1)
    assert inside.max() < 0.001 and points[..., 2].min() > -0.001
    joints = stage.puppet.skeleton.forward(*_performed(stage, np.arange(0, 3, 1 / 30)))
    assert np.linalg.norm(joints[:, 7] - joints[:, 8], axis=1).min() > 0.11
    assert np.linalg.norm(joints[:, 4] - joints[:, 5], axis=1).min() > 0.13
    assert np.linalg.norm(np.diff(joints, axis=0), axis=2).max() * 30 < 4.5


def _performed(stage: StudioStage, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    played = stage.interaction.perform(times)
    return played.world, played.pelvis


# --- objects that slip in the hand ---------------------------------------------------------------


@dataclass(frozen=True)
class Held:
    """A recording of 45 sets, and where the skin is on the object."""

    stage: StudioStage
    state: StageState
    local: np.ndarray
    """(T, V, 3), metres, object frame."""
    distance: np.ndarray
    """(T, V) signed distances, inf far from the object."""

    @property
    def touching(self) -> np.ndarray:
        return self.distance <= CONTACT_M

    def true_slip(self) -> np.ndarray:
        """Metres a second (T,) by the metric, for a fit that sticks where it touches."""

        def normals_at(points: np.ndarray) -> np.ndarray:
            return self.stage.prop.surface.closest(points).normals

        fitted = np.zeros_like(self.local)  # does not move over the fitted object
        return slip_speed(fitted, self.local, self.touching, normals_at, FPS)


@pytest.fixture(scope="module", params=["racquet_glide", "bottle_regrasp"])
def held(request: pytest.FixtureRequest) -> Held:
    case = (CASES | MORE_CASES)[request.param]
    stage = make_stage(request.param, case.subject, case.seed)
    state = stage.at(stage.set_times)
    local = (state.body - state.stage_from_object[:, None, :3, 3]) @ state.stage_from_object[
        :, :3, :3
    ]
    distance = np.full(local.shape[:2], np.inf)
    low, high = stage.bounds
    near = ((local > low - 0.02) & (local < high + 0.02)).all(2)
    distance[near] = stage.prop.surface.signed_distance(local[near])
    return Held(stage, state, local, distance)


def test_true_slip_has_the_scripted_speed(held: Held) -> None:
    script = held.stage.interaction
    slide = script.slide(held.stage.set_times)
    if not isinstance(script, GlidingSwing):
        pytest.skip("the hand lets go")
    moved = slide[:, 2, 3]
    assert moved.max() == pytest.approx(script.glide_m)
    slip, window = held.true_slip(), round(SLIP_S * FPS)
    intended = np.abs(moved[window:] - moved[:-window]) * FPS / window
    for start, end in (script.glide_s[:2], script.glide_s[2:]):
        part = _sets_within(start, end)
        assert intended[part].max() > 0.02
        np.testing.assert_allclose(slip[part], intended[part], rtol=0.15, atol=0.005)
    assert np.nanmax(slip[_sets_within(2.05, 2.50)]) < 0.005


def _sets_within(start: float, end: float) -> slice:
    """Sets whose whole window of the metric is in these script times."""
    return slice(int(np.ceil(start * FPS)), int((end - SLIP_S) * FPS) + 1)


def test_skin_that_slips_stays_on_the_surface(held: Held) -> None:
    patch = held.touching.sum(1)
    holds = np.flatnonzero(patch)
    assert held.distance[holds].min() > -0.002
    assert np.median(patch[holds]) > 30
    if not isinstance(held.stage.interaction, Regrasp):
        hold = patch[int(np.ceil(1.0 * FPS)) : int(2.5 * FPS)]
        assert hold.min() > 0.5 * np.median(hold)


def test_a_regrasp_releases_and_moves_the_hand(held: Held) -> None:
    stage, script = held.stage, held.stage.interaction
    if not isinstance(script, Regrasp):
        pytest.skip("no regrasp")
    right = region_contact(stage, held.state).any(1)
    opens, off, back, closed = script.regrasp_s
    times = stage.set_times
    assert right[(times > 0.97) & (times < opens)].all()
    assert not right[(times > off) & (times < back)].any()
    assert right[(times > closed) & (times < 2.45)].all()
    poses = held.state.stage_from_object
    assert np.abs(poses[times <= closed] - poses[0]).max() < 1e-12
    first = np.flatnonzero((times > 0.97) & (times < opens))[0]
    later = np.flatnonzero(times > closed + 0.1)[0]
    both = held.touching[first] & held.touching[later]
    assert both.any()
    assert np.linalg.norm(held.local[later, both] - held.local[first, both], axis=1).min() > 0.015
