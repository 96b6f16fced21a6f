"""Where a detector's body points lie on the body: its definition of "hip" or "ankle".

Detectors mean points up to 3 cm apart by one name. Depth shows where they lie, frame by frame, so
that recordings with depth tell it to those without: their fitted offsets, averaged, are a table
that the fit of other recordings starts from, with how far people scatter about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.keypoints import BODY, KEYPOINT_NAMES
from intercap_core.body_fit.constants import (
    DEFINITION_FEWEST_PEOPLE,
    DEFINITION_SIGMA_M,
    OFFSET_SIGMA_M,
)
from intercap_core.errors import UserError
from intercap_core.inputs.files import MAX_SETTINGS_BYTES, Unreadable, read_text
from intercap_core.inputs.quotes import quoted
from intercap_core.schemas import BODY_FIT

POINTS = tuple(KEYPOINT_NAMES[BODY])
_COLUMNS = ("point", "x_mm", "y_mm", "z_mm", "sigma_mm")
_LEAST_SIGMA_MM = 0.01  # :meth:`Definition.write` has one decimal
_LARGEST_M = 0.1  # farther off it is another joint


@dataclass(frozen=True, eq=False)
class Definition:
    """``offsets`` (25,3) of the points from the body model's, metres, in the frames of their bones,
    and by how much each may be off, ``sigma`` (25,), metres along one coordinate."""

    offsets: np.ndarray
    sigma: np.ndarray

    @classmethod
    def unknown(cls) -> Definition:
        """The model's own points, to 10 mm."""
        return cls(np.zeros((len(POINTS), 3)), np.full(len(POINTS), OFFSET_SIGMA_M))

    @classmethod
    def read(cls, path: Path | None) -> Definition:
        """From a table that :meth:`write` wrote; None = unknown. Raises UserError, naming the line,
        for anything else."""
        if path is None:
            return cls.unknown()
        try:
            lines = read_text(path, MAX_SETTINGS_BYTES).splitlines()
        except Unreadable as error:
            raise UserError(
                f"{path}: no readable text ({error.reason}); name a table that "
                "'intercap keypoint-definition' wrote in body_fit.keypoint_definition, or remove "
                "the line"
            ) from None
        rows = [x.split("\t") for x in lines if x and not x.startswith("#")]
        if not rows or tuple(rows[0]) != _COLUMNS:
            raise UserError(
                f"{path}: columns are {quoted(rows[0]) if rows else 'missing'}, expected "
                f"{', '.join(_COLUMNS)}, split by tabs; write it by 'intercap keypoint-definition'"
            )
        found = {row[0]: _numbers(path, row) for row in rows[1:]}
        wrong = sorted(set(POINTS) ^ set(found))
        if wrong or len(rows) - 1 != len(POINTS):
            raise UserError(
                f"{path}: {len(rows) - 1} points, expected each of the {len(POINTS)} of the body "
                f"once ({quoted(wrong) if wrong else 'one is there twice'}); write it anew by "
                "'intercap keypoint-definition'"
            )
        values = 1e-3 * np.array([found[name] for name in POINTS])
        return cls(values[:, :3], values[:, 3])

    def write(self, path: Path, source: str) -> None:
        """Write the table; ``source`` is a comment in its first line."""
        lines = [f"# {source}", "\t".join(_COLUMNS)]
        for name, offset, sigma in zip(POINTS, self.offsets, self.sigma, strict=True):
            numbers = (f"{1e3 * value:.1f}" for value in (*offset, sigma))
            lines.append("\t".join((name, *numbers)))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n")


def _numbers(path: Path, row: Sequence[str]) -> list[float]:
    try:
        values = [float(cell) for cell in row[1:]]
    except ValueError:
        values = []
    size = np.abs(values).max() if len(values) == 4 else np.nan
    if not size <= 1e3 * _LARGEST_M or not values[3] > _LEAST_SIGMA_MM:
        raise UserError(
            f"{path}: point {quoted(row[0])} has {quoted(row[1:])}, expected three offsets and a "
            f"deviation above 0 in mm, at most {1e3 * _LARGEST_M:.0f}; write it anew by "
            "'intercap keypoint-definition'"
        )
    return values


def learnt(fits: Sequence[Path]) -> tuple[Definition, list[str]]:
    """What body_fit artefacts of recordings with depth say, and the people it comes from.

    Each person counts once: their recordings are averaged first. Raises UserError where fewer than
    three people were recorded with depth, as one person's shape is taken for the definition.
    """
    of_person: dict[str, list[np.ndarray]] = {}
    blind = []
    for path in fits:
        with artefacts.read(path, BODY_FIT) as fit:
            measured = np.isfinite(fit["cloud_residual"]).mean() > 0.5
            subject = str(fit.attributes["subject"])
            if measured:
                of_person.setdefault(subject, []).append(fit["keypoint_offsets"].astype(float))
            else:
                blind.append(str(fit.attributes["sequence"]))
    people = sorted(of_person)
    if len(people) < DEFINITION_FEWEST_PEOPLE:
        told = f"; without depth: {', '.join(blind)}" if blind else ""
        raise UserError(
            f"{len(people)} people with depth ({', '.join(people) or 'none'}), expected at least "
            f"{DEFINITION_FEWEST_PEOPLE}, since a definition cannot be told from one person's "
            f"shape{told}; run stage 'body_fit' of recordings of more people with depth"
        )
    means = np.stack([np.mean(of_person[name], axis=0) for name in people])
    scatter = np.sqrt(means.var(axis=0, ddof=1).mean(axis=1))
    return Definition(means.mean(axis=0), np.maximum(scatter, DEFINITION_SIGMA_M)), people
