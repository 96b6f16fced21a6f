"""Figures of the held-out verdict from the metrics artefact: stated errors, true errors, cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from scipy.stats import spearmanr

from intercap_core.evaluation import figures
from intercap_core.evaluation.figures import Figures, SequenceMetrics


@dataclass(frozen=True)
class ImageMeasure:
    """A measure of how well an image agrees: the dataset's name within verdict/, what it is, the
    unit that it is told in, and how many of them the dataset's unit has."""

    key: str
    of: str
    unit: str
    scale: float


IMAGE_MEASURES = (
    ImageMeasure("keypoint_px", "keypoints of the body", "px", 1.0),
    ImageMeasure("person_m", "the person's points from the skin", "mm", 1e3),
    ImageMeasure("overlap", "the object's mask, intersection over union", "1", 1.0),
    ImageMeasure("object_depth_m", "the object's depth", "mm", 1e3),
)


@dataclass(frozen=True)
class HeldOutCamera:
    """Medians over the frames that the ``camera`` judges, in the order of ``IMAGE_MEASURES``: errors of the
    result (``held_in``) and of a fit without the camera (``held_out``); ``shift_mm`` by part, how
    far it is elsewhere without the camera (root mean square over frames). NaN = not known."""

    camera: str
    held_in: tuple[float, ...]
    held_out: tuple[float, ...]
    shift_mm: dict[str, float]


def held_out_cameras(sequence: SequenceMetrics) -> Sequence[HeldOutCamera]:
    """Of every camera that was held out; empty where none was."""
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
                view.scale * _median(values[f"verdict/{view.key}{end}"][judged, c])
                for view in IMAGE_MEASURES
            )
            for end in ("", "_held_out")
        )
        moved = {part: 1e3 * _rms(shift[place]) for place, part in enumerate(parts)}
        found.append(HeldOutCamera(str(camera), held_in, held_out, moved))
    return tuple(found)


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _rms(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


BAD_MM = 20.0  # a part of a sequence whose error is larger should not go unnoticed
WITHIN = 1.5  # a stated error within this factor of the true one tells it
# the figure against truth of each judged part
TRUE = {
    "body": "body_pve_mm",
    "hands": "hand_mpjpe_mm",
    "object": "object_translation_mm",
}


@dataclass(frozen=True)
class StatedError:
    """Of a sequence's ``part``: the ``stated`` error, millimetres, within ``factor`` of which four
    of five true errors are, and the ``true`` one over the frames of which it is stated; NaN where
    it is not known. ``silent``: why nothing is stated. ``repeated``: by how much the part is
    elsewhere where only the frames beside it are seen, odd from even and even from odd, in the mean
    over the same frames, millimetres; NaN where nothing was held out."""

    sequence: str
    part: str
    stated: float
    factor: float
    true: float
    silent: str = ""
    repeated: float = float("nan")


def stated_errors(sequence: SequenceMetrics) -> Sequence[StatedError]:
    """Of every judged part; empty where no verdict was asked for."""
    if sequence not in _known:
        _known[sequence] = _stated(sequence)
    return _known[sequence]


# Tables, figures and pages each ask for them, and those with truth take a while.
_known: WeakKeyDictionary[SequenceMetrics, tuple[StatedError, ...]] = WeakKeyDictionary()


def _stated(sequence: SequenceMetrics) -> tuple[StatedError, ...]:
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
    """The true error of a part, millimetres, over the frames (T,) of which an error is stated, all
    where it is stated of none; NaN without truth."""
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
    """The mean of ``verdict/repeated`` of the part at ``place``, millimetres, over the frames of
    which an error is stated, all where it is stated of none; NaN where it was not measured."""
    if "verdict/repeated" not in sequence.values:
        return float("nan")
    moved = sequence.values["verdict/repeated"][place]
    stated = np.isfinite(sequence.values["verdict/error_frame"][place])
    known = moved[np.isfinite(moved) & (stated if stated.any() else True)]
    return 1e3 * float(known.mean()) if len(known) else float("nan")


def mean_stated(sequences: Sequence[SequenceMetrics]) -> dict[str, float]:
    """Mean stated error of each part, millimetres, over the sequences of which one is stated."""
    found: dict[str, list[float]] = {}
    for error in (e for s in sequences for e in stated_errors(s)):
        if np.isfinite(error.stated):
            found.setdefault(error.part, []).append(error.stated)
    return {part: float(np.mean(values)) for part, values in found.items()}


def verdict_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """How stated errors tell the true ones, over sequences with truth; empty without.

    ``rank_correlation`` (Spearman) over sequences, by part and their mean; ``within_factor_share``
    of all parts of all sequences, ``bad_sequence_recall``: of those above BAD_MM the share that is
    stated to be above it. Where nothing is stated, nothing is counted but ``silent_share``.
    """
    found = [e for s in sequences for e in stated_errors(s) if np.isfinite(e.true)]
    said = [e for e in found if np.isfinite(e.stated)]
    if not said:
        return {}
    result: Figures = {"silent_share": 1 - len(said) / len(found)}
    ranks = []
    for part in TRUE:
        own = [e for e in said if e.part == part]
        if len(own) > 2:
            rank = float(spearmanr([e.stated for e in own], [e.true for e in own]).statistic)
            result[f"rank_correlation_{part}"] = rank
            ranks.append(rank)
    if ranks:
        result["rank_correlation"] = float(np.mean(ranks))
    stated, true = (np.array([getattr(e, name) for e in said]) for name in ("stated", "true"))
    ratio = np.maximum(stated / true, true / stated)
    result["within_factor_share"] = float((ratio < WITHIN).mean())
    bad = true > BAD_MM
    if bad.any():
        result["bad_sequence_recall"] = float((stated[bad] > BAD_MM).mean())
        result["bad_sequences"] = float(bad.sum())
    return result
