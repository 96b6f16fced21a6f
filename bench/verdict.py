"""Fit the factors of the stated error (held-out verdict) to the true errors of recordings.

    python -m bench.verdict METRICS [METRICS ...]

METRICS are metrics.h5 of sequences with truth. They should cover many kinds of rigs and noise: the
fit is valid for the kinds of recordings that it has seen. The kind is the name of the folder above
that of the sequence. Prints the factors for `intercap_core/evaluation/verdict/stated.py` and the
cross-validated errors: each kind is predicted by factors fitted to the other kinds. The stated
spread is that of the cross-validated errors.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares
from scipy.stats import spearmanr

from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import WITHIN, stated_errors
from intercap_core.evaluation.verdict.hold_out import JudgedPart
from intercap_core.evaluation.verdict.stated import Factors

SPREAD_SHARE = 0.8  # of the true errors that are within a part's spread
# Of the jackknife's shift: what a single camera changes is an error, though the studio's stated
# deviations, which real recordings need not bear out, tell it as well.
LEAST_SHIFT = 0.5


@dataclass(frozen=True, eq=False)
class Samples:
    """N sequences of one part."""

    features: np.ndarray
    """(N, F)."""
    true: np.ndarray
    """(N,) true errors, metres."""
    kind: np.ndarray
    """(N,) kind of each recording."""

    def chosen(self, rows: np.ndarray) -> Samples:
        """The sequences of the mask ``rows`` (N,)."""
        return Samples(self.features[rows], self.true[rows], self.kind[rows])


def read(paths: Sequence[Path]) -> dict[JudgedPart, Samples]:
    """Samples of each part; raises UserError for a file without verdict or truth."""
    rows: dict[JudgedPart, list[tuple[np.ndarray, float, str]]] = {part: [] for part in JudgedPart}
    for path in paths:
        sequence = SequenceMetrics.read(path)
        if not sequence.has_truth or "verdict/features" not in sequence.values:
            raise UserError(
                f"{path}: holds no {'verdict' if sequence.has_truth else 'errors against truth'}; "
                "name metrics of virtual recordings, made with metrics.hold_out"
            )
        for place, error in enumerate(stated_errors(sequence)):
            if np.isfinite(error.stated) and np.isfinite(error.true):
                features = sequence.values["verdict/features"][place]
                rows[JudgedPart(error.part)].append(
                    (features, 1e-3 * error.true, path.parent.parent.name)
                )
    return {
        part: Samples(*(np.array(column) for column in zip(*found, strict=True)))
        for part, found in rows.items()
        if found
    }


def fit(samples: Samples) -> Factors:
    """Robust fit of factors to the logarithms of the true errors."""
    log_true = np.log(samples.true)

    def apart(factors: np.ndarray) -> np.ndarray:
        return np.log(_stated(samples.features, factors)) - log_true

    start = np.r_[0.5 * samples.true.min(), np.ones(samples.features.shape[1])]
    least = np.r_[1e-6, LEAST_SHIFT, np.zeros(samples.features.shape[1] - 1)]
    found = least_squares(apart, start, bounds=(least, np.inf), loss="soft_l1", x_scale=start).x
    spread = float(np.exp(np.quantile(np.abs(apart(found)), SPREAD_SHARE)))
    return Factors(float(found[0]), tuple(found[1:].tolist()), spread)


def cross_validated(samples: Samples) -> np.ndarray:
    """Stated errors (N,) by factors that were fitted to recordings of other kinds."""
    stated = np.empty(len(samples.true))
    for kind in np.unique(samples.kind):
        own = samples.kind == kind
        factors = fit(samples.chosen(~own))
        stated[own] = _stated(samples.features[own], np.r_[factors.rest, factors.of])
    return stated


def _stated(features: np.ndarray, factors: np.ndarray) -> np.ndarray:
    return np.sqrt(factors[0] ** 2 + ((features * factors[1:]) ** 2).sum(axis=1))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the factors and their cross-validated errors."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("metrics", nargs="+", type=Path, help="metrics.h5 of sequences with truth")
    options = parser.parse_args(arguments)
    try:
        parts = read(options.metrics)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    console = Console()
    columns = ("part", "sequences", "kinds", "rank", f"within {WITHIN:g}", "spread")
    table = Table(*columns, title="stated against true, of kinds that were left out", box=None)
    for part, samples in parts.items():
        factors, kinds = fit(samples), len(np.unique(samples.kind))
        if kinds > 1:
            stated = cross_validated(samples)
            off = np.exp(np.abs(np.log(stated / samples.true)))
            factors = factors._replace(spread=float(np.quantile(off, SPREAD_SHARE)))
            rank = spearmanr(stated, samples.true).statistic
            cells = (rank, (off < WITHIN).mean(), factors.spread)
            table.add_row(str(part), str(len(off)), str(kinds), *(f"{cell:.2f}" for cell in cells))
        of = ", ".join(f"{value:.2f}" for value in factors.of)
        print(
            f"    JudgedPart.{part.name}: "
            f"Factors({factors.rest:.4f}, ({of}), {factors.spread:.2f}),"
        )
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
