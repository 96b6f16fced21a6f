"""Figures: summary numbers over several sequences, from their metrics; millimetres and degrees.

Keys of metrics are datasets of the metrics artefact. ``truth/<stage>/<key>`` is an error after a
stage. ``truth/<name>_floor`` is the distance of the true body or object from the measured points:
the lower bound of a correct fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.evaluation import contact, object_errors
from intercap_core.evaluation.known import Figures, finite, over_known
from intercap_core.evaluation.object_errors import ObjectErrors
from intercap_core.flags import PARTS, Flags
from intercap_core.schemas import BAD_BODY_M, CONTACT_M, METRICS, PER_VERTEX_METRICS
from intercap_core.stage_list import ESTIMATES

SUMMARY_TRUTH = (
    "body_pve_mm", "body_mpjpe_mm", "hand_mpjpe_mm", "object_translation_mm",
    "object_rotation_deg", "contact_region_f1", "contact_f1", "contact_recall",
    "acceleration_error",
)  # fmt: skip
SUMMARY_PENETRATION = (
    "mean_mm", "median_mm", "p98_mm", "share_le_5mm", "share_le_7mm", "share_le_20mm",
)  # fmt: skip
_PER_VERTEX = PER_VERTEX_METRICS | {"object_sample_points", "object_sample_contact"}


@dataclass(frozen=True, eq=False)
class SequenceMetrics:
    """One sequence's metrics artefact without its distances by vertex."""

    name: str
    """Name of the sequence."""
    subject: str
    """Name of the person."""
    object_: str
    """Name of the object; "" = none."""
    fps: float
    """Frames per second."""
    has_truth: bool
    """The recording is virtual and has a truth file."""
    values: dict[str, np.ndarray] = field(repr=False)
    """Values by dataset of the metrics artefact."""
    made_by: str = ""
    """Program that made an imported result; "" = this one."""
    physics_note: str = ""
    """What the physics of the object does not judge, and why; "" = nothing."""

    @classmethod
    def read(cls, path: Path) -> SequenceMetrics:
        """Read a metrics artefact; raises UserError if it cannot be read."""
        with artefacts.read(path, METRICS) as artefact:
            return cls.of(artefact)

    @classmethod
    def of(cls, artefact: Artefact) -> SequenceMetrics:
        """Read from an open metrics or summary artefact."""
        stated = artefact.attributes
        values = {
            key: artefact[key]
            for key in artefact.keys()  # noqa: SIM118 (not a dict)
            if key in METRICS.fields and key not in _PER_VERTEX
        }
        return cls(
            str(stated["sequence"]), str(stated["subject"]), str(stated["object"]),
            float(stated["fps"]), bool(stated["has_truth"]), values,
            str(stated.get("made_by", "")), str(stated.get("physics_note", "")),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.values["flagged"])

    @property
    def flags(self) -> Flags:
        """Flags by part."""
        return Flags(self.values["flagged"], [str(r) for r in self.values["flag_reason"]])

    @property
    def has_object(self) -> bool:
        """Whether the metrics have an object: one was recorded and found."""
        return "contact_frame" in self.values


def pooled(sequences: Sequence[SequenceMetrics], key: str) -> np.ndarray | None:
    """Dataset ``key`` of all sequences that have it, concatenated over frames; None if none has."""
    found = [s.values[key] for s in sequences if key in s.values]
    return np.concatenate(found) if found else None


def pooled_flags(sequences: Sequence[SequenceMetrics]) -> Flags:
    """Flags of all frames of one or more sequences."""
    flagged = np.concatenate([s.flags.flagged for s in sequences])
    return Flags(flagged, [reason for s in sequences for reason in s.flags.reasons])


