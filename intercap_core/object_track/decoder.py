"""Decision between the hypotheses of all frames by a hidden Markov model.

The states of a frame are its hypotheses, each in every mode of motion (at rest, free, in a hand).
Two more states have no hypothesis: the object is hidden, or it has left. Modes seldom change. The
most likely step of a mode has log-probability 0 whatever its standard deviation, because the states
are a few hypotheses and not a density.

Probabilities come from the forward-backward algorithm, the most likely sequence from the Viterbi
algorithm (Rabiner, Proceedings of the IEEE 77(2), 1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.motion import HandMotion
from intercap_core.object_track.turns import SAME_POSE_M, SAME_POSE_RAD

# Standard deviations of the motion of an object in a hand.
HELD_M_S = 0.3  # speed of slipping, m/s; tuned
HELD_RAD_S = 1.0  # the same of turns, rad/s; tuned
# Costs are minus log-likelihoods, nats.
FREE_COST_S = 30.0  # of free motion, nats/s: rest and hands explain most recordings; tuned
MODE_CHANGES_S = 1.0  # changes from one mode of motion to another per second; tuned
JUMP_COST = 10.0  # of a step that no motion explains, nats; tuned
# Cost of a change between visible and hidden, and of a change between hidden and out of the room.
VANISH_COST = 7.0  # nats; tuned

HIDDEN = -1  # index in paths: no hypothesis is true


def step_log_ratios(
    mesh: ObjectMesh,
    before: np.ndarray,
    after: np.ndarray,
    seconds: float,
    hands: Sequence[HandMotion | None],
    free_cost_s: float = FREE_COST_S,
) -> np.ndarray:
    """Return log-probabilities of the steps between the hypotheses of two frames.

    Args:
        mesh: the object.
        before: (K, 4, 4) poses.
        after: (L, 4, 4) poses.
        seconds: time between the frames.
        hands: motions of the H hands, None if unknown. A hand must be near enough to hold the
            object.
        free_cost_s: cost of free motion, nats per second.

    Returns:
        (M, M, K + 1, L + 1), indexed by the mode of the step before, the mode of this step, the
            state before and the state after. The M = 2 + H modes are rest, free motion and each
            hand. The last state of either frame is that no hypothesis is true.
    """
    modes = 2 + len(hands)  # rest, free motion, and each hand
    steps = np.zeros((modes, modes, len(before) + 1, len(after) + 1))
    steps[..., :-1, -1] = steps[..., -1, :-1] = -VANISH_COST
    if not (len(before) and len(after)):
        return steps
    own = mode_log_ratios(mesh, before, after, seconds, hands, free_cost_s)
    changes = np.full((modes, modes), np.log(-np.expm1(-MODE_CHANGES_S * seconds)))
    np.fill_diagonal(changes, 0.0)
    # normalised over the modes that are possible from a pose: one of them is true
    possible = np.where(np.isfinite(own).any(2), 0.0, -np.inf)
    share = changes[:, :, None] - logsumexp(changes[:, :, None] + possible, axis=1, keepdims=True)
    steps[..., :-1, :-1] = share[..., None] + own
    return steps


def mode_log_ratios(
    mesh: ObjectMesh,
    before: np.ndarray,
    after: np.ndarray,
    seconds: float,
    hands: Sequence[HandMotion | None],
    free_cost_s: float = FREE_COST_S,
) -> np.ndarray:
    """Return log-probabilities (M, K, L) of the steps between poses in each mode of motion.

    Modes and arguments are those of :func:`step_log_ratios`. -inf: the hand is out of reach.
    """
    turn, shift = pose_distances(mesh, before, after)
    rad_s, m_s = 7.0, 2.5  # standard deviations of free motion: a swing, a kick
    moved = (turn / (rad_s * seconds)) ** 2 + (shift / (m_s * seconds)) ** 2
    # free motion costs for 0.1 s at most: in a longer gap the object may have rested
    ratios = [
        -0.5 * ((turn / SAME_POSE_RAD) ** 2 + (shift / SAME_POSE_M) ** 2),
        -np.minimum(0.5 * moved, JUMP_COST) - free_cost_s * min(seconds, 0.1),
        *(_hand_log_ratios(mesh, before, after, seconds, hand) for hand in hands),
    ]
    return np.array(ratios)


def _hand_log_ratios(
    mesh: ObjectMesh, before: np.ndarray, after: np.ndarray, seconds: float, hand: HandMotion | None
) -> np.ndarray:
    """Return log-probabilities (K, L) of the steps in this hand."""
    if hand is None:
        return np.full((len(before), len(after)), -np.inf)
    turn, shift = pose_distances(mesh, hand.carry(before), after)
    centres = np.array([mesh.centre_at(pose) for pose in before])
    turn_sigma = np.hypot(SAME_POSE_RAD, HELD_RAD_S * seconds)
    # an error of the hand's turn moves a centre in proportion to its distance from the wrist
    arm = np.linalg.norm(centres - hand.start, axis=1)
    shift_sigma = np.sqrt(SAME_POSE_M**2 + (HELD_M_S * seconds) ** 2 + (arm * turn_sigma) ** 2)
    ratio = -0.5 * ((turn / turn_sigma) ** 2 + (shift / shift_sigma[:, None]) ** 2)
    ratio[~hand.reaches(centres, mesh.diameter / 2)] = -np.inf
    return ratio


def pose_distances(
    mesh: ObjectMesh, before: np.ndarray, after: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of all pairs of poses (K, 4, 4) and (L, 4, 4).

    Returns:
        Turns (K, L), radians, up to symmetry; and shifts (K, L) of the centre, metres.
    """
    turn = np.radians(
        mesh.symmetry.rotation_error_deg(before[:, None, :3, :3], after[None, :, :3, :3])
    )
    here, there = (
        poses[:, :3, :3] @ mesh.centre_of_mass + poses[:, :3, 3] for poses in (before, after)
    )
    return turn, np.linalg.norm(there[None] - here[:, None], axis=-1)


