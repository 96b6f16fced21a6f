"""The hidden Markov model against all sequences by hand, and on worked cases."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.decoder import (
    FREE_COST_S,
    HELD_M_S,
    HELD_RAD_S,
    HIDDEN,
    JUMP_COST,
    MODE_CHANGES_S,
    VANISH_COST,
    MarkovModel,
    mode_log_ratios,
    step_log_ratios,
)
from intercap_core.object_track.evidence import ERROR_LASTING_S
from intercap_core.object_track.motion import HandMotion
from intercap_core.object_track.tracker import ABSENT_LOG_RATIO
from intercap_core.object_track.turns import SAME_POSE_M, SAME_POSE_RAD
from tests.geometry.rigid.conftest import catalogue

NO_HAND = [None, None]


@pytest.fixture(scope="module")
def cup() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["cup"])


def poses_of(places: list[float], degrees: float = 0.0) -> np.ndarray:
    """Poses (N, 4, 4) along x, turned about z."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return np.array([rigid(turn, np.array([x, 0, 0])) for x in places])


@pytest.mark.parametrize("counts", [[2, 0, 3, 1], [2], [0, 0, 0]])
@pytest.mark.parametrize("modes", [1, 2])
def test_it_equals_the_sum_over_all_sequences(modes: int, counts: list[int]) -> None:
    """States of a frame: each hypothesis in each mode, hidden, gone."""
    rng = np.random.default_rng(4)
    emissions = [rng.normal(size=n) for n in counts]
    steps = [rng.normal(size=(modes, modes, a + 1, b + 1)) for a, b in pairwise(counts)]
    found = MarkovModel(emissions, steps, 0.3).decode()
    states = [[*product(range(n), range(modes)), ("hidden", 0), ("gone", 0)] for n in counts]

    def emission(t: int, k: int | str) -> float:
        return emissions[t][k] if isinstance(k, int) else {"hidden": 0.0, "gone": 0.3}[k]

    def step_of(t: int, before: tuple, after: tuple) -> float:
        if before[0] == after[0] == "gone":
            return 0.0
        at = [k if isinstance(k, int) else -1 for k, _ in (before, after)]
        between = (before[1], after[1]) if min(at) >= 0 else (0, 0)
        log = steps[t][(*between, *at)] - VANISH_COST * ("gone" in (before[0], after[0]))
        return log - np.log(modes) * (at[1] >= 0 > at[0])

    likely = {}
    for sequence in product(*states):
        log = sum(emission(t, k) for t, (k, _) in enumerate(sequence))
        log -= VANISH_COST * sum(sequence[t][0] == "gone" for t in (0, -1))
        log -= np.log(modes) * (not isinstance(sequence[0][0], str))
        log += sum(step_of(t, *pair) for t, pair in enumerate(pairwise(sequence)))
        likely[sequence] = log
    total = np.logaddexp.reduce(list(likely.values()))
    assert found.evidence == pytest.approx(total)
    best = max(likely, key=likely.__getitem__)
    assert found.path.tolist() == [k if isinstance(k, int) else HIDDEN for k, _ in best]
    for t, n in enumerate(counts):
        share = {k: 0.0 for k in (*range(n), "hidden", "gone")}
        for sequence, log in likely.items():
            share[sequence[t][0]] += np.exp(log - total)
        expected = [*(share[k] for k in range(n)), share["hidden"] + share["gone"]]
        assert found.probability[t] == pytest.approx(expected, rel=1e-9)
        assert found.gone[t] == pytest.approx(share["gone"], rel=1e-9)


def test_only_a_lasting_preference_pays_for_a_jump(cup: ObjectMesh) -> None:
    """Two poses half a turn apart; the images prefer the second from frame 6 on."""
    both = np.concatenate([poses_of([0.0]), poses_of([0.0], 180)])
    steps = [step_log_ratios(cup, both, both, 1 / 15, NO_HAND)] * 9

    def path(gain: float) -> list[int]:
        emissions = [np.array([5.0, 5.0 - gain])] * 6 + [np.array([5.0, 5.0 + gain])] * 4
        return MarkovModel(emissions, steps).decode().path.tolist()

    assert path(1.0) == [0] * 10
    assert path(5.0) == [0] * 6 + [1] * 4


