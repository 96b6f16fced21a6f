"""Calibrate the stated error (held-out verdict) against the true errors of recordings.

    python -m bench.verdict METRICS [METRICS ...] [--alike FOLDER,FOLDER ...]

METRICS are metrics.h5 of sequences with truth. They should cover many kinds of rigs, noise and
detectors: the calibration is valid for the kinds of recordings that it has seen. The kind is the
name of the folder above that of the sequence; ``--alike`` makes several folders one kind. Prints
the calibration for `intercap_core/evaluation/verdict/stated.py` and the cross-validated errors:
each kind is predicted by a scale fitted to the other kinds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binom, spearmanr

from intercap_core.commands.console import ListTable, standard_console
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import WITHIN, stated_errors
from intercap_core.evaluation.verdict.hold_out import JudgedPart
from intercap_core.evaluation.verdict.stated import Calibration, size

SPREAD_SHARE = 0.8  # of the true errors that are within a part's spread
COMMON_KIND = 10  # recordings from which on a kind counts on its own


@dataclass(frozen=True, eq=False)
class Samples:
    """N sequences of one part."""

    size: np.ndarray
    """(N,) root of the summed squares of the features, metres."""
    true: np.ndarray
    """(N,) true errors, metres."""
    kind: np.ndarray
    """(N,) kind of each recording."""


def read(paths: Sequence[Path], alike: Sequence[Sequence[str]] = ()) -> dict[JudgedPart, Samples]:
    """Samples of each part; raises UserError for a file without verdict or truth.

    Folders that share an entry of ``alike`` are one kind, named as the first.
    """
    first = {name: names[0] for names in alike for name in names}
    rows: dict[JudgedPart, list[tuple[float, float, str]]] = {part: [] for part in JudgedPart}
    for path in paths:
        sequence = SequenceMetrics.read(path)
        if not sequence.has_truth or "verdict/features" not in sequence.values:
            raise UserError(
                f"{path}: holds no {'verdict' if sequence.has_truth else 'errors against truth'}; "
                "name metrics of virtual recordings, made with metrics.hold_out"
            )
        folder = path.parent.parent.name
        for place, error in enumerate(stated_errors(sequence)):
            if np.isfinite(error.stated) and np.isfinite(error.true):
                part = JudgedPart(error.part)
                features = sequence.values["verdict/features"][place]
                rows[part].append(
                    (float(size(part, features)), 1e-3 * error.true, first.get(folder, folder))
                )
    return {
        part: Samples(*(np.array(column) for column in zip(*found, strict=True)))
        for part, found in rows.items()
        if found
    }


def calibrate(samples: Samples) -> tuple[Calibration, np.ndarray]:
    """Scale and spread of a part, and its cross-validated stated errors (N,), metres.

    Four of five errors of further recordings are within the spread with a confidence of 80 %, for
    all recordings and for each kind of at least ``COMMON_KIND``: a tolerance limit of the
    cross-validated errors (Wilks 1941).
    """
    ratio, kinds = samples.true / samples.size, np.unique(samples.kind)
    stated = np.empty(len(ratio))
    for kind in kinds:
        own = samples.kind == kind
        others = ~own if len(kinds) > 1 else own
        stated[own] = _scale(ratio[others], samples.kind[others]) * samples.size[own]
    off = np.abs(np.log(samples.true / stated))
    groups = [np.ones(len(off), bool), *_common(samples.kind)]
    spread = max(_tolerance_limit(off[rows]) for rows in groups)
    return Calibration(_scale(ratio, samples.kind), float(np.exp(spread))), stated


def _scale(ratio: np.ndarray, kind: np.ndarray) -> float:
    """Geometric mean of the median ratios of all common kinds; of all recordings if none is.

    So a real detector counts as much as simulated keypoints, of which there are more recordings.
    """
    groups = _common(kind) or [np.ones(len(kind), bool)]
    return float(np.exp(np.mean([np.log(np.median(ratio[rows])) for rows in groups])))


def _tolerance_limit(values: np.ndarray) -> float:
    """Limit that exceeds ``SPREAD_SHARE`` of the population with a confidence of the same size.

    The k-th smallest of n values does so with the probability that fewer than k of n are below the
    quantile. The limit is interpolated between two values; it is the largest if n is too small.
    """
    confidence = binom.cdf(np.arange(len(values)), len(values), SPREAD_SHARE)
    return float(np.interp(SPREAD_SHARE, confidence, np.sort(values)))


def _common(kind: np.ndarray) -> list[np.ndarray]:
    """Masks (N,) of the recordings of each kind of at least ``COMMON_KIND``."""
    rows = [kind == name for name in np.unique(kind)]
    return [mask for mask in rows if mask.sum() >= COMMON_KIND]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the calibration and its cross-validated errors."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("metrics", nargs="+", type=Path, help="metrics.h5 of sequences with truth")
    parser.add_argument(
        "--alike",
        action="append",
        default=[],
        type=lambda text: text.split(","),
        metavar="FOLDER,FOLDER",
        help="folders of recordings of one kind",
    )
    options = parser.parse_args(arguments)
    try:
        parts = read(options.metrics, options.alike)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    console = standard_console()
    columns = ("part", "kind", "sequences", "rank", f"within {WITHIN:g}", "covered", "true/stated")
    table = ListTable(*columns, title="stated against true, of kinds that were left out")
    for part, samples in parts.items():
        found, stated = calibrate(samples)
        print(f"    JudgedPart.{part.name}: Calibration({found.scale:.2f}, {found.spread:.2f}),")
        for kind in ("all", *np.unique(samples.kind)):
            rows = (samples.kind == kind) | (kind == "all")
            ratio = samples.true[rows] / stated[rows]
            off = np.exp(np.abs(np.log(ratio)))
            rank = spearmanr(stated, samples.true).statistic if kind == "all" else np.nan
            cells = (rank, (off < WITHIN).mean(), (off <= found.spread).mean(), np.median(ratio))
            table.add_row(str(part), str(kind), str(len(off)), *(f"{cell:.2f}" for cell in cells))
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