@dataclass(frozen=True)
class Decoded:
    """Result of the hidden Markov model."""

    path: np.ndarray
    """(T,) index of the most likely hypothesis, :data:`HIDDEN` if none is true."""
    probability: list[np.ndarray]
    """[T] (K_t + 1,) of each hypothesis and, last, of none, given all frames."""
    gone: np.ndarray
    """(T,) probability that the object has left."""
    evidence: float
    """Log-likelihood of all frames, relative to the object being in none."""

    @property
    def certainty(self) -> np.ndarray:
        """(T,) probability of the most likely hypothesis, 0 if none is true."""
        chosen = zip(self.probability, self.path, strict=True)
        return np.array([0.0 if k == HIDDEN else own[k] for own, k in chosen])


@dataclass(frozen=True)
class MarkovModel:
    """Log-likelihoods of the states of T frames and of the steps between them."""

    emissions: Sequence[np.ndarray]
    """[T] (K_t,) log-likelihoods of the hypotheses, relative to that none is true."""
    steps: Sequence[np.ndarray]
    """[T - 1] (M, M, K_t + 1, K_t+1 + 1) of :func:`step_log_ratios`. Hidden states have no mode;
    the entries of the first mode count for them."""
    absent: float = 0.0
    """Nats per frame by which having left is likelier than being hidden. An object in the room is
    seldom hidden from all cameras for long."""

    def decode(self) -> Decoded:
        """Return the probabilities and the most likely sequence of the states."""
        modes = len(self.steps[0]) if self.steps else 1
        states = [np.append(np.repeat(own, modes), [0.0, self.absent]) for own in self.emissions]
        states[0][:-2] -= np.log(modes)  # all modes are equally likely in the first frame
        for end in (0, -1):
            states[end][-1] -= VANISH_COST
        transitions = [_transitions(step) for step in self.steps]
        path = np.array(_viterbi(states, transitions)) // modes
        path[path >= [len(own) for own in self.emissions]] = HIDDEN
        posterior, evidence = _forward_backward(states, transitions)
        return Decoded(
            path,
            [np.append(own[:-2].reshape(-1, modes).sum(1), own[-2] + own[-1]) for own in posterior],
            np.array([own[-1] for own in posterior]),
            evidence,
        )

    def decode_given(self, frame: int, state: int) -> Decoded:
        """Decode given that hypothesis ``state`` of ``frame`` is true."""
        certain = 1e4  # nats: far more than the evidence of all frames
        known = list(self.emissions)
        known[frame] = np.full(len(known[frame]), -certain)
        known[frame][state] = self.emissions[frame][state] + certain
        decoded = replace(self, emissions=known).decode()
        return replace(decoded, evidence=decoded.evidence - certain)


