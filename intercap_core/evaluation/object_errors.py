"""Errors of one tracked object over a recording, and the figures of many such recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.evaluation import motion, object_pose
from intercap_core.geometry.solve.time_series import runs

Figures = dict[str, float]


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
    seen = np.concatenate([r.views >= 2 for r in recordings])
    lost = np.concatenate([r.lost for r in recordings])
    flagged = np.concatenate([r.flagged for r in recordings])
    found: Figures = {
        "lost_share": float(lost.mean()),
        "lost_unnoticed_share": float((lost & ~flagged).mean()),
        "flagged_share": float(flagged.mean()),
    }
    if flagged.any():
        found["flag_precision"] = float((lost & flagged).sum() / flagged.sum())
    for key, unit, scale, errors in (
        ("translation", "mm", 1e3, [r.translation for r in recordings]),
        ("rotation", "deg", 1.0, [r.rotation for r in recordings]),
    ):
        values = scale * np.concatenate(errors)[seen]
        if len(values):
            found[f"{key}_median_{unit}"] = float(np.median(values))
            with np.errstate(invalid="ignore"):  # errors are infinite if the object was never found
                found[f"{key}_p95_{unit}"] = float(np.percentile(values, 95))
    add, worst = _pooled([r.add_s for r in recordings]), _pooled([r.mssd for r in recordings])
    if len(add):
        found["add_s_recall"] = float((add < 0.1).mean())  # the usual threshold
        # recall averaged over the thresholds of the BOP challenge 2019
        found["mssd_recall"] = float((worst[:, None] < np.arange(1, 11) * 0.05).mean())
    for name, errors_ in (
        ("normalised_median", [r.normalised for r in recordings]),
        ("normalised_turn_median", [r.normalised_turn for r in recordings]),
    ):
        ratios = _pooled(errors_)
        if np.isfinite(ratios).any():
            found[name] = float(np.nanmedian(ratios))
    first = [object_pose.first_seen_found(r.translation, r.rotation, r.views) for r in recordings]
    counted = [f for f in first if f is not None]
    if counted:
        found["first_frame_success"] = float(np.mean(counted))
    ended = [last + 1 < len(r.lost) for r in recordings for _, last in runs(r.lost)]
    if ended:
        found["recovered_share"] = float(np.mean(ended))
    return found | _jitter_and_lag(recordings)


def _pooled(parts: Sequence[np.ndarray | None]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *(part for part in parts if part is not None)])


def _jitter_and_lag(recordings: Sequence[ObjectErrors]) -> Figures:
    """Jitter over all frames at rest, and delay of the track at the onset of motion."""
    found: Figures = {}
    steps, turns, lags = [np.zeros(0)], [np.zeros(0)], []
    for r in recordings:
        resting = motion.resting_steps(r.moves)
        steps.append(motion.steps(r.centre, r.true_centre)[resting])
        turns.append(r.turn[1:][resting])
        lags += motion.motion_onset_lags(r.centre, r.true_centre, r.moves, r.fps)
    for unit, values, scale in (("mm", steps, 1e3), ("deg", turns, 1.0)):
        pooled = np.concatenate(values).astype(np.float64)
        if len(pooled):
            found[f"rest_jitter_{unit}"] = scale * float(np.sqrt((pooled**2).mean()))
    if lags:
        found["motion_onset_frames"] = float(np.abs(lags).mean())
        found["motion_onset_late_frames"] = float(np.mean(lags))
    return found
