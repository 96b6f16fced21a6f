"""Figures of the verdict: stated and true errors of each part, and errors by camera.

The *verdict* on a sequence is an estimate of its errors without truth (:mod:`.judge`): errors in
cameras that were held out of the fit, and a *stated* error of each part (body, hands, object).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from intercap_core.evaluation import figures
from intercap_core.evaluation.figures import SequenceMetrics, finite_median
from intercap_core.evaluation.known import Figures, finite, over_known


@dataclass(frozen=True)
class ImageMeasure:
    """A measure of the agreement between a result and an image."""

    key: str
    """Dataset of the metrics artefact, without the prefix verdict/."""
    of: str
    """Description of the measure."""
    unit: str
    """Unit in which it is reported."""
    scale: float
    """Factor from the dataset's unit to ``unit``."""


IMAGE_MEASURES = (
    ImageMeasure("keypoint_px", "keypoints of the body", "px", 1.0),
    ImageMeasure("person_m", "the person's points from the skin", "mm", 1e3),
    ImageMeasure("overlap", "the object's mask, intersection over union", "1", 1.0),
    ImageMeasure("object_depth_m", "the object's depth", "mm", 1e3),
)


@dataclass(frozen=True)
class HeldOutCamera:
    """Errors in one camera, medians over the frames for which it was held out; NaN = unknown."""

    camera: str
    """Name of the camera."""
    held_in: tuple[float, ...]
    """Errors of the result, which used the camera, in the order and units of IMAGE_MEASURES."""
    held_out: tuple[float, ...]
    """Errors of a fit without the camera, same order."""
    shift_mm: dict[str, float]
    """RMS displacement of each part if the camera is left out, over all frames."""


def held_out_cameras(sequence: SequenceMetrics) -> Sequence[HeldOutCamera]:
    """The figures of every camera that was held out; empty if none was."""
    values = sequence.values
    if "verdict/held_camera" not in values:
        return ()
    parts = [str(part) for part in values["verdict/part_names"]]
    found = []
    for c, camera in enumerate(values["verdict/camera_names"]):
        shift = values["verdict/shift"][:, c]
        if not np.isfinite(shift).any():
            continue
        judged = values["verdict/held_camera"] == c
        held_in, held_out = (
            tuple(
                view.scale * finite_median(values[f"verdict/{view.key}{end}"][judged, c])
                for view in IMAGE_MEASURES
            )
            for end in ("", "_held_out")
        )
        moved = {part: 1e3 * _rms(shift[place]) for place, part in enumerate(parts)}
        found.append(HeldOutCamera(str(camera), held_in, held_out, moved))
    return tuple(found)