def test_each_mode_of_motion_has_its_cost(cup: ObjectMesh) -> None:
    here, there = poses_of([0.0]), poses_of([0.0, 0.02, 1.0])
    every = step_log_ratios(cup, here, there, 1 / 15, NO_HAND)
    rest, free, right, left = np.diagonal(every)[0, :-1].T  # in the mode of the step before
    change = 1 - np.exp(-MODE_CHANGES_S / 15)
    stays = -np.log(1 + change)  # of two that are possible
    assert rest[:2] == pytest.approx([stays, stays - 0.5 * (0.02 / SAME_POSE_M) ** 2])
    assert rest[2] < -1000
    assert free[0] == pytest.approx(stays - FREE_COST_S / 15)
    assert free[2] == pytest.approx(stays - JUMP_COST - FREE_COST_S / 15)  # any, at some cost
    assert mode_log_ratios(cup, here, there, 1 / 15, [], 0.0)[1, 0, 2] == pytest.approx(-JUMP_COST)
    assert (right == -np.inf).all() and (left == -np.inf).all()
    assert every[0, 1, 0, 0] == pytest.approx(free[0] + np.log(change))
    hand = HandMotion(np.eye(3), np.array([0.1, 0, 0]), np.array([1.1, 0, 0]))
    carried = step_log_ratios(cup, here, there, 1 / 15, [None, hand])
    assert (carried[:, 2, 0, :-1] == -np.inf).all()
    assert carried[3, 3, 0, 2] == pytest.approx(-np.log(1 + 2 * change))
    assert carried[3, 3, 0, 0] < -10
    away = HandMotion(np.eye(3), np.array([0.6, 0, 0]), np.array([1.6, 0, 0]))
    assert (
        step_log_ratios(cup, here, there, 1 / 15, [None, away])[:, 3, :-1, :-1] == -np.inf
    ).all()


@pytest.mark.parametrize("fps", [5, 30])
def test_more_modes_do_not_raise_the_evidence(cup: ObjectMesh, fps: int) -> None:
    """An object at rest near hands that do not move may be in a hand as well."""
    still = HandMotion(np.eye(3), np.array([0.1, 0, 0]), np.array([0.1, 0, 0]))
    here, count = poses_of([0.0]), 3 * fps
    steps = [step_log_ratios(cup, here, here, 1 / fps, [still] * hands) for hands in range(3)]
    emissions = [np.zeros(1)] * (count + 1)
    none, *some = (MarkovModel(emissions, [s] * count).decode().evidence for s in steps)
    assert some == pytest.approx([none] * 2, abs=0.1)


@pytest.mark.parametrize("fps", [1, 5, 30])
@pytest.mark.parametrize("gap_s", [0.0, 0.5, 3.0])
def test_an_object_moved_across_a_gap_is_the_same(cup: ObjectMesh, fps: int, gap_s: float) -> None:
    """Evidence of 30 nats per independent frame; half a metre away after the gap."""
    places = [0.0] * 6 + [0.5] * 6
    seconds = [1 / fps] * 11
    seconds[5] += gap_s
    poses = [poses_of([x]) for x in places]
    steps = [
        step_log_ratios(cup, a, b, gap, [])
        for (a, b), gap in zip(pairwise(poses), seconds, strict=True)
    ]
    share = min(1.0, 1 / fps / ERROR_LASTING_S)
    found = MarkovModel([np.array([30.0 * share])] * 12, steps, share * ABSENT_LOG_RATIO).decode()
    assert found.path.tolist() == [0] * 12


