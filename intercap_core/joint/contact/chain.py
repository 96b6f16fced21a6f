"""An on/off process over time: a hidden Markov chain whose dwell times are a mixture.

With several kinds of dwell, short ones are not suppressed and long ones last through frames without
evidence (hyperexponential dwell times; forward-backward algorithm, Rabiner 1989).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class DwellChain:
    """A hidden chain with one state "off" and one state "on" for each of K kinds of dwell."""

    begins: float  # Rate at which "off" turns to "on", 1/s
    durations: tuple[float, ...]  # (K,) mean dwell time of each kind, seconds
    shares: tuple[float, ...]  # (K,) share of each kind among the dwells

    def start(self) -> np.ndarray:
        """Stationary probability (1 + K,) of "off" and of each kind."""
        weights = np.array(
            [1.0, *(self.begins * s * d for s, d in zip(self.shares, self.durations, strict=True))]
        )
        return weights / weights.sum()

    def transition(self, fps: float) -> np.ndarray:
        """Transition matrix (1 + K, 1 + K) between consecutive frames."""
        kinds = len(self.durations)
        matrix = np.zeros((1 + kinds, 1 + kinds))
        matrix[0, 1:] = min(0.5, self.begins / fps) * np.array(self.shares)
        matrix[1:, 0] = np.minimum(0.5, 1 / (fps * np.array(self.durations)))
        matrix[np.diag_indices(1 + kinds)] = 1 - matrix.sum(axis=1)
        return matrix

    def posterior(self, evidence: np.ndarray, fps: float) -> np.ndarray:
        """Probability (T, R) of "on" from log-likelihood ratios ``evidence`` (T, R); R chains."""
        with np.errstate(divide="ignore"):  # kinds of dwell never turn into each other
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
