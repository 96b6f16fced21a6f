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
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import spearmanr

from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import WITHIN, stated_errors
from intercap_core.evaluation.verdict.hold_out import JudgedPart
from intercap_core.evaluation.verdict.stated import Calibration, size

SPREAD_SHARE = 0.8  # of the true errors that are within a part's spread
COMMON_KIND = 10  # recordings from which on a kind has to be within the spread on its own


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

    The scale is the median ratio of true errors and features. Four of five cross-validated errors
    are within the spread, among all recordings and in each kind of at least ``COMMON_KIND``. Of n
    errors it is the ceil(0.8 (n + 1))-th, so that it covers a further one with a probability of
    80 % (conformal prediction, Vovk et al. 2005).
    """
    ratio, kinds = samples.true / samples.size, np.unique(samples.kind)
    stated = np.empty(len(ratio))
    for kind in kinds:
        own = samples.kind == kind
        others = ~own if len(kinds) > 1 else own
        stated[own] = np.median(ratio[others]) * samples.size[own]
    off = np.abs(np.log(samples.true / stated))
    groups = [np.ones(len(off), bool), *(samples.kind == kind for kind in kinds)]
    spread = max(
        np.sort(off[rows])[min(math.ceil(SPREAD_SHARE * (rows.sum() + 1)), rows.sum()) - 1]
        for place, rows in enumerate(groups)
        if place == 0 or rows.sum() >= COMMON_KIND
    )
    return Calibration(float(np.median(ratio)), float(np.exp(spread))), stated


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
    console = Console()
    columns = ("part", "kind", "sequences", "rank", f"within {WITHIN:g}", "covered", "true/stated")
    table = Table(*columns, title="stated against true, of kinds that were left out", box=None)
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
