"""Start times of cameras: stated by the user or by sound, and as found from the keypoints.

A stated start is where the search of :mod:`.start_times` begins, and a prior of the time offset. It
is rejected if the keypoints clearly contradict it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import PeopleOfImages

PRIOR_OFFSET_S = 0.01  # synchronised devices expose within a third of a period of 1/30 s
FEWEST_SETS_APART = 2  # fewer sets are a slip or an offset, not a late start; tuned
MIN_SHARED_S = 1.0  # that two cameras must both have recorded, to tell when they started
# Of what is stated of a start and what keypoints say, together: beyond, they are followed. With a
# smaller number one honest statement in some thousand would be overruled, and told.
DENIED_SIGMAS = 4.0
# Of starts by the sound: within, images whose times are in step are left so. Of five cameras in
# step one exceeds it in one recording of 75.
IN_STEP_SIGMAS = 3.0


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
                    f"{self.source[c]} has camera {names[c]} start {describe_start(self.late[c])}, "
                    f"and the recording lasts {lasts:.1f} s: hardly any of it would be in common; "
                    "state the starts in seconds, of one clock"
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
                    f"{source[c]} has it start {describe_start(late[c])}, {other.source[c]} "
                    f"{describe_start(other.late[c])}: the first was taken"
                )
                continue
            late[c], sigma[c] = combine_estimates(
                (late[c], sigma[c]), (other.late[c], other.sigma[c])
            )
            source[c] = f"{source[c]} and {other.source[c]}"
        return StatedStarts(late, sigma, tuple(source)), odd


def combine_estimates(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """The mean of two values by their standard deviations, and its own."""
    weights = one[1] ** -2.0, other[1] ** -2.0
    total = sum(weights)
    return (weights[0] * one[0] + weights[1] * other[0]) / total, total**-0.5


def describe_start(late: float) -> str:
    """When a camera started whose images are ``late`` s older than their times say."""
    if abs(late) < 0.0005:
        return "as its times say"
    return f"{abs(late):.3f} s {'earlier' if late > 0 else 'later'} than its times say"


@dataclass(frozen=True, eq=False)
class StartTimes:
    """By how much each camera's images are older than their sets say, all along: ``late`` (C,) s,
    the master's 0, and the nearest whole number of ``sets`` (C,). ``apart``: the cameras were not
    started together. ``in_doubt`` (C,): then this camera's time could not be told. ``sigma`` (C,) s
    that ``late`` is off by where it rests on what was stated, else NaN; ``denied`` (C,): something
    was stated, and the keypoints say otherwise."""

    late: np.ndarray
    sets: np.ndarray
    in_doubt: np.ndarray
    apart: bool
    step_s: float
    sigma: np.ndarray
    denied: np.ndarray

    @classmethod
    def as_stated(cls, stated: StatedStarts, step_s: float) -> StartTimes:
        """What is stated, and of other cameras what their images' times say."""
        none = np.zeros(len(stated.late), bool)
        late = np.nan_to_num(stated.late)
        return cls(late, stated.sets(step_s), none, False, step_s, stated.sigma.copy(), none.copy())

    @property
    def offset(self) -> np.ndarray:
        """(C,) s after which cameras expose, once images are moved by whole numbers of sets."""
        return self.sets * self.step_s - self.late

    @property
    def offset_sigma(self) -> np.ndarray | None:
        """(C,) s that these offsets are off by: what was stated, else half a set of cameras that
        started apart; None where nothing is stated and nothing started apart."""
        stated = np.isfinite(self.sigma)
        if not self.apart and not stated.any():
            return None
        return np.where(stated, self.sigma, self.step_s / 2 if self.apart else PRIOR_OFFSET_S)

    def in_step(self, values: np.ndarray) -> np.ndarray:
        """Values (T, C, ...) of images, with each camera's moved to the sets of its moments; 0
        where there is no image."""
        return shift_images(values, self.sets)

    def of_images(self, values: np.ndarray) -> np.ndarray:
        """Values (T, C, ...) of moments, as :meth:`in_step` gives them, moved back."""
        return shift_images(values, -self.sets)

    def with_slips(self, slip: np.ndarray) -> np.ndarray:
        """By how many sets (T, C) images are late in all, from slips (T, C) that were found in
        step."""
        last = len(slip) - 1
        place = np.clip(np.arange(len(slip))[:, None] - self.sets, 0, last)
        return np.take_along_axis(slip, place, 0) + self.sets.astype(slip.dtype)


def shift_images(values: np.ndarray, by: np.ndarray, fill: float = 0) -> np.ndarray:
    """Values (T, C, ...) of images with each camera's ``by`` (C,) sets earlier; ``fill`` where
    there are none."""
    sets = len(values)
    result = np.full_like(values, fill)
    for c, shift in enumerate(by.tolist()):
        there = slice(max(0, -shift), max(0, min(sets, sets - shift)))
        result[there, c] = values[max(0, shift) : max(0, sets + min(0, shift)), c]
    return result


@dataclass(frozen=True)
class AlignedPeople:
    """The people of the images that show each set's moment."""

    detections: PeopleOfImages
    starts: StartTimes

    @property
    def num_sets(self) -> int:
        """How many sets there are."""
        return self.detections.num_sets

    def people(self, t: int, c: int) -> np.ndarray:
        """Keypoints (P, 135, 3) of the people whom camera c sees at set t's moment."""
        image = t + int(self.starts.sets[c])
        if 0 <= image < self.num_sets and not self.starts.in_doubt[c]:
            return self.detections.people(image, c)
        return np.zeros((0, NUM_KEYPOINTS, 3))
