"""The verdict without truth that goes with an export: errors as stated, frame by frame, and what
each camera shows of the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import (
    IMAGE_MEASURES,
    HeldOutCamera,
    StatedError,
    held_out_cameras,
    stated_errors,
)
from intercap_core.output.export.numbers import listed

MEANING = (
    "held_in: medians over the frames that the camera judges, of the result; held_out: of a result "
    "fitted without the camera; shift_mm: how far a part is elsewhere without it"
)


@dataclass(frozen=True, eq=False)
class Verdict:
    """``stated`` of every judged part, ``by_frame`` (P, T) millimetres in their order, NaN where
    nothing is said; ``cameras`` that were held out."""

    stated: Sequence[StatedError]
    by_frame: np.ndarray
    cameras: Sequence[HeldOutCamera]

    @classmethod
    def of(cls, metrics: SequenceMetrics) -> Verdict:
        stated = stated_errors(metrics)
        by_frame = (
            1e3 * metrics.values["verdict/error_frame"] if stated else np.zeros((0, len(metrics)))
        )
        return cls(stated, by_frame, held_out_cameras(metrics))

    @property
    def said(self) -> list[int]:
        """Places of the parts of which an error is stated."""
        return [place for place, error in enumerate(self.stated) if not error.silent]

    def told(self) -> dict[str, Any]:
        """In the words of JSON."""
        return {
            "stated_error_mm": {
                error.part: {"mean": round(error.stated, 2), "factor": round(error.factor, 2)}
                for error in self.stated
                if not error.silent
            },
            "nothing_is_stated_of": {e.part: e.silent for e in self.stated if e.silent},
            "verdict_by_camera": [self._camera(one) for one in self.cameras],
        }

    def by_frame_told(self) -> dict[str, Any]:
        """Stated errors by part and frame, for JSON."""
        return {
            "stated_error_mm": {
                self.stated[place].part: listed(self.by_frame[place], 2) for place in self.said
            }
        }

    def whole(self) -> dict[str, Any]:
        """All of it, with what the words mean: a file of its own."""
        return {
            **self.told(),
            "meaning": MEANING,
            "by_frame": self.by_frame_told(),
            "frame": "none: sizes of errors",
            "units": "as each name or entry says",
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """As arrays, by the names that go with every export."""
        said = [self.stated[place] for place in self.said]
        found = {
            "stated_error_part": np.array([error.part for error in said]),
            "stated_error_mm": np.array([error.stated for error in said]),
            "stated_error_factor": np.array([error.factor for error in said]),
            "stated_error_by_frame_mm": self.by_frame[self.said],
        }
        if self.cameras:
            parts = list(self.cameras[0].shift_mm)
            found |= {
                "verdict_camera": np.array([one.camera for one in self.cameras]),
                "verdict_of": np.array([f"{view.of}, {view.unit}" for view in IMAGE_MEASURES]),
                "verdict_held_in": np.array([one.held_in for one in self.cameras]),
                "verdict_held_out": np.array([one.held_out for one in self.cameras]),
                "verdict_part": np.array(parts),
                "verdict_shift_mm": np.array(
                    [[one.shift_mm[part] for part in parts] for one in self.cameras]
                ),
            }
        return found

    @staticmethod
    def _camera(one: HeldOutCamera) -> dict[str, Any]:
        return {
            "camera": one.camera,
            **{
                view.key.removesuffix("_px").removesuffix("_m"): {
                    "of": view.of,
                    "unit": view.unit,
                    "held_in": listed(np.array(held_in), 3),
                    "held_out": listed(np.array(held_out), 3),
                }
                for view, held_in, held_out in zip(
                    IMAGE_MEASURES, one.held_in, one.held_out, strict=True
                )
            },
            "shift_mm": {p: listed(np.array(mm), 2) for p, mm in one.shift_mm.items()},
        }