def _rms(values: np.ndarray) -> float:
    """Root mean square of the finite values; NaN if there is none."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


WITHIN = 1.5  # factor within which a stated error counts as correct
# By part, the figure against truth that its stated error predicts.
TRUE = {
    "body": "body_pve_mm",
    "hands": "hand_mpjpe_mm",
    "object": "object_translation_mm",
}


@dataclass(frozen=True)
class StatedError:
    """Stated and true error of one part of a sequence, means over the frames with a stated
    error."""

    sequence: str
    """Name of the sequence."""
    part: str
    """"body", "hands" or "object"."""
    stated: float
    """Stated error, millimetres; NaN = none is stated."""
    factor: float
    """80 % of the true errors are within this factor of ``stated``."""
    true: float
    """True error, millimetres; NaN = no truth."""
    silent: str = ""
    """Reason why no error is stated; "" = one is stated."""
    repeated: float = float("nan")
    """Displacement if the images of every other frame are not used, millimetres."""

    @property
    def covers(self) -> bool:
        """Whether the true error is within the stated range; False if either is unknown."""
        return self.stated / self.factor <= self.true <= self.stated * self.factor


# Tables, figures and pages each need the stated errors, whose comparison with truth takes long.
@lru_cache(maxsize=256)
def stated_errors(sequence: SequenceMetrics) -> Sequence[StatedError]:
    """Stated errors of every part; empty if the metrics have no verdict."""
    values = sequence.values
    if "verdict/error" not in values:
        return ()
    return tuple(
        StatedError(
            sequence.name,
            str(part),
            1e3 * float(values["verdict/error"][place]),
            float(values["verdict/error_factor"][place]),
            _true(sequence, str(part), np.isfinite(values["verdict/error_frame"][place])),
            str(values["verdict/silent"][place]),
            _repeated(sequence, place),
        )
        for place, part in enumerate(values["verdict/part_names"])
    )


def _true(sequence: SequenceMetrics, part: str, stated: np.ndarray) -> float:
    """True error of a part, millimetres; NaN without truth.

    Mean over the frames in the mask ``stated`` (T,), over all frames if the mask is empty.
    """
    if not sequence.has_truth:
        return float("nan")
    judged = sequence
    if stated.any():
        some = {
            key: value[stated] if key.startswith("truth/") and len(value) == len(stated) else value
            for key, value in sequence.values.items()
            if np.ndim(value)
        }
        judged = replace(sequence, values=some)
    return figures.truth_figures([judged], "joint").get(TRUE[part], float("nan"))


def _repeated(sequence: SequenceMetrics, place: int) -> float:
    """Mean of ``verdict/repeated`` of the part at index ``place``, millimetres; NaN if unknown.

    Mean over the frames with a stated error, over all frames if there is none.
    """
    if "verdict/repeated" not in sequence.values:
        return float("nan")
    moved = sequence.values["verdict/repeated"][place]
    stated = np.isfinite(sequence.values["verdict/error_frame"][place])
    known = moved[np.isfinite(moved) & (stated if stated.any() else True)]
    return 1e3 * float(known.mean()) if len(known) else float("nan")


def mean_stated(sequences: Sequence[SequenceMetrics]) -> dict[str, float]:
    """Mean stated error of each part, millimetres, over the sequences that state one."""
    found: dict[str, list[float]] = {}
    for error in (e for s in sequences for e in stated_errors(s)):
        if np.isfinite(error.stated):
            found.setdefault(error.part, []).append(error.stated)
    return {part: float(np.mean(values)) for part, values in found.items()}


def verdict_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """Agreement of stated and true errors over the sequences with truth; empty without truth.

    One item is one part of one sequence.

    - ``silent_share``: share of items without a stated error; these count in no other figure.
    - ``rank_correlation``: Spearman's correlation of stated and true errors over sequences, for
      each part, and the mean of the parts.
    - ``within_factor_share``: share of items whose stated error is within the factor WITHIN of the
      true error.
    - ``coverage_<part>``: share of sequences whose true error is within the stated range.
    - ``range_factor_<part>``: median of the factor of that range.
    - ``bad_sequences``: number of items with a true error above 20 mm.
    - ``bad_sequence_recall``: share of these whose stated error is above 20 mm too.
    """
    from scipy.stats import spearmanr  # takes a second to import, which most processes do not need

    found = [e for s in sequences for e in stated_errors(s) if np.isfinite(e.true)]
    stating = [e for e in found if np.isfinite(e.stated)]
    if not stating:
        return {}
    result: Figures = {"silent_share": 1 - len(stating) / len(found)}
    ranks = []
    for part in TRUE:
        own = [e for e in stating if e.part == part]
        if own:
            result[f"coverage_{part}"] = float(np.mean([e.covers for e in own]))
            result[f"range_factor_{part}"] = float(np.median([e.factor for e in own]))
        if len(own) > 2:
            rank = float(spearmanr([e.stated for e in own], [e.true for e in own]).statistic)
            result[f"rank_correlation_{part}"] = rank
            ranks.append(rank)
    stated, true = (np.array([getattr(e, name) for e in stating]) for name in ("stated", "true"))
    ratio = np.maximum(stated / true, true / stated)
    bad_mm = 20.0
    bad = true > bad_mm
    if bad.any():
        result["bad_sequences"] = float(bad.sum())
    return result | finite(
        {
            "rank_correlation": over_known(np.mean, ranks),
            "within_factor_share": float((ratio < WITHIN).mean()),
            "bad_sequence_recall": over_known(np.mean, stated[bad] > bad_mm),
        }
    )
