"""Which hypothesis is true in every frame: a hidden Markov model over all frames.

The states of a frame are its hypotheses, each under every mode of motion (:mod:`.steps`), and,
last, that none of them is true: the object is hidden, or it has left. Probabilities come from the
forward-backward algorithm, the most likely sequence from that of Viterbi (Rabiner, Proceedings of
the IEEE 77(2), 1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from intercap_core.object_track.constants import LEAVE_COST

NOT_SEEN = -1
_CERTAIN = 1e4  # nats: far more than all frames say
_NEVER = -600.0  # nats: the least that a frame says, of which the exponential is still a number


@dataclass(frozen=True)
class Decoded:
    """``path`` (T,) the index of the most likely hypothesis, :data:`NOT_SEEN` where none is true;
    ``probability`` [T] of each hypothesis and, last, of none, given all frames; ``gone`` (T,), of
    the object having left; ``evidence``, the log-likelihood of all frames, against that it is in
    none."""

    path: np.ndarray
    probability: list[np.ndarray]
    gone: np.ndarray
    evidence: float


def decode(
    emissions: Sequence[np.ndarray], steps: Sequence[np.ndarray], absent: float = 0.0
) -> Decoded:
    """The model's states of T frames.

    ``emissions`` [T] (K_t,) log-likelihoods of the hypotheses, against that none is true; ``steps``
    [T - 1] (M, M, K_t + 1, K_t+1 + 1) log-probabilities of going in one mode of motion, and another
    from then on, from one of them, or none, to the next; none is in no mode, and those of the first
    count for it. Where none is true the object is hidden, or it has left, which costs more at
    either end and ``absent`` nats a frame less: what is in the room is seldom hidden from all
    cameras for long.
    """
    modes = len(steps[0]) if steps else 1
    values = [np.append(np.repeat(own, modes), [0.0, absent]) for own in emissions]
    values[0][:-2] -= np.log(modes)
    for end in (0, -1):
        values[end][-1] -= LEAVE_COST
    ways = [_ways(step) for step in steps]
    path = np.array(_likeliest(values, ways)) // modes
    path[path >= [len(own) for own in emissions]] = NOT_SEEN
    shares, evidence = _shares(values, ways)
    return Decoded(
        path,
        [np.append(own[:-2].reshape(-1, modes).sum(1), own[-2] + own[-1]) for own in shares],
        np.array([own[-1] for own in shares]),
        evidence,
    )


def _ways(step: np.ndarray) -> np.ndarray:
    """Log-probabilities (K * M + 2, L * M + 2) of going from each state to the next, hypothesis by
    hypothesis and in it mode by mode; then hidden and gone."""
    modes, count, following = len(step), step.shape[2] - 1, step.shape[3] - 1
    ways = np.empty((count * modes + 2, following * modes + 2))
    between = step[:, :, :-1, :-1].transpose(2, 0, 3, 1)
    ways[:-2, :-2] = between.reshape(count * modes, following * modes)
    ways[:-2, -2] = np.repeat(step[0, 0, :-1, -1], modes)
    ways[-2, :-2] = np.repeat(step[0, 0, -1, :-1], modes) - np.log(modes)
    ways[-2, -2] = step[0, 0, -1, -1]
    ways[:-1, -1] = ways[:-1, -2] - LEAVE_COST
    ways[-1, :-1] = ways[-2, :-1] - LEAVE_COST
    ways[-1, -1] = 0.0
    return ways


def _likeliest(values: Sequence[np.ndarray], ways: Sequence[np.ndarray]) -> list[int]:
    """The states [T] of the most likely sequence."""
    best, came = values[0], []
    for way, value in zip(ways, values[1:], strict=True):
        reach = best[:, None] + way
        came.append(reach.argmax(0))
        best = reach.max(0) + value
    chosen = [int(best.argmax())]
    for back in reversed(came):
        chosen.append(int(back[chosen[-1]]))
    return chosen[::-1]


def _shares(
    values: Sequence[np.ndarray], ways: Sequence[np.ndarray]
) -> tuple[list[np.ndarray], float]:
    """The probability of each state [T], and the log-likelihood of all frames."""
    moves = [np.exp(way) for way in ways]
    seen = [np.exp(np.maximum(value - value.max(), _NEVER)) for value in values]
    evidence = float(sum(value.max() for value in values))
    ahead: list[np.ndarray] = []
    for t, own in enumerate(seen):
        now = own if t == 0 else (ahead[-1] @ moves[t - 1]) * own
        evidence += float(np.log(now.sum()))
        ahead.append(now / now.sum())
    behind = [np.ones(len(seen[-1]))]
    for move, own in zip(reversed(moves), reversed(seen[1:]), strict=True):
        before = move @ (behind[-1] * own)
        behind.append(before / before.max())
    both = [a * b for a, b in zip(ahead, reversed(behind), strict=True)]
    return [one / one.sum() for one in both], evidence


def given(
    emissions: Sequence[np.ndarray],
    steps: Sequence[np.ndarray],
    frame: int,
    state: int,
    absent: float = 0.0,
) -> Decoded:
    """:func:`decode`, given the state of one frame: one of its hypotheses."""
    known = list(emissions)
    known[frame] = np.full(len(known[frame]), -_CERTAIN)
    known[frame][state] = emissions[frame][state] + _CERTAIN
    found = decode(known, steps, absent)
    return replace(found, evidence=found.evidence - _CERTAIN)


def mixed(found: Sequence[Decoded]) -> Decoded:
    """What follows from several that exclude each other, by their evidence."""
    evidence = np.array([one.evidence for one in found])
    share = np.exp(evidence - logsumexp(evidence))
    probability = [
        np.einsum("n,nk->k", share, np.array(every))
        for every in zip(*(one.probability for one in found), strict=True)
    ]
    gone = share @ np.array([one.gone for one in found])
    path = found[int(share.argmax())].path
    return Decoded(path, probability, gone, float(logsumexp(evidence)))