def test_a_turning_hand_carries_it_through_hidden_frames(cup: ObjectMesh) -> None:
    """Nothing is seen for 8 frames while the palm turns by 70 degrees. Afterwards the pose turned
    with the palm and the old pose look alike."""
    turns = [*[0.0] * 3, *np.linspace(0, 70, 10)[1:], *[70.0] * 3]
    wrist = np.array([0.06, 0.0, 0.0])
    hypotheses, steps = [], []
    for angle in turns:
        turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()
        hypotheses.append(np.array([rigid(turn, wrist - turn @ wrist), np.eye(4)]))
    hypotheses = [both[:1] if t < 3 else both for t, both in enumerate(hypotheses)]
    for t, (a, b) in enumerate(pairwise(hypotheses)):
        turn = Rotation.from_euler("z", turns[t + 1] - turns[t], degrees=True).as_matrix()
        steps.append(step_log_ratios(cup, a, b, 1 / 15, [HandMotion(turn, wrist, wrist), None]))
    seen = [4.0 if t < 3 or t > 11 else 0.0 for t in range(len(turns))]
    emissions = [np.full(len(own), nats) for own, nats in zip(hypotheses, seen, strict=True)]
    emissions[12][1] += 1.0  # a little for the wrong one
    resting = MarkovModel(emissions, steps).decode().probability[-1]
    for step in steps[2:12]:  # and it is lifted: it does not stand
        step[:, 0] = -np.inf
        step[0, 0, :, -1], step[0, 0, -1] = -7.0, -7.0
    found = MarkovModel(emissions, steps).decode()
    assert found.path.tolist() == [0] * len(turns)
    assert found.probability[-1][0] > 0.8 > resting[0]


def test_a_held_object_turns_about_the_wrist(cup: ObjectMesh) -> None:
    turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    wrist, end = np.array([0.1, 0.0, 0.0]), np.array([0.15, 0.02, 0.0])
    before = poses_of([0.0])
    after = np.concatenate([rigid(turn, end - turn @ wrist)[None], before])
    every = step_log_ratios(cup, before, after, 1 / 15, [HandMotion(turn, wrist, end), None])
    in_hand = every[2, 2, 0, :-1] + np.log(1 + 2 * (1 - np.exp(-MODE_CHANGES_S / 15)))
    assert in_hand[0] == pytest.approx(0, abs=1e-9)
    # what stays behind is off by the turn, and by the shift as far as the turn is known
    sigma = np.hypot(SAME_POSE_RAD, HELD_RAD_S / 15)
    arm = np.linalg.norm(cup.centre_at(before[0]) - wrist)
    moved = np.linalg.norm(cup.centre_at(after[0]) - cup.centre_at(before[0]))
    shift = moved / np.sqrt(SAME_POSE_M**2 + (HELD_M_S / 15) ** 2 + (arm * sigma) ** 2)
    assert in_hand[1] == pytest.approx(-0.5 * ((np.radians(40) / sigma) ** 2 + shift**2))


def test_it_is_hidden_for_a_second_and_gone_after_five(cup: ObjectMesh) -> None:
    here = poses_of([0.0])

    def gone_after(seconds: float) -> float:
        unseen = round(15 * seconds)
        poses = [here] * 9 + [here[:0]] * unseen + [here] * 9
        emissions = [np.full(len(own), 4.0) for own in poses]
        steps = [step_log_ratios(cup, a, b, 1 / 15, NO_HAND) for a, b in pairwise(poses)]
        found = MarkovModel(emissions, steps, ABSENT_LOG_RATIO * 1 / 15 / ERROR_LASTING_S).decode()
        assert (found.path[9:-9] == HIDDEN).all() and (found.path[:9] == 0).all()
        return float(found.gone[9 + unseen // 2])

    assert gone_after(1.0) < 0.2 and gone_after(5.0) > 0.9


def test_turns_of_a_symmetry_are_no_motion() -> None:
    bottle = ObjectMesh.load(catalogue()["bottle"])
    spun = step_log_ratios(bottle, poses_of([0.0]), poses_of([0.0], 120), 1 / 15, NO_HAND)
    assert spun[0, 0, 0, 0] == pytest.approx(-np.log(2 - np.exp(-MODE_CHANGES_S / 15)))
