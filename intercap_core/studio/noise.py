"""Random processes over time, in two families of shape.

Family "a" is Gaussian with a smooth kernel; family "b" has heavier tails (Laplace) and jagged
paths (first-order, Ornstein-Uhlenbeck) at another correlation time.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

_QUANTILES = ndtri((np.arange(1 << 16) + 0.5) / (1 << 16)).astype(np.float32)


def gaussian(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Standard normal values in float32, drawn from 65536 quantiles.

    For images: it takes a quarter of the time of the generator's own method.
    """
    return _QUANTILES[rng.integers(0, 1 << 16, shape, np.uint16)]


@dataclass(frozen=True)
class NoiseSource:
    """Random processes with a seed, scale and family; each name has its own random numbers."""

    seed: int
    """Seed of all streams."""
    scale: float
    """Factor of all errors; 1 = normal, 0 = none."""
    family: str
    """"a" or "b"; see the header of the module."""
    fps: float
    """Frames a second of the processes."""
    redrawn: int = 0
    """Number of the detectors' random stream; another number redraws their errors alone."""

    def rng(self, *name: object) -> np.random.Generator:
        """Generator of the stream ``name``."""
        return np.random.default_rng([self.seed, zlib.crc32(repr(name).encode())])

    def detector_rng(self, *name: object) -> np.random.Generator:
        """Generator of a detector's stream; ``redrawn`` selects another stream."""
        return self.rng(*name, self.redrawn) if self.redrawn else self.rng(*name)

    def process(
        self, rng: np.random.Generator, frames: int, channels: int, correlation_s: float
    ) -> np.ndarray:
        """(frames, channels): zero mean, unit variance, correlated over ``correlation_s``."""
        if self.family == "b":
            correlation_s *= 1.7
            return self.tails(self.first_order(rng, frames, channels, correlation_s))
        lag = max(correlation_s * self.fps, 1e-3)
        margin = int(np.ceil(3 * lag))
        white = rng.normal(size=(frames + 2 * margin, channels))
        reach = np.arange(-margin, margin + 1)
        kernel = np.exp(-((reach / lag) ** 2))
        kernel /= np.linalg.norm(kernel)
        return np.stack(
            [np.convolve(white[:, k], kernel, "valid") for k in range(channels)], 1
        ).reshape(frames, channels)

    def first_order(
        self, rng: np.random.Generator, frames: int, channels: int, correlation_s: float
    ) -> np.ndarray:
        """First-order process (frames, channels) of unit variance."""
        keep = np.exp(-1 / max(correlation_s * self.fps, 1e-3))
        steps = rng.normal(size=(frames, channels))
        path = np.empty_like(steps)
        path[0] = steps[0]
        for t in range(1, frames):
            path[t] = keep * path[t - 1] + np.sqrt(1 - keep**2) * steps[t]
        return path

    def tails(self, gaussian: np.ndarray) -> np.ndarray:
        """In family "b", map standard normal values to Laplace values of unit variance."""
        if self.family != "b":
            return gaussian
        rank = np.clip(ndtr(gaussian), 1e-6, 1 - 1e-6) - 0.5
        return -np.sign(rank) * np.log1p(-2 * np.abs(rank)) / np.sqrt(2)

    def episodes(
        self,
        rng: np.random.Generator,
        frames: int,
        probability: float,
        correlation_s: float,
        shared: np.ndarray | float = 0.0,
        agreement: float = 0.0,
        channels: int = 1,
    ) -> np.ndarray:
        """On/off episodes (frames, channels) of about ``correlation_s`` that views partly share.

        Args:
            probability: of being on, multiplied by ``scale``.
            correlation_s: correlation time of the views' own processes, seconds.
            shared: (frames,) process common to all views.
            agreement: share of the variance that ``shared`` explains.
        """
        own = self.process(rng, frames, channels, correlation_s)
        mixed = np.sqrt(agreement) * np.reshape(shared, (-1, 1)) + np.sqrt(1 - agreement) * own
        return ndtr(mixed) < np.clip(probability * self.scale, 0, 0.95)
