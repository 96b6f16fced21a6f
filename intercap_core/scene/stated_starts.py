"""Starts of cameras that somebody states, or that the sound tells, beside the keypoints'.

What is stated is where the search begins (:mod:`intercap_core.scene.start_times`), and a prior of
the time offsets. Where the keypoints surely say otherwise they are followed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from intercap_core.errors import UserError
from intercap_core.scene.constants import (
    DENIED_SIGMAS,
    FEWEST_SETS_APART,
    IN_STEP_SIGMAS,
    MIN_SHARED_S,
)


@dataclass(frozen=True, eq=False)
class StatedStarts:
    """By how much each camera's images are older than their sets say, beside the master's: ``late``
    (C,) s and its standard deviation ``sigma`` (C,), NaN = not stated, as of the master itself;
    ``source`` (C,) says by what, in words."""

    late: np.ndarray
    sigma: np.ndarray
    source: tuple[str, ...]

    @classmethod
    def nothing(cls, views: int) -> StatedStarts:
        """Of ``views`` cameras nothing is stated."""
        return cls(np.full(views, np.nan), np.full(views, np.nan), ("",) * views)

    @classmethod
    def of(
        cls,
        stated: Mapping[str, tuple[float, float]],
        names: Sequence[str],
        master: int,
        first_image_s: np.ndarray,
        source: str,
    ) -> StatedStarts:
        """From when cameras took their first images: ``stated`` seconds of any clock and their
        standard deviation by camera; nothing where the master's is not among them.

        ``first_image_s`` (C,): the same by the recordings' own times, NaN = no image.
        """
        result = cls.nothing(len(names))
        own = stated.get(names[master])
        if own is None or not np.isfinite(first_image_s[master]):
            return result
        told = [""] * len(names)
        for c, name in enumerate(names):
            if c == master or name not in stated or not np.isfinite(first_image_s[c]):
                continue
            seconds, sigma = stated[name]
            started = seconds - own[0]
            result.late[c] = first_image_s[c] - first_image_s[master] - started
            result.sigma[c] = np.hypot(sigma, own[1])
            told[c] = source
        return replace(result, source=tuple(told))

    @property
    def known(self) -> np.ndarray:
        """(C,) bool: something is stated of the camera."""
        return np.isfinite(self.late)

    def sets(self, step_s: float) -> np.ndarray:
        """The nearest whole sets (C,); 0 where nothing is stated."""
        return np.rint(np.nan_to_num(self.late) / max(step_s, 1e-9)).astype(int)

    def bounds(self, step_s: float, reach: int) -> np.ndarray:
        """How many sets (C,) from what is stated a camera may be without denying it; ``reach``
        where nothing is."""
        away = DENIED_SIGMAS * np.hypot(np.nan_to_num(self.sigma), step_s / 2) / step_s
        return np.where(self.known, np.minimum(away, reach), reach).astype(int)

    def says_apart(self, step_s: float) -> bool:
        """Whether some camera surely started at another time than its images' times say."""
        least = FEWEST_SETS_APART * step_s + DENIED_SIGMAS * self.sigma
        return bool((np.abs(self.late) > least)[self.known].any())

    def unless_in_step(self) -> StatedStarts:
        """These, or nothing where they all agree with that the images' own times are of one clock:
        those are then the better ones."""
        apart = (np.abs(self.late) > IN_STEP_SIGMAS * self.sigma)[self.known].any()
        return self if apart else StatedStarts.nothing(len(self.late))

    def check_common(self, times: np.ndarray, names: Sequence[str]) -> None:
        """Raise UserError where a camera would have recorded nothing at the same time as the
        master, whose sets are at ``times`` (T,) s."""
        lasts = float(times[-1] - times[0]) if len(times) else 0.0
        for c in np.flatnonzero(self.known).tolist():
            if abs(self.late[c]) > lasts - min(MIN_SHARED_S, lasts / 2):
                raise UserError(
                    f"{self.source[c]} has camera {names[c]} start {when(self.late[c])}, and the "
                    f"recording lasts {lasts:.1f} s: hardly any of it would be in common; state "
                    "the starts in seconds, of one clock"
                )

    def beside(self, other: StatedStarts) -> tuple[StatedStarts, list[str]]:
        """These, and what ``other`` says of cameras of which they say nothing or the same; what
        the two disagree about (C,), in words, "" = nothing."""
        late, sigma, source = self.late.copy(), self.sigma.copy(), list(self.source)
        odd = [""] * len(late)
        for c in np.flatnonzero(other.known):
            if not self.known[c]:
                late[c], sigma[c], source[c] = other.late[c], other.sigma[c], other.source[c]
                continue
            if abs(late[c] - other.late[c]) > DENIED_SIGMAS * np.hypot(sigma[c], other.sigma[c]):
                odd[c] = (
                    f"{source[c]} has it start {when(late[c])}, {other.source[c]} "
                    f"{when(other.late[c])}: the first was taken"
                )
                continue
            late[c], sigma[c] = combined((late[c], sigma[c]), (other.late[c], other.sigma[c]))
            source[c] = f"{source[c]} and {other.source[c]}"
        return StatedStarts(late, sigma, tuple(source)), odd


def combined(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """The mean of two values by their standard deviations, and its own."""
    weights = one[1] ** -2.0, other[1] ** -2.0
    total = sum(weights)
    return (weights[0] * one[0] + weights[1] * other[0]) / total, total**-0.5


def when(late: float) -> str:
    """When a camera started whose images are ``late`` s older than their times say."""
    if abs(late) < 0.0005:
        return "as its times say"
    return f"{abs(late):.3f} s {'earlier' if late > 0 else 'later'} than its times say"
