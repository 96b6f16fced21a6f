"""`intercap compare`: differences between two versions of a dataset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.markup import escape
from rich.table import Table

from intercap_core.commands.console import ListTable, counted, standard_console
from intercap_core.errors import UserError
from intercap_core.evaluation.compare import SAME, Comparison, compare

ROWS = 40  # sequences printed; all are in the tables
TABLES = ("compare_sequences.csv", "compare_frames.csv", "compare_figures.csv")
# Heading, column of the table of sequences, and digits
_COLUMNS = (
    ("frames", "frames", 0), ("changed", "changed_frames", 0), ("body mm", "body_mm", 1),
    ("body max mm", "body_max_mm", 1), ("hands mm", "hands_mm", 1), ("object mm", "object_mm", 1),
    ("object max mm", "object_max_mm", 1), ("object deg", "object_deg", 1),
    ("contact differs", "contact_changed_frames", 0),
)  # fmt: skip


def print_comparison(old: Path, new: Path, output: Path | None = None) -> list[Path]:
    """Print the changes, largest first, and write all tables into the folder ``output``.

    Returns the written files. Raises UserError if a folder holds no results.
    """
    if output is not None and output.exists() and not output.is_dir():
        raise UserError(f"{output}: is a file, expected a folder for tables; name another output")
    comparison = compare(old, new)
    console = standard_console()
    console.print(_table(comparison))
    if len(comparison.figures):
        console.print(_figures(comparison))
    same = int((comparison.sequences["state"] == SAME).sum())
    differs = len(comparison.sequences) - same
    left = max(0, differs - ROWS)
    more = f" ({left} of them are not printed)" if left else ""
    print(
        f"{differs} of {len(comparison.sequences)} sequences differ{more}, in "
        f"{counted(len(comparison.frames), 'frame')}; {same} are the same"
    )
    if output is None:
        return []
    output.mkdir(parents=True, exist_ok=True)
    paths = [output / name for name in TABLES]
    for path, table in zip(
        paths, (comparison.sequences, comparison.frames, comparison.figures), strict=True
    ):
        table.to_csv(path, index=False, float_format="%.6g")
    return paths


def _table(comparison: Comparison) -> Table:
    table = ListTable()
    table.add_column("sequence")
    table.add_column("state")
    for head, _, _ in _COLUMNS:
        table.add_column(head, justify="right")
    table.add_column("flagged", justify="right")
    table.add_column("body estimated error, mm", justify="right")
    shown = comparison.sequences[comparison.sequences["state"] != SAME].head(ROWS)
    for row in shown.to_dict("records"):
        cells = [_number(row[key], digits) for _, key, digits in _COLUMNS]
        flagged = _pair(row["flagged_before"], row["flagged_after"], 0)
        stated = _pair(row["stated_body_mm_before"], row["stated_body_mm_after"], 1)
        state = ": ".join(filter(None, (row["state"], row["note"])))
        table.add_row(escape(str(row["sequence"])), escape(state), *cells, flagged, stated)
    return table


def _figures(comparison: Comparison) -> Table:
    """The datasets' figures side by side."""
    table = ListTable("all frames", "old", "new")
    for name, old, new in comparison.figures.itertuples(index=False):
        table.add_row(escape(str(name)), f"{old:.4g}", f"{new:.4g}")
    return table


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else ""


def _pair(before: float, after: float, digits: int) -> str:
    words = (_number(before, digits), _number(after, digits))
    return " → ".join(text or "–" for text in words) if any(words) else ""
