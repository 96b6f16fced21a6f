"""Errors of one tracked object over a recording, and the figures of many such recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.evaluation import contact, motion, object_pose
from intercap_core.evaluation.known import Figures, over_known
from intercap_core.geometry.solve.time_series import runs


@dataclass(frozen=True, eq=False)
class ObjectErrors:
    """Errors of one object over T frames; NaN = unknown."""

    sequence: str
    """Name of the sequence."""
    object_: str
    """Name of the object."""
    fps: float
    """Frames per second."""
    translation: np.ndarray
    """(T,) error of the centre of mass, metres; infinite if the object was never found."""
    rotation: np.ndarray
    """(T,) error, the least over the symmetry group, degrees; infinite as above."""
    turn: np.ndarray
    """(T,) error of the rotation since the frame before, degrees."""
    centre: np.ndarray
    """(T, 3) fitted centre of mass, metres."""
    true_centre: np.ndarray
    """(T, 3) true centre of mass, metres."""
    views: np.ndarray
    """(T,) number of cameras that truly see the object."""
    moves: np.ndarray
    """(T,) bool: the object truly moves."""
    flagged: np.ndarray
    """(T,) bool: the stage marked the frame as unreliable."""
    add_s: np.ndarray | None = None
    """(T,) ADD-S over the object's diameter, see :func:`add_s`."""
    mssd: np.ndarray | None = None
    """(T,) MSSD over the object's diameter, see :func:`mssd`."""
    normalised: np.ndarray | None = None
    """(T,) translation error over its expected size; median 1 if the stated covariance is right."""
    normalised_turn: np.ndarray | None = None
    """(T,) the same for the rotation error (not for :attr:`turn`)."""

    @property
    def lost(self) -> np.ndarray:
        """Mask (T,) of the frames in which the pose is truly lost."""
        return object_pose.lost(self.translation, self.rotation)


def figures(recordings: Sequence[ObjectErrors]) -> Figures:
    """Figures over several recordings, millimetres and degrees.

    Errors of translation and rotation are over the frames in which two or more cameras truly see
    the object; all other figures are over all frames.

    - ``lost_unnoticed_share``: share of frames that are lost and not flagged;
    - ``add_s_recall``: share of frames with ADD-S below 10 % of the diameter;
    - ``mssd_recall``: recall of MSSD averaged over thresholds of 5 % to 50 % of the diameter;
    - ``first_frame_success``: share of recordings with a correct pose in the first frame in which
      the object is visible;
    - ``recovered_share``: share of the runs of lost frames that end before the recording does.
    """
    if not recordings:
        return {}
    seen = _pooled(recordings, "views") >= 2
    lost, flagged = (_pooled(recordings, name) for name in ("lost", "flagged"))
    first = [object_pose.first_seen_found(r.translation, r.rotation, r.views) for r in recordings]
    ended = [last + 1 < len(r.lost) for r in recordings for _, last in runs(r.lost)]
    found: Figures = {
        "lost_share": float(lost.mean()),
        "lost_unnoticed_share": float((lost & ~flagged).mean()),
        "flagged_share": float(flagged.mean()),
        "flag_precision": contact.precision(flagged, lost),
        "add_s_recall": over_known(np.mean, _pooled(recordings, "add_s") < 0.1),  # usual threshold
        # recall averaged over the thresholds of the BOP challenge 2019
        "mssd_recall": over_known(
            np.mean, _pooled(recordings, "mssd")[:, None] < np.arange(1, 11) * 0.05
        ),
        "first_frame_success": over_known(np.mean, [f for f in first if f is not None]),
        "recovered_share": over_known(np.mean, ended),
    }
    for key, unit, scale in (("translation", "mm", 1e3), ("rotation", "deg", 1.0)):
        values = scale * _pooled(recordings, key)[seen]
        found[f"{key}_median_{unit}"] = over_known(np.median, values)
        with np.errstate(invalid="ignore"):  # errors are infinite if the object was never found
            found[f"{key}_p95_{unit}"] = over_known(np.percentile, values, 95)
    for key in ("normalised", "normalised_turn"):
        ratios = _pooled(recordings, key).astype(np.float64)
        found[f"{key}_median"] = over_known(np.nanmedian, ratios)
    found |= _jitter_and_lag(recordings)
    return {key: value for key, value in found.items() if not np.isnan(value)}


def _pooled(recordings: Sequence[ObjectErrors], name: str) -> np.ndarray:
    """Values of the recordings that have them."""
    parts = [part for r in recordings if (part := getattr(r, name)) is not None]
    return np.concatenate(parts) if parts else np.zeros(0)


def _jitter_and_lag(recordings: Sequence[ObjectErrors]) -> Figures:
    """Jitter over all frames at rest, and delay of the track at the onset of motion."""
    steps, turns, lags = [np.zeros(0)], [np.zeros(0)], []
    for r in recordings:
        resting = motion.resting_steps(r.moves)
        steps.append(motion.steps(r.centre, r.true_centre)[resting])
        turns.append(r.turn[1:][resting])
        lags += motion.motion_onset_lags(r.centre, r.true_centre, r.moves, r.fps)
    squares = [over_known(np.mean, np.concatenate(values) ** 2) for values in (steps, turns)]
    return {
        "rest_jitter_mm": 1e3 * float(np.sqrt(squares[0])),
        "rest_jitter_deg": float(np.sqrt(squares[1])),
        "motion_onset_frames": over_known(np.mean, np.abs(lags)),
        "motion_onset_late_frames": over_known(np.mean, lags),
    }