def _transitions(step: np.ndarray) -> np.ndarray:
    """Return log-probabilities (K * M + 2, L * M + 2) of the transitions between two frames.

    States are ordered by hypothesis, then mode; the last two are hidden and gone.
    """
    modes, count, following = len(step), step.shape[2] - 1, step.shape[3] - 1
    log = np.empty((count * modes + 2, following * modes + 2))
    between = step[:, :, :-1, :-1].transpose(2, 0, 3, 1)
    log[:-2, :-2] = between.reshape(count * modes, following * modes)
    log[:-2, -2] = np.repeat(step[0, 0, :-1, -1], modes)
    # an object that reappears is in any mode with equal probability
    log[-2, :-2] = np.repeat(step[0, 0, -1, :-1], modes) - np.log(modes)
    log[-2, -2] = step[0, 0, -1, -1]
    log[:-1, -1] = log[:-1, -2] - VANISH_COST
    log[-1, :-1] = log[-2, :-1] - VANISH_COST
    log[-1, -1] = 0.0
    return log


def _viterbi(emissions: Sequence[np.ndarray], transitions: Sequence[np.ndarray]) -> list[int]:
    """Return the most likely sequence of states [T] (Viterbi)."""
    best, predecessors = emissions[0], []
    for transition, emission in zip(transitions, emissions[1:], strict=True):
        score = best[:, None] + transition
        predecessors.append(score.argmax(0))
        best = score.max(0) + emission
    path = [int(best.argmax())]
    for predecessor in reversed(predecessors):
        path.append(int(predecessor[path[-1]]))
    return path[::-1]


def _forward_backward(
    emissions: Sequence[np.ndarray], transitions: Sequence[np.ndarray]
) -> tuple[list[np.ndarray], float]:
    """Run the forward-backward algorithm.

    Returns:
        The probability of each state [T], and the log-likelihood of all frames.
    """
    matrices = [np.exp(transition) for transition in transitions]
    # exp(-600) at least, so that no state becomes impossible by underflow
    likelihoods = [np.exp(np.maximum(own - own.max(), -600.0)) for own in emissions]
    evidence = float(sum(own.max() for own in emissions))
    forward: list[np.ndarray] = []
    for t, likelihood in enumerate(likelihoods):
        alpha = likelihood if t == 0 else (forward[-1] @ matrices[t - 1]) * likelihood
        evidence += float(np.log(alpha.sum()))
        forward.append(alpha / alpha.sum())
    backward = [np.ones(len(likelihoods[-1]))]
    for matrix, likelihood in zip(reversed(matrices), reversed(likelihoods[1:]), strict=True):
        beta = matrix @ (backward[-1] * likelihood)
        backward.append(beta / beta.max())
    both = [alpha * beta for alpha, beta in zip(forward, reversed(backward), strict=True)]
    return [own / own.sum() for own in both], evidence


def mix_decisions(results: Sequence[Decoded]) -> Decoded:
    """Average results given different hypotheses of one frame, weighted by their evidence."""
    evidence = np.array([result.evidence for result in results])
    share = np.exp(evidence - logsumexp(evidence))
    probability = [
        np.einsum("n,nk->k", share, np.array(every))
        for every in zip(*(result.probability for result in results), strict=True)
    ]
    gone = share @ np.array([result.gone for result in results])
    path = results[int(share.argmax())].path
    return Decoded(path, probability, gone, float(logsumexp(evidence)))
