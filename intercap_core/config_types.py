"""Types and the base class of settings, tables and annotations."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    field_validator,
)

from intercap_core.inputs.files import path_fault

# Larger values are probably millimetres: a capture volume is some metres wide.
MAX_POSITION_M = 50.0


def _metres(value: float) -> float:
    if abs(value) >= MAX_POSITION_M:
        raise ValueError(
            f"positions are in metres, below {MAX_POSITION_M:.0f}; this looks like millimetres"
        )
    return value


def _as_text(name: Any) -> Any:
    """Convert names that YAML reads as integers to text."""
    return str(name) if isinstance(name, int) and not isinstance(name, bool) else name


def _not_one_of(names: tuple[str, ...], use: str) -> AfterValidator:
    """Validator that refuses names that have another use."""

    def check(name: str) -> str:
        if name in names:
            raise ValueError(f"this name is reserved for {use}; choose another one")
        return name

    return AfterValidator(check)


Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_-]*$", max_length=80)]

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]

Positive = Annotated[float, Field(gt=0.0)]

RESERVED_SEQUENCES = ("export", "recordings", "site", "tables")  # other folders of the results

RESERVED_OBJECTS = ("person",)  # the class of people in detections and in COCO exports

Vector3 = tuple[float, float, float]

Radians = Annotated[float, Field(ge=-2 * math.pi, le=2 * math.pi)]

CameraName = Annotated[str, BeforeValidator(_as_text), Field(pattern=r"^[A-Za-z0-9_-]+$")]

Seconds = Annotated[float, Field(strict=True)]

SequenceName = Annotated[Name, _not_one_of(RESERVED_SEQUENCES, "a folder of the results")]

ObjectName = Annotated[Name, _not_one_of(RESERVED_OBJECTS, "people in detections and exports")]

Metres = Annotated[float, AfterValidator(_metres)]

Position = tuple[Metres, Metres, Metres]

FrameNumber = Annotated[int, Field(ge=0, strict=True)]

LayoutName = Literal["k4a", "ros", "intercap", "behave", "plain"]


class Model(BaseModel):
    """Base of all settings models: no unknown keys, finite numbers, valid paths, immutable."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        use_attribute_docstrings=True,
        allow_inf_nan=False,
        coerce_numbers_to_str=True,  # names such as camera 1
    )

    @field_validator("*")
    @classmethod
    def _paths(cls, value: Any) -> Any:
        fault = path_fault(value) if isinstance(value, Path) else None
        if fault is not None:
            raise ValueError(fault)
        return value
