"""A detector's definition of body keypoints such as "hip" or "ankle": offsets from the body model.

The points that two detectors call "hip" may be 3 cm apart. Depth makes the offsets observable.
Recordings with depth are averaged over people. The mean offsets and their standard deviation over
people are the prior for recordings without depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.keypoints import BODY, KEYPOINT_NAMES
from intercap_core.errors import UserError
from intercap_core.inputs.files import UnreadableFile, quoted, read_text
from intercap_core.schemas import BODY_FIT

POINTS = tuple(KEYPOINT_NAMES[BODY])
_COLUMNS = ("point", "x_mm", "y_mm", "z_mm", "sigma_mm")
# Of an offset without a definition, tuned on the studio: a detector's hip is 10 to 25 mm away from
# the model's (docs/decisions.md).
UNKNOWN_SIGMA_M = 0.010
FITTED_SIGMA_M = 0.003  # least value of a definition: offsets are fitted to 3 mm, measured


@dataclass(frozen=True, eq=False)
class Definition:
    """Prior of the offsets of the 25 body keypoints from those of the body model."""

    offsets: np.ndarray
    """(25, 3) mean, in the frames of the bones, metres."""
    sigma: np.ndarray
    """(25,) standard deviation along one coordinate, metres."""

    @classmethod
    def unknown(cls) -> Definition:
        """Return the keypoints of the model, with a standard deviation of 10 mm."""
        return cls(np.zeros((len(POINTS), 3)), np.full(len(POINTS), UNKNOWN_SIGMA_M))

    @classmethod
    def read(cls, path: Path | None) -> Definition:
        """Read a table that :meth:`write` wrote; None = unknown.

        Raises UserError if it is another file.
        """
        if path is None:
            return cls.unknown()
        try:
            lines = read_text(path).splitlines()
        except UnreadableFile as error:
            raise UserError(
                f"{path}: no readable text ({error.reason}); name a table that "
                "'intercap keypoint-definition' wrote in body_fit.keypoint_definition, or remove "
                "the line"
            ) from None
        rows = [x.split("\t") for x in lines if x and not x.startswith("#")]
        if not rows or tuple(rows[0]) != _COLUMNS:
            raise UserError(
                f"{path}: columns are {quoted(rows[0]) if rows else 'missing'}, expected "
                f"{', '.join(_COLUMNS)}, separated by tabs; write it by "
                "'intercap keypoint-definition'"
            )
        by_point = {row[0]: _numbers(path, row) for row in rows[1:]}
        wrong = sorted(set(POINTS) ^ set(by_point))
        if wrong or len(rows) - 1 != len(POINTS):
            raise UserError(
                f"{path}: {len(rows) - 1} points, expected each of the {len(POINTS)} of the body "
                f"once ({quoted(wrong) if wrong else 'a point is repeated'}); write it again by "
                "'intercap keypoint-definition'"
            )
        values = 1e-3 * np.array([by_point[name] for name in POINTS])
        return cls(values[:, :3], values[:, 3])

    def write(self, path: Path, source: str) -> None:
        """Write the table, with ``source`` as a comment in its first line."""
        lines = [f"# {source}", "\t".join(_COLUMNS)]
        for name, offset, sigma in zip(POINTS, self.offsets, self.sigma, strict=True):
            numbers = (f"{1e3 * value:.1f}" for value in (*offset, sigma))
            lines.append("\t".join((name, *numbers)))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n")


def _numbers(path: Path, row: Sequence[str]) -> list[float]:
    """Return x, y, z and sigma of a row of the table, mm; raises UserError if they are invalid."""
    try:
        values = [float(cell) for cell in row[1:]]
    except ValueError:
        values = []
    largest_mm = 100.0  # a larger offset means another joint (anatomy)
    size = np.abs(values).max() if len(values) == 4 else np.nan
    if not size <= largest_mm or not values[3] > 0.01:
        raise UserError(
            f"{path}: point {quoted(row[0])} has {quoted(row[1:])}, expected three offsets and a "
            f"deviation above 0 in mm, at most {largest_mm:.0f}; write it again by "
            "'intercap keypoint-definition'"
        )
    return values


def average_offsets(fits: Sequence[Path]) -> tuple[Definition, list[str]]:
    """Average the offsets of body_fit artefacts; recordings without depth are left out.

    The recordings of a person are averaged first, so each person counts once. Raises UserError if
    there are fewer than three people: the definition cannot be separated from one person's shape.

    Returns:
        The definition.
        The names of the people, sorted.
    """
    of_person: dict[str, list[np.ndarray]] = {}
    no_depth = []
    for path in fits:
        with artefacts.read(path, BODY_FIT) as fit:
            # depth in more than half of the frames
            measured = np.isfinite(fit["cloud_residual"]).mean() > 0.5
            subject = str(fit.attributes["subject"])
            if measured:
                of_person.setdefault(subject, []).append(fit["keypoint_offsets"].astype(float))
            else:
                no_depth.append(str(fit.attributes["sequence"]))
    people = sorted(of_person)
    if len(people) < 3:
        without = f"; without depth: {', '.join(no_depth)}" if no_depth else ""
        raise UserError(
            f"{len(people)} people with depth ({', '.join(people) or 'none'}), expected at least "
            "3, since a definition cannot be separated from one person's "
            f"shape{without}; run stage 'body_fit' of recordings of more people with depth"
        )
    means = np.stack([np.mean(of_person[name], axis=0) for name in people])
    scatter = np.sqrt(means.var(axis=0, ddof=1).mean(axis=1))
    return Definition(means.mean(axis=0), np.maximum(scatter, FITTED_SIGMA_M)), people
