"""Smoothing and rests on synthetic evidence."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import apply_step, rigid
from intercap_core.object_track.evidence import ERROR_LASTING_S, FrameEvidence
from intercap_core.object_track.rest import find_rests
from intercap_core.object_track.smooth import smooth

SIGMA = np.repeat([np.radians(1.0), 0.003], 3)
CENTRE = np.array([0.02, -0.01, 0.05])
FPS = 15.0
SHARE = 1 / FPS / ERROR_LASTING_S  # independent observations per frame


def evidence_at(poses: np.ndarray, sigma: np.ndarray = SIGMA, seed: int = 0) -> FrameEvidence:
    """Independent evidence on poses (T, 4, 4), evaluated near the truth."""
    rng = np.random.default_rng(seed)
    information = np.tile(np.diag(sigma**-2.0), (len(poses), 1, 1))
    offset = rng.normal(size=(len(poses), 6)) * SIGMA
    noise = rng.normal(size=(len(poses), 6)) * sigma
    # the minimum lies at the truth + noise, seen from a pose nearby
    gradient = np.einsum("tij,tj->ti", information, offset - noise)
    return FrameEvidence(apply_step(poses, offset), information, gradient)


def lifted(count: int, starts: int, stops: int) -> np.ndarray:
    """Poses (T, 4, 4) at rest until a smooth lift of 40 cm and 60 degrees, then at rest again."""
    done = np.clip((np.arange(count) - starts) / (stops - starts), 0, 1)
    done = done**2 * (3 - 2 * done)
    turn = Rotation.from_rotvec(np.radians(60) * np.outer(done, [0, 0.6, 0.8]))
    return rigid(turn.as_matrix(), np.array([0.3, 0.1, 2.0]) - np.outer(done, [0, 0.4, 0]))


def shift(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distance (T,) of the object's centre from the truth, metres."""
    offset = (found[:, :3, :3] - true[:, :3, :3]) @ CENTRE + found[:, :3, 3] - true[:, :3, 3]
    return np.linalg.norm(offset, axis=1)


def test_smoothing_reduces_errors_within_its_covariance() -> None:
    true = lifted(60, 5, 55)
    times = np.arange(60) / 30.0
    evidence = evidence_at(true)
    found, covariance = smooth(evidence, evidence.poses, np.arange(60), times, CENTRE)
    alone = apply_step(evidence.poses, evidence.own)
    assert shift(found, true).mean() < 0.7 * shift(alone, true).mean()
    error = found[:, :3, 3] - true[:, :3, 3]
    solved = np.linalg.solve(covariance[:, 3:, 3:], error[..., None])[..., 0]
    assert 0.6 < np.einsum("ti,ti->t", error, solved).mean() / 3 < 1.7


def test_frames_without_evidence_are_bridged() -> None:
    true = lifted(45, 5, 40)
    evidence = evidence_at(true)
    evidence.information[20:24], evidence.gradient[20:24] = 0, 0
    evidence.poses[20:24] = evidence.poses[19]
    start = evidence.poses.copy()
    found, covariance = smooth(evidence, start, np.arange(45), np.arange(45) / FPS, CENTRE)
    assert shift(found, true)[20:24].max() < 0.03
    sigma = np.sqrt(covariance[:, 3, 3])
    assert sigma[21:23].min() > 3 * sigma[10]


def test_a_wrong_frame_does_not_move_its_neighbours() -> None:
    true = lifted(45, 5, 40)
    evidence = evidence_at(true)
    evidence.poses[20, :3, 3] += 0.15
    found, _ = smooth(evidence, evidence.poses, np.arange(45), np.arange(45) / FPS, CENTRE)
    assert shift(found, true).max() < 0.03


@pytest.mark.parametrize("leap", [0.25, 0.6])
def test_a_false_leap_does_not_move_sure_frames(leap: float) -> None:
    true = np.tile(np.eye(4), (20, 1, 1))
    true[:, 2, 3] = 2.0
    true[8:12, 0, 3] = leap  # wrong, then a frame that saw nothing, then right
    evidence = evidence_at(true)
    evidence.information[11], evidence.gradient[11] = 0, 0
    start = evidence.poses.copy()
    start[11, 0, 3] = leap / 2
    found, _ = smooth(evidence, start, np.arange(20), np.arange(20) / FPS, CENTRE)
    assert np.delete(shift(found, true), 11).max() < 0.02


@pytest.mark.parametrize("count", [1, 2, 3])
def test_short_recordings_are_smoothed(count: int) -> None:
    true = lifted(10, 8, 9)[:count]
    evidence = evidence_at(true)
    times = np.arange(count) / FPS
    segment = find_rests(evidence, SHARE, CENTRE)
    found, covariance = smooth(evidence, evidence.poses, np.arange(count), times, CENTRE)
    assert segment.shape == (count,)
    assert shift(found, true).max() < 0.015
    assert np.isfinite(covariance).all()


