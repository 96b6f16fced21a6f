"""Start times of cameras: stated by the user or by sound, and estimated from the keypoints.

A start is expressed as ``late``: the time that the recording gives an image minus the time of the
moment that it shows, on the master's clock. ``late`` > 0 means that the camera started earlier than
its times say, so that the image with the time of a set shows an older moment.

The search of :mod:`.start_times` begins at a stated start, which is also the prior of the time
offset. A statement is rejected if the keypoints clearly contradict it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.formats.recordings.synchronise import in_step_sigma
from intercap_core.geometry.solve.robust import OUTLIER_SIGMAS

NOT_DETERMINED = "start not determined"  # begins the note of a camera that was not moved
MIN_SHARED_S = 1.0  # least overlap of two recordings to determine a start; tuned on the studio


@dataclass(frozen=True, eq=False)
class StatedStarts:
    """Stated start of each camera relative to the master."""

    late: np.ndarray
    """(C,) seconds by which a camera's images are older than their sets' times; NaN = not stated,
    also for the master."""
    sigma: np.ndarray
    """(C,) standard deviation of ``late``, seconds; NaN = not stated."""
    source: tuple[str, ...]
    """(C,) origin of each statement, for messages; "" = not stated."""

    @classmethod
    def nothing(cls, views: int) -> StatedStarts:
        """No statement about any of ``views`` cameras."""
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
        """Convert stated times of first images to starts relative to the master.

        Returns no statement at all if the master's start is not stated.

        Args:
            stated: by camera, time of its first image on any clock common to all, and its standard
                deviation, seconds.
            names: camera names, in the order of the rig.
            master: index of the master.
            first_image_s: (C,) time of the first image by the recording's own clock; NaN = none.
            source: origin of the statements, for messages.
        """
        result = cls.nothing(len(names))
        own = stated.get(names[master])
        if own is None or not np.isfinite(first_image_s[master]):
            return result
        sources = [""] * len(names)
        for c, name in enumerate(names):
            if c == master or name not in stated or not np.isfinite(first_image_s[c]):
                continue
            seconds, sigma = stated[name]
            started = seconds - own[0]
            result.late[c] = first_image_s[c] - first_image_s[master] - started
            result.sigma[c] = np.hypot(sigma, own[1])
            sources[c] = source
        return replace(result, source=tuple(sources))

    @property
    def known(self) -> np.ndarray:
        """(C,) bool: cameras with a stated start."""
        return np.isfinite(self.late)

    def sets(self, step_s: float) -> np.ndarray:
        """Nearest whole number of frame sets (C,); 0 = not stated. ``step_s``: seconds per set."""
        return np.rint(np.nan_to_num(self.late) / max(step_s, 1e-9)).astype(int)

    def bounds(self, step_s: float, reach: int) -> np.ndarray:
        """Largest deviation from the stated start (C,), in frame sets, that does not contradict it.

        ``step_s``: seconds per set. ``reach``: the bound for cameras without a statement.
        """
        away = OUTLIER_SIGMAS * np.hypot(np.nan_to_num(self.sigma), step_s / 2) / step_s
        return np.where(self.known, np.minimum(away, reach), reach).astype(int)

    def states_apart(self, step_s: float) -> bool:
        """Whether a statement contradicts the images' own times by at least two sets beyond its
        accuracy."""
        least = 2 * step_s + OUTLIER_SIGMAS * self.sigma
        return bool((np.abs(self.late) > least)[self.known].any())

    def unless_in_step(self) -> StatedStarts:
        """These statements, or none if they all agree with the images' own times.

        If the cameras share one clock, the images' own times are the more accurate ones. Statements
        that agree with them within three standard deviations are therefore dropped. With five
        synchronised cameras besides the master, chance exceeds this bound in one of 75 recordings.
        """
        apart = (np.abs(self.late) > 3.0 * self.sigma)[self.known].any()
        return self if apart else StatedStarts.nothing(len(self.late))

    def check_common(self, times: np.ndarray, names: Sequence[str]) -> None:
        """Raise UserError if a camera's recording would not overlap with the master's.

        ``times``: (T,) seconds of the master's frame sets. ``names``: camera names.
        """
        lasts = float(times[-1] - times[0]) if len(times) else 0.0
        for c in np.flatnonzero(self.known).tolist():
            if abs(self.late[c]) > lasts - min(MIN_SHARED_S, lasts / 2):
                raise UserError(
                    f"{self.source[c]} states that camera {names[c]} started "
                    f"{describe_start(self.late[c])}, "
                    f"and the recording lasts {lasts:.1f} s, so they hardly overlap; "
                    "state the starts in seconds, of one clock"
                )

    def combine(self, other: StatedStarts) -> tuple[StatedStarts, list[str]]:
        """Combine two sources of starts; if they disagree about a camera, this one has precedence.

        Returns the combined starts, and a message (C,) for each disagreement, "" = none.
        """
        late, sigma, source = self.late.copy(), self.sigma.copy(), list(self.source)
        odd = [""] * len(late)
        for c in np.flatnonzero(other.known):
            if not self.known[c]:
                late[c], sigma[c], source[c] = other.late[c], other.sigma[c], other.source[c]
                continue
            if abs(late[c] - other.late[c]) > OUTLIER_SIGMAS * np.hypot(sigma[c], other.sigma[c]):
                odd[c] = (
                    f"{source[c]} states that it started {describe_start(late[c])}, "
                    f"{other.source[c]} {describe_start(other.late[c])}; the former is used"
                )
                continue
            late[c], sigma[c] = combine_estimates(
                (late[c], sigma[c]), (other.late[c], other.sigma[c])
            )
            source[c] = f"{source[c]} and {other.source[c]}"
        return StatedStarts(late, sigma, tuple(source)), odd


def combine_estimates(
    first: tuple[float, float], second: tuple[float, float]
) -> tuple[float, float]:
    """Inverse-variance weighted mean of two (value, standard deviation) pairs, as such a pair."""
    weights = first[1] ** -2.0, second[1] ** -2.0
    total = sum(weights)
    return (weights[0] * first[0] + weights[1] * second[0]) / total, total**-0.5


def describe_start(late: float) -> str:
    """Start of a camera in words. ``late``: seconds by which its images are older than stated."""
    if abs(late) < 0.0005:
        return "as its times say"
    return f"{abs(late):.3f} s {'earlier' if late > 0 else 'later'} than its times say"


@dataclass(frozen=True, eq=False)
class StartTimes:
    """Estimated start of each camera relative to the master, constant over the recording."""

    late: np.ndarray
    """(C,) seconds by which a camera's images are older than their sets' times; 0 = master."""
    sets: np.ndarray
    """(C,) nearest whole number of frame sets to ``late``."""
    in_doubt: np.ndarray
    """(C,) bool: the cameras did not start together, and this camera's start is undetermined."""
    apart: bool
    """True if the cameras did not start together."""
    step_s: float
    """Seconds per frame set."""
    sigma: np.ndarray
    """(C,) standard deviation of ``late``, seconds, of cameras with an accepted statement; else
    NaN."""
    rejected: np.ndarray
    """(C,) bool: the keypoints contradict the stated start."""
    undetermined: tuple[str, ...] = ()
    """(C,) reasons why the keypoints do not confirm a start, "" = they do; empty = not searched."""
    short: np.ndarray | None = None
    """(C,) sets by which images seem to be late beyond ``sets``, too few to
    distinguish a start from a slip."""
    too_short: bool = False
    """The recording, or its number of frame sets, is too small for a search."""

    @classmethod
    def as_stated(cls, stated: StatedStarts, step_s: float) -> StartTimes:
        """The stated starts; 0 (the images' own times) for cameras without a statement."""
        none = np.zeros(len(stated.late), bool)
        late = np.nan_to_num(stated.late)
        return cls(late, stated.sets(step_s), none, False, step_s, stated.sigma.copy(), none.copy())

    @property
    def offset(self) -> np.ndarray:
        """(C,) seconds by which cameras expose late once their images are moved by ``sets``."""
        return self.sets * self.step_s - self.late

    @property
    def offset_sigma(self) -> np.ndarray:
        """(C,) standard deviation of ``offset``, seconds: as stated, else :func:`in_step_sigma`."""
        return np.where(np.isfinite(self.sigma), self.sigma, in_step_sigma(self.step_s))

    def with_slips(self, slip: np.ndarray) -> np.ndarray:
        """Delay (T, C) of each image, in sets, by start and slip together.

        ``slip``: (T, C) slips of the images after they were moved ``sets`` sets earlier, see
        :func:`shift_images`.
        """
        last = len(slip) - 1
        place = np.clip(np.arange(len(slip))[:, None] - self.sets, 0, last)
        return np.take_along_axis(slip, place, 0) + self.sets.astype(slip.dtype)


def shift_images(values: np.ndarray, by: np.ndarray, fill: float = 0) -> np.ndarray:
    """Values (T, C, ...) of images, moved ``by`` (C,) sets earlier.

    Row t of camera c of the result is row t + by[c]; ``fill`` if there is none.
    """
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
    """People by image."""
    starts: StartTimes
    """Delays of the cameras. Cameras in doubt show nobody."""

    @property
    def num_sets(self) -> int:
        """Number of sets."""
        return self.detections.num_sets

    def people(self, t: int, c: int) -> np.ndarray:
        """Keypoints (P, 135, 3) of the people in the image of camera c that shows set t."""
        image = t + int(self.starts.sets[c])
        if 0 <= image < self.num_sets and not self.starts.in_doubt[c]:
            return self.detections.people(image, c)
        return np.zeros((0, NUM_KEYPOINTS, 3))
