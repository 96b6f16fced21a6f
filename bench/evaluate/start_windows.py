"""Camera starts in windows of a recording: all cameras in step, or the start of one camera cut.

The true starts are removed first. Windows are then synchronised as they are, or with the images of
one camera some sets late or early.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.evaluation.known import finite, over_known
from intercap_core.evaluation.truth import match_times
from intercap_core.formats.detections.read import Detections, PeopleOfImages
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.moments import find_moments
from intercap_core.schemas import TRUTH

WINDOWS_S = (1.0, 2.0, 5.0)
CUTS = (3, 5, 8, 12, 17, 22, 30, 40)  # sets; at most half of a window


@dataclass(frozen=True, eq=False)
class WindowErrors:
    """Cameras of the windows of one recording, without the master: N in step, and M cut ones."""

    moved: np.ndarray
    """(N,) bool: in step, but the estimated delay is wrong by at least half a set."""
    silent: np.ndarray
    """(M,) bool: cut, the delay is wrong by at least half a set, and no note says so."""


def window_figures(recordings: Sequence[WindowErrors]) -> dict[str, float]:
    """Share of cameras in step that were moved, and of cut cameras that are silently wrong."""
    moved, silent = ([w for r in recordings for w in getattr(r, n)] for n in ("moved", "silent"))
    return finite(
        {
            "in_step_moved_share": over_known(np.mean, moved),
            "starts_silent_share": over_known(np.mean, silent),
        }
    )


@dataclass(frozen=True, eq=False)
class Recording:
    """Detections of a recording with its true delays."""

    people: PeopleOfImages
    """People by image."""
    rig: Rig
    """Cameras."""
    master: int
    """Index of the master."""
    times: np.ndarray
    """(T,) seconds of the sets."""
    fps: float
    """Sets per second."""
    available: np.ndarray
    """(T, C) bool, the set has an image of the camera."""
    late: np.ndarray
    """(T, C) true delay of each image, sets, relative to the master's median."""

    @classmethod
    def read(cls, frames: Path, detections: Path, truth: Path) -> Recording:
        """Read the artefacts; raises UserError if one cannot be read."""
        with Frames.open(frames) as source, artefacts.read(truth, TRUTH) as true:
            names, master = source.rig.names, source.rig.names.index(source.master)
            order = [true.text("camera_names").index(name) for name in names]
            at = match_times(truth, true["times"], source.time_s, source.fps)
            late = true["slip"][at][:, order] - source.fps * true["time_offset"][order]
            late = late - np.median(late[:, master])
            return cls(
                Detections.load(detections), source.rig, master, source.time_s, source.fps,
                source.available, late,
            )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Window:
    """``num_sets`` sets of a recording with shifted cameras."""

    recording: Recording
    image: np.ndarray
    """(T, C) set of the recording whose image is shown; -1 = none."""

    @classmethod
    def of(cls, recording: Recording, first: int, sets: int, shift: np.ndarray) -> _Window:
        """Sets ``first`` to ``first + sets - 1``; a camera shows images of ``shift`` sets later."""
        image = first + np.arange(sets)[:, None] + shift
        exists = (image >= 0) & (image < len(recording.times))
        shown = np.clip(image, 0, len(recording.times) - 1)
        exists &= recording.available[shown, np.arange(len(shift))]
        return cls(recording, np.where(exists, image, -1))

    @property
    def num_sets(self) -> int:
        """Number of sets."""
        return len(self.image)

    def people(self, t: int, c: int) -> np.ndarray:
        """Keypoints (P, 135, 3) of the people in the image of camera c."""
        if self.image[t, c] < 0:
            return np.zeros((0, 135, 3))
        return self.recording.people.people(int(self.image[t, c]), c)

    def errors(self, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whether each camera's delay is wrong by half a set, and whether a note names it (C,)."""
        recording, available = self.recording, self.image >= 0
        times = recording.times[: self.num_sets]
        found = find_moments(
            self, recording.rig, times, recording.fps, available, master=recording.master
        )
        true = np.take_along_axis(recording.late, np.maximum(self.image, 0), 0) - shift
        error = found.slip - recording.fps * found.timing.offset - true
        middle = np.nanmedian(np.where(available, error, np.nan), axis=0)
        reasons = found.starts.undetermined or ("",) * len(shift)
        named = found.starts.in_doubt | np.array([bool(reason) for reason in reasons])
        wrong = ~(np.abs(middle - middle[recording.master]) < 0.5)
        return wrong, named | found.starts.too_short


def measure_windows(recording: Recording) -> WindowErrors:
    """Errors of the delays in windows of the lengths :data:`WINDOWS_S` that fit, at random places.

    The longest has all cameras in step. In each, a random camera is cut by one of :data:`CUTS`.
    """
    rng = np.random.default_rng(0)
    others = np.delete(np.arange(len(recording.rig)), recording.master)
    in_step = np.rint(np.median(recording.late, axis=0)).astype(int)
    lengths = [round(seconds * recording.fps) for seconds in WINDOWS_S]
    lengths = [sets for sets in lengths if sets <= len(recording.times)]
    moved, silent = np.zeros(0, bool), []
    for sets in lengths:
        first = int(rng.integers(len(recording.times) - sets + 1))
        cut = int(rng.choice([cut for cut in CUTS if cut <= sets / 2]) * rng.choice([-1, 1]))
        camera = rng.choice(others)
        shift = np.where(np.arange(len(recording.rig)) == camera, in_step + cut, in_step)
        wrong, named = _Window.of(recording, first, sets, shift).errors(shift)
        silent.append(wrong[camera] & ~named[camera])
        if sets == lengths[-1]:
            moved = _Window.of(recording, first, sets, in_step).errors(in_step)[0][others]
    return WindowErrors(moved, np.array(silent, bool))
