"""The verdict without truth, camera by camera: what each shows of the result, and of a result that
was fitted without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.evaluation.figures import SequenceMetrics


@dataclass(frozen=True)
class View:
    """A measure of how well an image agrees: the dataset's name within verdict/, what it is, the
    unit that it is told in, and how many of them the dataset's unit has."""

    key: str
    of: str
    unit: str
    scale: float


VIEWS = (
    View("keypoint_px", "keypoints of the body", "px", 1.0),
    View("person_m", "the person's points from the skin", "mm", 1e3),
    View("overlap", "the object's mask, intersection over union", "1", 1.0),
    View("object_depth_m", "the object's depth", "mm", 1e3),
)


@dataclass(frozen=True)
class CameraVerdict:
    """Medians over the frames that the ``camera`` judges, in the order of ``VIEWS``: errors of the
    result (``held_in``) and of a fit without the camera (``held_out``); ``shift_mm`` by part, how
    far it is elsewhere without the camera (root mean square over frames). NaN = not known."""

    camera: str
    held_in: tuple[float, ...]
    held_out: tuple[float, ...]
    shift_mm: dict[str, float]


def camera_verdicts(sequence: SequenceMetrics) -> Sequence[CameraVerdict]:
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
                for view in VIEWS
            )
            for end in ("", "_held_out")
        )
        moved = {part: 1e3 * _rms(shift[place]) for place, part in enumerate(parts)}
        found.append(CameraVerdict(str(camera), held_in, held_out, moved))
    return tuple(found)


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _rms(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
