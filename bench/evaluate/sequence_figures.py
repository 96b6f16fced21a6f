"""Figures of sequences with truth: slip, planted feet, and the contact that the joint stage states.

"Stated" contact is the probability that the joint stage itself computes. Contact by the distance of
the fitted meshes is evaluated in :mod:`intercap_core.evaluation.contact`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.evaluate.part import grouped
from intercap_core.evaluation import contact, motion
from intercap_core.evaluation.contact_figures import RELIABILITY_BINS, reliability, stated_and_true
from intercap_core.evaluation.figures import SequenceMetrics, object_figures, pooled
from intercap_core.evaluation.known import Figures, finite, over_known
from intercap_core.schemas import METRIC_REGIONS


def detected_figures(
    probability: np.ndarray, true: np.ndarray, distance: np.ndarray, names: Sequence[str]
) -> dict[str, float]:
    """Agreement of stated contact (probability above 0.5) with true contact.

    Returns, with the prefix ``contact_detected_``:

    - ``precision``, ``recall``, ``f1``: over all frames and regions;
    - ``near_precision``: precision among the regions truly nearer than 30 mm;
    - ``<region>_f1``: F1 of each region that is ever in true contact;
    - ``worst_region_f1``: the least of these;
    - ``brier``: Brier score, the mean squared error of the probability;
    - ``calibration_error``: see :func:`calibration_error`.

    Args:
        probability: (N, R) stated by the joint stage.
        true: (N, R) true contact.
        distance: (N, R) true distance of each region from the object, metres.
        names: the R regions.
    """
    found = probability > 0.5
    counts = contact.confusion(found.T, true.T)
    near = distance < 0.03
    figures = {
        "contact_detected_precision": contact.precision(found, true),
        "contact_detected_recall": contact.recall(found, true),
        "contact_detected_f1": contact.f1(counts.sum(0)),
        "contact_detected_near_precision": contact.precision(found[near], true[near]),
        "contact_detected_brier": float(np.mean((probability - true) ** 2)),
        "contact_detected_calibration_error": calibration_error(probability, true),
    }
    touching = [r for r in range(len(names)) if true[:, r].any()]
    if touching:
        by_region = {names[r]: contact.f1(counts[r]) for r in touching}
        figures["contact_detected_worst_region_f1"] = min(by_region.values())
        figures |= {f"contact_detected_{name}_f1": value for name, value in by_region.items()}
    return figures


def calibration_error(probability: np.ndarray, true: np.ndarray) -> float:
    """Expected calibration error: mean |stated - true| over the bins of uncertain statements.

    The first and last bin are excluded: nearly all regions are certainly free, and would make every
    error seem small.
    """
    open_ = (probability >= RELIABILITY_BINS[1]) & (probability < RELIABILITY_BINS[-2])
    if not open_.any():
        return float("nan")
    found = reliability(probability[open_], true[open_])
    return float(np.average(np.abs(found.stated - found.true), weights=found.count))


def hold_figures(sequences: Sequence[SequenceMetrics], stage: str) -> Figures:
    """Figures of slip, planted feet and joint errors after ``stage``; undefined ones are omitted.

    - ``joints_constant_mm``, ``joints_varying_mm``: RMS joint errors, split into the mean of a
      sequence and the deviation from it;
    - ``fingertip_touching_mm``: error of the fingertips of truly touching hands;
    - ``acceleration_feet_mm``: error, millimetres per frame^2 at 30 fps;
    - ``slip_mm_s``: sliding of touching skin, mean over objects of the means over their frames;
    - ``planted_mm_s``, ``floor_mm``: speed and height error of soles that truly carry weight;
    - ``foot_swing_mm``: error of soles while the foot swings;
    - ``foot_lift_frames``: mean absolute delay of lifts of a foot.
    """
    key = f"truth/{stage}/"
    have = [s for s in sequences if f"{key}fingertips" in s.values]
    if not have:
        return {}
    figures: Figures = _joint_figures(have, key)
    handling = [s for s in have if "truth/contact_region" in s.values]
    tips, touching = pooled(handling, f"{key}fingertips"), pooled(handling, "truth/contact_region")
    if tips is not None and touching is not None:
        # METRIC_REGIONS starts with the left and the right hand
        figures["fingertip_touching_mm"] = 1e3 * _mean(tips[touching[:, :2]])
    figures["acceleration_feet_mm"] = 1e3 * _mean(pooled(have, f"{key}acceleration_feet"))
    slips = slip_by_object(have, stage)
    figures["slip_mm_s"] = _mean(np.array(list(slips.values())))
    figures["planted_mm_s"] = 1e3 * _mean(pooled(have, f"{key}planted_speed"))
    figures["floor_mm"] = 1e3 * _mean(pooled(have, f"{key}planted_height"))
    figures["foot_swing_mm"] = 1e3 * _mean(pooled(have, f"{key}foot_swing"))
    lags = [lag for s in have if "truth/standing" in s.values for lag in _lift_lags(s, stage)]
    figures["foot_lift_frames"] = over_known(np.mean, np.abs(lags))
    return finite(figures)


def slip_by_object(sequences: Sequence[SequenceMetrics], stage: str) -> dict[str, float]:
    """Mean slip over the frames with true contact, by object, mm/s."""
    found = {}
    for name, some in grouped(sequences, "object_").items():
        slip = pooled(some, f"truth/{stage}/slip")
        if slip is not None and np.isfinite(slip).any():
            found[name] = 1e3 * float(np.nanmean(slip))
    return found


def stated_contact_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """Agreement of the contact that the joint stage states with true contact."""
    found = stated_and_true(sequences)
    return {} if found is None else finite(detected_figures(*found, METRIC_REGIONS))


def worse_objects(sequences: Sequence[SequenceMetrics]) -> list[str]:
    """Objects whose pose error is larger after ``joint`` than after ``object_track``.

    Compared are median and 95th percentile of translation and rotation. Larger means by more than
    5 %, and by more than 0.2 mm or 0.1 degrees.
    """
    limits = {
        "object_translation_mm": 0.2,
        "object_translation_p95_mm": 0.2,
        "object_rotation_deg": 0.1,
        "object_rotation_p95_deg": 0.1,
    }
    worse = []
    for name, some in grouped([s for s in sequences if s.has_truth], "object_").items():
        before, after = (object_figures(some, stage) for stage in ("object_track", "joint"))
        if any(
            after[key] - before[key] > max(0.05 * before[key], limit)
            for key, limit in limits.items()
            if key in before and key in after
        ):
            worse.append(name)
    return worse


def _joint_figures(sequences: Sequence[SequenceMetrics], key: str) -> Figures:
    """RMS of the sequences' mean joint errors, and RMS of the deviations from these means.

    Errors are vectors (T, 22, 3); the mean is over the T frames of a sequence, weighted by T.
    """
    constant, varying, frames = 0.0, 0.0, 0
    for s in sequences:
        offset = s.values[f"{key}joint_offset"].astype(np.float64)
        mean = offset.mean(0)
        constant += len(offset) * float((mean**2).sum(-1).mean())
        varying += float(((offset - mean) ** 2).sum(-1).mean(-1).sum())
        frames += len(offset)
    return {
        "joints_constant_mm": 1e3 * float(np.sqrt(constant / frames)),
        "joints_varying_mm": 1e3 * float(np.sqrt(varying / frames)),
    }


def _lift_lags(s: SequenceMetrics, stage: str) -> list[float]:
    """Delay, frames, of the fitted foot at each true lift of a foot; negative = early."""
    fitted, true = s.values[f"truth/{stage}/foot_centre"], s.values["truth/foot_centre"]
    standing = s.values["truth/standing"]
    return [
        lag
        for foot in range(2)
        for lag in motion.motion_onset_lags(
            fitted[:, foot], true[:, foot], ~standing[:, foot], s.fps
        )
    ]


def _mean(values: np.ndarray | None) -> float:
    return float("nan") if values is None else over_known(np.nanmean, values.astype(np.float64))