def finite_median(values: np.ndarray) -> float:
    """Median of the finite values; NaN if there is none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def penetration_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """The paper's penetration figures over the contact frames, from the mean depth of each
    frame."""
    depth, touching = pooled(sequences, "penetration_mean"), pooled(sequences, "contact_frame")
    if depth is None or touching is None:
        return {}
    return contact.penetration_summary(depth, touching)


def _cloud_distances(sequences: Sequence[SequenceMetrics], dataset: str) -> Figures:
    """Mean of four datasets over all frames; ``dataset``: their name with a place for the part."""
    names = ("body", "object", "body_visible", "object_visible")
    return {f"{n}_mm": 1e3 * _over(sequences, dataset.format(n), np.nanmean) for n in names}


def cloud_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """Mean distances between meshes and measured points over all frames with a cloud."""
    return _cloud_distances(sequences, "{}_to_cloud")


def floor_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """The figures of :func:`cloud_figures` for the true poses (lower bounds); empty without
    truth."""
    return finite(_cloud_distances(sequences, "truth/{}_floor"))


def truth_figures(sequences: Sequence[SequenceMetrics], stage: str) -> Figures:
    """Errors after ``stage`` over all frames of the sequences with truth.

    Quantities that the stage does not estimate are omitted. Object errors are medians and 95th
    percentiles over the frames in which two or more cameras truly see the object. Accelerations are
    in millimetres per frame^2 at 30 fps. ``acceleration_error`` is the body's, or the object's if
    the stage has no body.
    """
    known = [s for s in sequences if s.has_truth]

    def over(key: str, how: Callable[[np.ndarray], Any] = np.nanmean, scale: float = 1e3) -> float:
        return scale * _over(known, f"truth/{stage}/{key}", how)

    figures: Figures = {
        "body_pve_mm": over("body_pve"),
        "body_mpjpe_mm": over("body_mpjpe"),
        "hand_mpjpe_mm": over("hand_mpjpe"),
        "hand_mpjpe_wrist_mm": over("hand_mpjpe_wrist"),
        "hand_grasp_mpjpe_mm": _hand_in_grasp(known, stage),
        **object_figures(known, stage),
        **_contact_figures(known, stage),
        "acceleration_body_mm": over("acceleration_body"),
        "acceleration_hands_mm": over("acceleration_hands"),
        "acceleration_object_mm": over("acceleration_object"),
        "joint_normalised_median": over("joint_normalised", np.nanmedian, 1.0),
    }
    body = figures["acceleration_body_mm"]
    figures["acceleration_error"] = body if np.isfinite(body) else figures["acceleration_object_mm"]
    return finite(figures)


def flag_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """Recall and precision of the flags for truly bad bodies and objects after ``joint``.

    ``bad_frames`` is the share of frames whose body or object is bad. ``..._with_physics``: objects
    that physics contradicts count as flagged too; omitted if physics was tested in no sequence.
    """
    flagged, physical, bad, bad_frames = [], [], [], []
    for s in sequences:
        if not s.has_truth:
            continue
        wrong = np.zeros((len(s), 2), bool)
        if "truth/joint/body_pve" in s.values:
            wrong[:, 0] = s.values["truth/joint/body_pve"] > BAD_BODY_M
        if "truth/joint/object_translation" in s.values:
            wrong[:, 1] = _object_errors(s, "joint").lost
        own = s.values["flagged"][:, [PARTS.index("body"), PARTS.index("object")]]
        flagged.append(own.ravel())
        contradicted = s.values.get("physics/bad", np.zeros(len(s), bool))
        physical.append((own | np.stack([np.zeros_like(contradicted), contradicted], 1)).ravel())
        bad.append(wrong.ravel())
        bad_frames.append(wrong.any(axis=1))
    if not bad:
        return {}
    true = np.concatenate(bad)
    result = {"bad_frames": float(np.concatenate(bad_frames).mean())}
    tested = any("physics/bad" in s.values for s in sequences)
    for found, suffix in ((flagged, ""), (physical, "_with_physics"))[: 1 + tested]:
        mask = np.concatenate(found)
        result[f"flag_recall{suffix}"] = contact.recall(mask, true)
        result[f"flag_precision{suffix}"] = contact.precision(mask, true)
    return result


def bad_frame_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """The figures of :func:`flag_figures` as ``bad_recall`` and ``bad_precision``, without unknown
    ones."""
    return {
        name.replace("flag_", "bad_"): value
        for name, value in flag_figures(sequences).items()
        if name.startswith("flag_") and np.isfinite(value)
    }


def extrinsics_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """Mean and worst true displacement of the cameras, millimetres.

    Evaluated for the given poses (``before``), after the scene stage (``after``) and after the
    joint fit (``joint``). Cameras without images and the master are excluded.
    """
    figures: Figures = {}
    for when in ("before", "after", "joint"):
        found = pooled(sequences, f"truth/extrinsics_{when}")
        if found is not None and np.isfinite(found).any():
            moved = 1e3 * found[np.isfinite(found)].astype(np.float64)
            figures[f"{when}_mean_mm"] = float(moved.mean())
            figures[f"{when}_worst_mm"] = float(moved.max())
    return figures


def contact_sweep(sequences: Sequence[SequenceMetrics], stage: str) -> dict[float, float]:
    """F1 of vertices in contact, by threshold of the distance in millimetres."""
    counts = pooled(sequences, f"truth/{stage}/vertex_contact_counts")
    if counts is None:
        return {}
    limits = next(s.values["truth/sweep"] for s in sequences if "truth/sweep" in s.values)
    return {
        round(1e3 * float(limit), 3): contact.f1(counts[:, i].sum(0))
        for i, limit in enumerate(limits)
    }


def _over(
    sequences: Sequence[SequenceMetrics], key: str, how: Callable[[np.ndarray], Any]
) -> float:
    """Apply ``how`` to dataset ``key`` over all frames; NaN if it is unknown everywhere."""
    values = pooled(sequences, key)
    return float("nan") if values is None else over_known(how, values.astype(np.float64))


def _hand_in_grasp(sequences: Sequence[SequenceMetrics], stage: str) -> float:
    """Hand error over the frames in which the hand truly touches the object, millimetres."""
    handling = [s for s in sequences if "truth/contact_region" in s.values]
    errors = pooled(handling, f"truth/{stage}/hand_mpjpe")
    touching = pooled(handling, "truth/contact_region")
    if errors is None or touching is None:
        return float("nan")
    # METRIC_REGIONS starts with the left and the right hand
    return 1e3 * over_known(np.mean, errors[touching[:, :2]])


def _object_errors(s: SequenceMetrics, stage: str) -> ObjectErrors:
    """Object errors after ``stage`` from the metrics of a sequence."""
    key = f"truth/{stage}/object_"
    of, true = s.values, "truth/object_"
    return ObjectErrors(
        sequence=s.name,
        object_=s.object_,
        fps=s.fps,
        translation=of[key + "translation"],
        rotation=of[key + "rotation"],
        turn=of[key + "turn"],
        centre=of[key + "centre"],
        true_centre=of[true + "centre"],
        views=of[true + "views"],
        moves=of[true + "moving"],
        flagged=of[key + "flagged"],
        normalised=of.get(key + "normalised"),
    )


def object_figures(sequences: Sequence[SequenceMetrics], stage: str) -> Figures:
    """The figures of :func:`object_errors.figures`, renamed as in this module's tables."""
    have = [s for s in sequences if f"truth/{stage}/object_translation" in s.values]
    found = object_errors.figures([_object_errors(s, stage) for s in have])
    names = {
        "translation_median_mm": "object_translation_mm",
        "translation_p95_mm": "object_translation_p95_mm",
        "rotation_median_deg": "object_rotation_deg",
        "rotation_p95_deg": "object_rotation_p95_deg",
        "normalised_median": "object_normalised_median",
    }
    return {names.get(key, key): value for key, value in found.items()}


