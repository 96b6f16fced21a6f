"""The decision over all frames: against all sequences by hand, and on worked cases."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.object_track.constants import (
    ABSENT_LOG_RATIO,
    ERROR_LASTING_S,
    EXCURSION_COST,
    JUMP_COST,
    LEAVE_COST,
)
from intercap_core.object_track.decoder import (
    NOT_SEEN,
    decode,
    excursions,
    step_costs,
    with_excursions,
)
from intercap_core.rigid.mesh import ObjectMesh
from tests.rigid.conftest import catalogue

NO_HAND = np.zeros((0, 3))


@pytest.fixture(scope="module")
def cup() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["cup"])


def poses_of(places: list[float], degrees: float = 0.0) -> np.ndarray:
    """Poses (N, 4, 4) along x, turned about z."""
    found = np.tile(np.eye(4), (len(places), 1, 1))
    found[:, 0, 3] = places
    found[:, :3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return found


def test_it_is_the_sum_over_all_sequences() -> None:
    rng = np.random.default_rng(4)
    counts = [2, 0, 3, 1]
    emissions = [rng.normal(size=n) for n in counts]
    steps = [rng.normal(size=(a + 1, b + 1)) for a, b in pairwise(counts)]
    found = decode(emissions, steps, 0.3)
    values = [np.append(own, [0.0, 0.3]) for own in emissions]  # hypotheses, hidden, gone
    likely, shares = {}, [np.zeros(n + 2) for n in counts]
    for states in product(*(range(n + 2) for n in counts)):
        log = sum(values[t][s] for t, s in enumerate(states))
        log -= LEAVE_COST * sum(states[t] == counts[t] + 1 for t in (0, -1))
        for t, step in enumerate(steps):
            gone = [states[u] == counts[u] + 1 for u in (t, t + 1)]
            if not all(gone):
                log += step[min(states[t], counts[t]), min(states[t + 1], counts[t + 1])]
                log -= LEAVE_COST * any(gone)
        likely[states] = log
        for t, s in enumerate(states):
            shares[t][s] += np.exp(log)
    best = max(likely, key=lambda states: likely[states])
    expected = [NOT_SEEN if s >= n else s for s, n in zip(best, counts, strict=True)]
    assert found.path.tolist() == expected
    for t, share in enumerate(shares):
        own = share / share.sum()
        np.testing.assert_allclose(found.probability[t][:-1], own[:-2], rtol=1e-10)
        np.testing.assert_allclose(found.probability[t][-1], own[-2:].sum(), rtol=1e-10)
        np.testing.assert_allclose(found.gone[t], own[-1], rtol=1e-10)
    total = sum(np.exp(log) for log in likely.values())
    assert found.evidence == pytest.approx(np.log(total))


def test_one_frame_alone_and_no_hypothesis_at_all() -> None:
    found = decode([np.array([2.0, 1.0])], [])
    assert found.path.tolist() == [0]
    weights = np.array([np.exp(2), np.exp(1), 1 + np.exp(-2 * LEAVE_COST)])
    assert found.probability[0] == pytest.approx(weights / weights.sum())
    nothing = decode([np.zeros(0)] * 3, [np.zeros((1, 1))] * 2)
    assert (nothing.path == NOT_SEEN).all()
    assert all(p == pytest.approx([1.0], abs=1e-12) for p in nothing.probability)


def test_a_weak_preference_does_not_pay_for_a_jump_and_a_lasting_one_does(cup: ObjectMesh) -> None:
    """Two poses half a turn apart; the images prefer the second from frame 5 on."""
    both = np.concatenate([poses_of([0.0]), poses_of([0.0], 180)])
    steps = [step_costs(cup, both, both, 1 / 15, NO_HAND)] * 9

    def path(gain: float) -> list[int]:
        emissions = [np.array([5.0, 2.0])] * 5 + [np.array([5.0, 5.0 + gain])] * 5
        return decode(emissions, steps).path.tolist()

    assert path(1.0) == [0] * 10
    assert path(3.0) == [0] * 5 + [1] * 5


def test_a_hand_carries_it_and_nothing_else_moves_so_far(cup: ObjectMesh) -> None:
    here, there = poses_of([0.0]), poses_of([0.0, 0.02, 1.0])
    costs = step_costs(cup, here, there, 1 / 15, NO_HAND)[0]
    assert costs[0] == 0 and -0.1 < costs[1] < 0 and costs[2] == -JUMP_COST
    carried = step_costs(cup, here, there, 1 / 15, np.array([[1.0, 0.0, 0.0]]))[0]
    assert carried[0] == 0 and carried[2] == pytest.approx(0)


def test_what_is_not_seen_for_a_second_is_hidden_and_for_long_has_left(cup: ObjectMesh) -> None:
    here = poses_of([0.0])

    def after(seconds: float) -> tuple[list[int], float]:
        unseen = round(15 * seconds)
        poses = [here] * 9 + [here[:0]] * unseen + [here] * 9
        emissions = [np.full(len(own), 4.0) for own in poses]
        steps = [step_costs(cup, a, b, 1 / 15, NO_HAND) for a, b in pairwise(poses)]
        found = decode(emissions, steps, ABSENT_LOG_RATIO * 1 / 15 / ERROR_LASTING_S)
        assert (found.path[9:-9] == NOT_SEEN).all() and (found.path[:9] == 0).all()
        return found.path.tolist(), float(found.gone[9 + unseen // 2])

    assert after(1.0)[1] < 0.2
    assert after(5.0)[1] > 0.9


def test_what_a_symmetry_hides_is_no_motion() -> None:
    bottle = ObjectMesh.load(catalogue()["bottle"])
    spun = step_costs(bottle, poses_of([0.0]), poses_of([0.0], 120), 1 / 15, NO_HAND)
    assert spun[0, 0] == pytest.approx(0, abs=1e-9)


def test_equal_evidence_is_even_odds(cup: ObjectMesh) -> None:
    """Handle left or right, nothing decides: the probabilities say so in every frame."""
    both = np.concatenate([poses_of([0.0], 60), poses_of([0.0], -60)])
    steps = [step_costs(cup, both, both, 1 / 15, NO_HAND)] * 7
    found = decode([np.array([6.0, 6.0])] * 8, steps)
    for own in found.probability:
        assert own[:2] == pytest.approx([0.5, 0.5], abs=1e-2)


def test_what_cannot_be_reached_between_sure_frames_costs_twice() -> None:
    """At rest, hidden for three frames in which clutter two metres away looks a little like it."""
    there, clutter = np.zeros((1, 3)), np.array([[2.0, 0.0, 0.0]])
    centres = [there, clutter, np.concatenate([there, clutter]), clutter, there]
    times = np.arange(5) / 15
    sure = np.array([True, False, False, False, True])
    away = excursions(centres, np.array([0, 0, 0, 0, 0]), sure, times)
    assert [own.tolist() for own in away] == [[False], [True], [False, True], [True], [False]]
    steps = with_excursions(
        [np.zeros((len(a) + 1, len(b) + 1)) for a, b in pairwise(centres)], away
    )
    assert steps[0].tolist() == [[-EXCURSION_COST, 0], [-EXCURSION_COST, 0]]
    assert steps[1].tolist() == [[-EXCURSION_COST, 0, -EXCURSION_COST], [0, -EXCURSION_COST, 0]]
    far = [*centres[:4], clutter]  # sure frames that contradict each other say nothing
    assert not any(own.any() for own in excursions(far, np.zeros(5, int), sure, times))
