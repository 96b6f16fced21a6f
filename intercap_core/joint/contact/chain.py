"""On and off over time: a semi-Markov chain with stays of different lengths, made of states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Chain:
    """Off, or on in one of K kinds of stay.

    ``begins`` is how often a second what is off goes on; ``durations`` (K,) are the stays' means,
    seconds, and ``shares`` (K,) how many of the stays are of each kind. With several kinds, short
    stays cost little and long ones are not forgotten where nothing is seen.
    """

    begins: float
    durations: tuple[float, ...]
    shares: tuple[float, ...]

    def start(self) -> np.ndarray:
        """Probability (1 + K,) of off and of each kind before anything is seen."""
        weights = np.array(
            [1.0, *(self.begins * s * d for s, d in zip(self.shares, self.durations, strict=True))]
        )
        return weights / weights.sum()

    def transition(self, fps: float) -> np.ndarray:
        """(1 + K, 1 + K) from one frame's state to the next one's, at ``fps`` frames a second."""
        kinds = len(self.durations)
        found = np.zeros((1 + kinds, 1 + kinds))
        found[0, 1:] = min(0.5, self.begins / fps) * np.array(self.shares)
        found[1:, 0] = np.minimum(0.5, 1 / (fps * np.array(self.durations)))
        found[np.diag_indices(1 + kinds)] = 1 - found.sum(axis=1)
        return found

    def posterior(self, evidence: np.ndarray, fps: float) -> np.ndarray:
        """Probability (T, R) of on, of R chains, given log odds ``evidence`` (T, R) by frame."""
        with np.errstate(divide="ignore"):  # one kind of stay never turns into another
            transition, start = np.log(self.transition(fps)), np.log(self.start())
        on = np.arange(len(start)) > 0
        emission = evidence[:, :, None] * on
        forward, backward = np.empty_like(emission), np.zeros_like(emission)
        forward[:1] = start + emission[:1]
        for t in range(1, len(evidence)):
            before = np.logaddexp.reduce(forward[t - 1][:, :, None] + transition, axis=1)
            forward[t] = emission[t] + before
        for t in range(len(evidence) - 2, -1, -1):
            after = (emission[t + 1] + backward[t + 1])[:, None, :]
            backward[t] = np.logaddexp.reduce(transition + after, axis=2)
        joint = forward + backward
        total = np.logaddexp.reduce(joint, axis=2)
        return np.exp(np.logaddexp.reduce(joint[:, :, on], axis=2) - total)
