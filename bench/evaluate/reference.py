"""Regression gate of the quick evaluation: figures compared with a recorded reference.

The reference file lists the gated figures. Each entry states the recorded value, the spread within
which the figure may vary, and which direction is better. On one machine a run is deterministic, but
processors round differently and the fits amplify the difference; the spread covers that variation.
Times and memory are not gated. docs/evaluation.md states how the spreads were measured.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from intercap_core.commands.console import ListTable, standard_console
from intercap_core.errors import UserError

REFERENCE = Path("bench/reference-quick.json")


class GateResult(StrEnum):
    """Result of comparing one figure with its reference."""

    SAME = "same"  # within the spread
    BETTER = "better"  # improved by more than the spread
    WORSE = "worse"  # degraded by more than the spread
    MISSING = "missing"  # the run has no such figure, or it is not finite


FAILING = (GateResult.WORSE, GateResult.MISSING)


class GatedFigure(BaseModel):
    """One entry of the reference file."""

    value: float
    """The recorded figure, in the unit that ends its key."""
    spread: float = Field(ge=0)
    """Variation that is tolerated, same unit."""
    better: Literal["lower", "higher"]
    """Direction in which a change is an improvement."""

    def judge(self, now: float | None) -> GateResult:
        """Compare the figure of a run (None = not measured) with the recorded value."""
        if now is None or not math.isfinite(now):
            return GateResult.MISSING
        loss = self.value - now if self.better == "higher" else now - self.value
        if loss > self.spread:
            return GateResult.WORSE
        return GateResult.BETTER if loss < -self.spread else GateResult.SAME


Reference = Mapping[str, GatedFigure]  # by key of the evaluation's JSON, "area.measure"


def read_reference(path: Path = REFERENCE) -> Reference:
    """Gated figures of a reference file, in the file's order.

    Raises UserError if the file is missing or an entry is malformed.
    """
    try:
        return TypeAdapter(dict[str, GatedFigure]).validate_json(path.read_bytes())
    except FileNotFoundError:
        raise UserError(
            f"{path}: no such file; the quick evaluation is compared with it, restore it with "
            f"`git checkout {path}`"
        ) from None
    except ValidationError as error:
        raise UserError(
            f"{path}: cannot be read as a reference ({error}); expected for each figure "
            '{"value": number, "spread": number of at least 0, "better": "lower" or "higher"}'
        ) from None


def passes_gate(figures: Mapping[str, float], reference: Reference) -> bool:
    """Print every gated figure with its verdict; return whether none is worse or missing."""
    console = standard_console()
    table = ListTable("figure", "reference", "now", "spread", "result")
    table.title = "regression gate"
    failing = []
    for key, figure in reference.items():
        now = figures.get(key)
        result = figure.judge(now)
        if result in FAILING:
            failing.append(key)
        table.add_row(
            key,
            f"{figure.value:.3f}",
            "" if now is None else f"{now:.3f}",
            f"{figure.spread:.3f}",
            result.value,
        )
    console.print(table)
    if failing:
        print(
            f"regression gate failed: {len(failing)} of {len(reference)} figures are worse than "
            f"their reference by more than the spread, or missing: {', '.join(failing)}"
        )
    else:
        print(f"regression gate passed: {len(reference)} figures")
    return not failing


def update_reference(figures: Mapping[str, float], path: Path = REFERENCE) -> None:
    """Record the figures of a run as the new values of a reference file; spreads stay.

    Raises UserError if the file is malformed or the run lacks one of its figures.
    """
    reference = read_reference(path)
    missing = [
        key
        for key, figure in reference.items()
        if figure.judge(figures.get(key)) == GateResult.MISSING
    ]
    if missing:
        raise UserError(
            f"{path}: not updated, the run has no figure {', '.join(missing)}; remove the entries "
            "from the file if they are no longer measured"
        )
    entries = {
        key: json.dumps(figure.model_dump() | {"value": figures[key]})
        for key, figure in reference.items()
    }
    lines = ",\n".join(f" {json.dumps(key)}: {entry}" for key, entry in entries.items())
    path.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
