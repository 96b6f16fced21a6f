"""Colours of the object's surface, learnt while it is tracked: they decide turns that its shape
leaves open.

The surface is cut into patches. What a view shows of one is its colour in logarithms of linear
light, where a camera's gain and shading add: a brightness and two ratios of channels. Of a pose x
it says the log-likelihood ratio

    log p(colours | those learnt, turned with x) - log p(colours | any of the object's)

so an object of one colour says nothing, whatever its colour; nor does a side that was never seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.rigid.mesh import Paint
from intercap_core.object_track.constants import (
    COLOUR_COST_MAX,
    COLOUR_HALF_SAMPLES_PX,
    COLOUR_MIN_SIGMA,
    COLOUR_RANGE,
    COLOUR_SAMPLES,
    COLOURED_SHARE,
    EXPOSURE_SIGMA,
    GAIN_SIGMA,
    LEARNING_STEPS,
    PAINT_EXPLAINS,
    SHADING_SIGMA,
)
from intercap_core.object_track.light import linear
from intercap_core.object_track.surface_kernel import patches_of

LEVELS_USED = slice(10, 251)  # darker ones are noise, brighter ones saturated
LIGHT = np.full(256, np.nan)
"""Logarithms of light of grey levels; NaN where a level says nothing."""
LIGHT[LEVELS_USED] = np.log(linear(np.arange(256)[LEVELS_USED]))


@dataclass(frozen=True, eq=False)
class Sighting:
    """What frame t shows of the surface at one pose, patch by patch, all views together.

    ``patch`` (N,) numbers, ``colour`` (N, 3) as in :mod:`.surface_kernel`, ``normal`` (N, 3) of the
    patches in the master frame, ``view`` (N,) in ascending order, ``pixels`` (N,).
    """

    frame: int
    patch: np.ndarray
    colour: np.ndarray
    normal: np.ndarray
    view: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True, eq=False)
class _Known:
    """Colours of P patches: ``mean`` and ``variance`` (P, 3)."""

    mean: np.ndarray
    variance: np.ndarray


class Appearance:
    """The surface's colours, learnt from ``sightings`` of frames in which the pose is certain.

    ``paint`` are those that the mesh brings; they count as far as they explain what is seen.
    """

    def __init__(
        self, sightings: Sequence[Sighting], views: int, paint: Paint | None, size: float
    ) -> None:
        self.sightings = tuple(sightings)
        self._patches = np.unique(np.concatenate([one.patch for one in sightings]))
        self._gain = np.zeros((views, 3))
        every = np.concatenate([one.colour for one in sightings])
        self._average = np.median(every, axis=0)
        self._spread = np.maximum(every.var(0), COLOUR_MIN_SIGMA**2)
        self._noise = self._spread.copy()
        self._frames = np.array([one.frame for one in sightings])
        count = len(self._patches)
        self._totals = np.zeros((len(sightings), count, 3))
        self._looks = np.zeros((len(sightings), count))
        self._learn()
        self._painted = None if paint is None else self._compare(paint, size)

    @property
    def says_something(self) -> bool:
        """Whether the object has more than one colour."""
        return bool((self._spread > COLOURED_SHARE * self._noise).any())

    def log_ratio(self, seen: Sighting, apart: int) -> float:
        """The log-likelihood ratio of a sighting's pose, nats, by the colours of frames that are at
        least ``apart`` from its own."""
        return self._ratio(seen, self._known(np.abs(self._frames - seen.frame) >= apart))

    def paint_log_ratio(self, seen: Sighting) -> float:
        """The same by the mesh's own colours alone; 0 where they are not the object's."""
        return 0.0 if self._painted is None else self._ratio(seen, self._painted)

    # --- learning ------------------------------------------------------------------------------

    def _learn(self) -> None:
        """Colours, the cameras' gains, and how far both are off, in turns."""
        views = np.concatenate([one.view for one in self.sightings])
        cameras = np.unique(views)
        for _ in range(LEARNING_STEPS):
            plain = [
                self._unshaded(one, one.colour - self._gain[one.view] - self._average)
                for one in self.sightings
            ]
            self._add_up(plain)
            left = []
            for one in self.sightings:
                at, _ = self._find(one.patch)
                known = self._known(self._frames != one.frame)
                colour = one.colour - self._gain[one.view] - known.mean[at]
                left.append(self._unshaded(one, colour))
            residual = np.concatenate(left)
            # a camera may have seen one side alone: what may be colour is not taken for its gain
            share = GAIN_SIGMA**2 / (GAIN_SIGMA**2 + self._noise)
            for camera in cameras:
                left_over = residual[views == camera] + self._gain[camera]
                self._gain[camera] = share * np.median(left_over, axis=0)
            self._gain[cameras] -= self._gain[cameras].mean(0)
            # what the other frames do not foretell is noise: a hand before the object, a shadow
            noise = _mean_square(residual)
            self._noise = np.maximum(noise, COLOUR_MIN_SIGMA**2)
            self._spread = np.maximum(_mean_square(np.concatenate(plain)) - noise, 0.0)

    def _add_up(self, plain: Sequence[np.ndarray]) -> None:
        """Mean colours of the patches by frame, a frame's views as one look; ``plain`` are the
        sightings' differences from the average."""
        count = len(self._patches)
        for number, (one, colour) in enumerate(zip(self.sightings, plain, strict=True)):
            at, _ = self._find(one.patch)
            weight = np.bincount(at, one.pixels, count)
            self._looks[number] = weight > 0
            for channel in range(3):
                own = np.bincount(at, one.pixels * (self._average + colour)[:, channel], count)
                self._totals[number, :, channel] = own / np.maximum(weight, 1e-9)

    def _known(self, frames: np.ndarray) -> _Known:
        """The patches' colours by those of the learnt frames that ``frames`` (N,) bool tells."""
        spread = np.maximum(self._spread, 1e-9)
        looks = self._looks[frames].sum(0)[:, None]
        variance = 1 / (1 / spread + looks / self._noise)
        total = self._totals[frames].sum(0)
        return _Known(variance * (self._average / spread + total / self._noise), variance)

    def _find(self, patch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (N,) of patches among those known, and whether each is."""
        at = np.minimum(np.searchsorted(self._patches, patch), len(self._patches) - 1)
        return at, self._patches[at] == patch

    def _unshaded(self, seen: Sighting, colour: np.ndarray) -> np.ndarray:
        """Differences of colour (N, 3) of a sighting without what light that falls from one side,
        and each view's exposure, may explain of them (ridge regression on the normals)."""
        result = colour.copy()
        starts = np.flatnonzero(np.diff(seen.view, prepend=-1))
        for start, stop in zip(starts, [*starts[1:], len(seen.view)], strict=True):
            own = slice(start, stop)
            # its patches err together: a view of one side alone must not lose its colour
            weight = COLOUR_SAMPLES * seen.pixels[own, None] / seen.pixels[own].sum()
            light = np.concatenate(
                [np.full((stop - start, 1), EXPOSURE_SIGMA), SHADING_SIGMA * seen.normal[own]], 1
            )
            for channels, design in ((slice(0, 1), light), (slice(1, 3), light[:, :1])):
                noise = self._noise[channels].mean()
                matrix = (weight * design).T @ design / noise + np.eye(design.shape[1])
                force = (weight * design).T @ colour[own, channels] / noise
                result[own, channels] -= design @ np.linalg.solve(matrix, force)
        return result

    # --- comparing -----------------------------------------------------------------------------

    def _ratio(self, seen: Sighting, known: _Known) -> float:
        """Sum over views of mean log-likelihood ratios of their pixels, times the independent
        samples that these are."""
        at, is_known = self._find(seen.patch)
        colour = seen.colour - self._gain[seen.view]
        any_ = self._unshaded(seen, colour - self._average)
        mean = np.where(is_known[:, None], known.mean[at], self._average)
        variance = np.where(is_known[:, None], known.variance[at], self._spread) + self._noise
        own = self._unshaded(seen, colour - mean)
        common = self._spread + self._noise
        ratio = _cost(any_, common) - _cost(own, variance)
        found = 0.0
        for camera in np.unique(seen.view):
            here = seen.view == camera
            pixels = float(seen.pixels[here].sum())
            samples = COLOUR_SAMPLES * pixels / (pixels + COLOUR_HALF_SAMPLES_PX)
            found += samples * float(seen.pixels[here] @ ratio[here]) / pixels
        return found

    def _compare(self, paint: Paint, size: float) -> _Known | None:
        """The mesh's own colours of the patches, where they explain those learnt."""
        number = patches_of(paint.points, paint.normals, size)
        at, is_known = self._find(number)
        # a scan has no noise that would drown its darkest and brightest colours
        levels = np.clip(paint.colours, LEVELS_USED.start, LEVELS_USED.stop - 1)
        red, green, blue = LIGHT[levels].T
        colour = np.stack([(red + green + blue) / 3, red - green, blue - green], 1)
        usable = is_known & np.isfinite(colour).all(1)
        count = len(self._patches)
        looks = np.bincount(at[usable], minlength=count)
        total = [np.bincount(at[usable], colour[usable, k], count) for k in range(3)]
        there = looks > 0
        if there.sum() < 2:
            return None
        mean = np.tile(self._average, (count, 1))
        mean[there] = np.stack(total, 1)[there] / looks[there, None]
        learnt = self._known(np.ones(len(self._frames), bool)).mean
        mean[there] += np.median(learnt[there] - mean[there], axis=0)
        off = _mean_square(learnt[there] - mean[there])
        square = _mean_square(learnt[there] - self._average)
        # of all channels together: paint of another copy may be right in one by chance
        if (off / self._noise).sum() > (1 - PAINT_EXPLAINS) * (square / self._noise).sum():
            return None
        variance = np.where(there[:, None], off, self._spread)
        return _Known(mean, variance)


def _cost(residual: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Minus log-likelihoods (N,) of residuals (N, 3), up to a constant; outliers cost no more than
    so much."""
    cost = np.minimum(0.5 * residual**2 / variance, COLOUR_COST_MAX)
    return (cost + 0.5 * np.log(variance)).sum(1)


def _mean_square(residual: np.ndarray) -> np.ndarray:
    """Mean square (3,) of residuals (N, 3), none of which counts for more than colours differ."""
    return (np.clip(residual, -COLOUR_RANGE, COLOUR_RANGE) ** 2).mean(0)