def _contact_figures(sequences: Sequence[SequenceMetrics], stage: str) -> Figures:
    """F1 of regions, F1 of vertices, and recall of contact frames, by distance after ``stage``."""
    key = f"truth/{stage}/"
    have = [s for s in sequences if f"{key}region_contact" in s.values]
    if not have:
        return {}
    names = (
        f"{key}region_contact", "truth/contact_region", f"{key}vertex_contact_counts",
        f"{key}contact_frame", "truth/contact_frame",
    )  # fmt: skip
    found, true, counts, touching, truly = (
        np.concatenate([s.values[name] for s in have if name in s.values]) for name in names
    )
    at = list(contact.SWEEP_M).index(CONTACT_M)
    return {
        "contact_region_f1": contact.f1(contact.confusion(found.ravel(), true.ravel())),
        "contact_f1": contact.f1(counts[:, at].sum(0)),
        "contact_recall": contact.recall(touching, truly),
    }


def summary(dataset: str, sequences: Sequence[SequenceMetrics]) -> dict[str, Any]:
    """The content of summary.json; unknown figures are None."""
    truth = {}
    if any(s.has_truth for s in sequences):
        for stage in ESTIMATES:
            figures = truth_figures(sequences, stage)
            truth[stage] = {k: figures[k] for k in SUMMARY_TRUTH if k in figures}
    depth = penetration_figures(sequences)
    return _rounded(
        {
            "dataset": dataset,
            "sequences": len(sequences),
            "frames": sum(len(s) for s in sequences),
            "truth": truth,
            "penetration": {k: depth.get(k, float("nan")) for k in SUMMARY_PENETRATION},
            "vertex_to_cloud": cloud_figures(sequences),
        }
    )


def _rounded(value: Any) -> Any:
    """Round to six significant digits; NaN becomes None (null in JSON)."""
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, float):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value