@pytest.mark.parametrize(("fps", "seed"), [(15.0, 0), (30.0, 1)])
def test_rests_end_with_the_motion(fps: float, seed: int) -> None:
    starts, stops, count = round(1.3 * fps), round(2.2 * fps), round(3.5 * fps)
    true = lifted(count, starts, stops)
    evidence = evidence_at(true, seed=seed)
    segment = find_rests(evidence, 1 / fps / ERROR_LASTING_S, CENTRE)
    assert segment.max() == 1
    away = shift(true, np.tile(true[:1], (count, 1, 1)))
    first = np.flatnonzero(segment == 0)
    assert first[0] == 0 and first[-1] >= starts - 3
    assert away[first].max() < 0.010  # in motion before it is a centimetre away
    second = np.flatnonzero(segment == 1)
    assert second[-1] == count - 1 and second[0] <= stops + 3
    to_go = shift(true, np.tile(true[-1:], (count, 1, 1)))
    assert (segment[(away > 0.01) & (to_go > 0.01)] == -1).all()


def test_lasting_errors_are_no_motion() -> None:
    rng = np.random.default_rng(2)
    true = lifted(60, 58, 59)[:55]
    evidence = evidence_at(true)
    # masks wrong by about one standard deviation for half a second at a time
    wrong = np.repeat(rng.normal(size=(11, 6)) * SIGMA, 5, axis=0)
    evidence.gradient[:] -= np.einsum("tij,tj->ti", evidence.information, wrong)
    segment = find_rests(evidence, SHARE, CENTRE)
    assert (segment == 0).all()
    found, covariance = smooth(
        evidence, evidence.poses, np.zeros(55, int), np.arange(55) / FPS, CENTRE
    )
    assert (found == found[0]).all()
    assert shift(found, true)[0] < 0.003
    # what lasts does not average out, so a long rest is no surer than a look
    assert np.sqrt(covariance[0, 3, 3]) > 0.8 * SIGMA[3]


def test_slow_motion_is_no_rest() -> None:
    true = lifted(45, 0, 44)
    true[:, 1, 3] = 0.1 + 0.05 * np.arange(45) / FPS  # five centimetres a second
    segment = find_rests(evidence_at(true), SHARE, CENTRE)
    assert (segment == -1).all()


@pytest.mark.parametrize("width", [1, 2])
def test_wrong_frames_do_not_end_a_rest(width: int) -> None:
    true = lifted(40, 38, 39)[:30]
    evidence = evidence_at(true)
    evidence.poses[12 : 12 + width, :3, 3] += [0.1, 0.0, 0.02]
    segment = find_rests(evidence, SHARE, CENTRE)
    assert (segment == 0).all()


def test_a_long_rest_is_one_segment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("intercap_core.object_track.rest.MAX_REST_FRAMES", 20)
    true = lifted(60, 58, 59)[:55]
    assert (find_rests(evidence_at(true), SHARE, CENTRE) == 0).all()


@pytest.mark.parametrize("at_end", [False, True])
def test_rests_cut_by_the_recording_are_found(at_end: bool) -> None:
    found = []
    for still in range(2, 12):
        true = lifted(still + 20, 0, still)
        true[still:, 1, 3] = 0.1 + 0.06 * np.arange(1, 21)  # then it is taken away, at 0.9 m/s
        true[:still] = true[still - 1]
        true[:still, 1, 3] = 0.1
        if at_end:
            true = true[::-1].copy()
        segment = find_rests(evidence_at(true), SHARE, CENTRE)
        rests = segment[::-1][:still] if at_end else segment[:still]
        found.append(int((rests >= 0).sum()))
    assert (np.diff(found) >= 0).all(), "longer rests are found as longer"
    assert found[-1] >= 10


def test_a_stated_pose_determines_an_unseen_rest() -> None:
    """Of a rest of 30 frames one is stated, and what follows is seen half a metre away."""
    true = np.tile(np.eye(4), (45, 1, 1))
    true[36:, 0, 3] = 0.5
    evidence = evidence_at(true)
    information = evidence.information.copy()
    information[:36] = 0
    gradient = np.where(information.any((1, 2))[:, None], evidence.gradient, 0.0)
    stated = np.zeros((45, 6, 6))
    stated[20] = np.diag(np.repeat([np.radians(5), 0.01], 3) ** -2.0)
    node = np.concatenate([np.zeros(30, int), np.arange(1, 7), np.full(9, 7)])
    start = true.copy()
    start[30:36, 0, 3] = np.linspace(0.07, 0.43, 6)
    seen = FrameEvidence(np.where((np.arange(45) < 36)[:, None, None], true, evidence.poses),
                         information, gradient)  # fmt: skip
    given = FrameEvidence(true, stated, np.zeros((45, 6)))
    found, _ = smooth(seen, start, node, np.arange(45) / FPS, CENTRE, given)
    assert shift(found, true)[:30].max() < 0.02
    assert shift(found, true)[36:].max() < 0.02
    without, _ = smooth(seen, start, node, np.arange(45) / FPS, CENTRE)
    assert shift(without, true)[:30].max() > 0.1
