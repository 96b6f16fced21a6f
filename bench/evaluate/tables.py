"""Tables of the figures of an evaluation.

A key is ``area.measure`` or ``area.group.measure``. A group is, for example, an object. The figures
of a dataset that is a variant of another one have its prefix before the measure (:func:`.variant`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

from rich.markup import escape

from bench.evaluate.part import COMPARED, SPREAD, Errors, EvaluationPart, Measured, variant
from intercap_core.commands.console import ListTable, standard_console

Keys = dict[str, str]  # keys of the figures of one column, by measure


class FigureKey(NamedTuple):
    """Components of the key of a figure; "" = none."""

    area: str
    group: str
    variant: str
    measure: str

    @classmethod
    def parse(cls, key: str, prefixes: Collection[str]) -> FigureKey:
        """Split a key. ``prefixes`` are those of the variants, such as ``noise2_``."""
        area, *groups, measure = re.split(r"\.(?=\D)", key)  # not at the point of 4.5mm
        group = ".".join(groups)
        for prefix in prefixes:
            if group.startswith(prefix):
                return cls(area, group.removeprefix(prefix), prefix.strip("_"), measure)
            if measure.startswith(prefix):
                return cls(area, group, prefix.strip("_"), measure.removeprefix(prefix))
        return cls(area, group, "", measure)


def tabulate(figures: Mapping[str, float], prefixes: Collection[str] = ()) -> Iterator[ListTable]:
    """Tables of all figures, with a row per measure and standard errors after ``+-``.

    The first tables have a column per area and variant, the other ones a column per group of one
    area and variant. Columns without a common measure are in separate tables.
    """
    titles: dict[str, dict[str, Keys]] = {}
    for key in figures:
        if not key.endswith(SPREAD):
            found = FigureKey.parse(key, prefixes)
            name = f"{found.area} {found.variant}".strip()
            title, column = (name, found.group) if found.group else ("", name)
            titles.setdefault(title, {}).setdefault(column, {})[found.measure] = key
    for title in sorted(titles, key=bool):
        for columns in _related(titles[title]):
            table = ListTable("measure", *columns, title=title)
            for measure in dict.fromkeys(name for keys in columns.values() for name in keys):
                cells = (_cell(figures, keys.get(measure, "")) for keys in columns.values())
                table.add_row(measure, *cells)
            yield table


def _related(columns: Mapping[str, Keys]) -> list[dict[str, Keys]]:
    """Divide columns into tables whose columns have common measures."""
    tables: list[dict[str, Keys]] = []
    for column, keys in columns.items():
        related = (t for t in tables if any(keys.keys() & other.keys() for other in t.values()))
        table = next(related, None)
        if table is None:
            tables.append({column: keys})
        else:
            table[column] = keys
    return tables


def _cell(figures: Mapping[str, float], key: str) -> str:
    value, error = (_number(figures.get(k, math.nan)) for k in (key, key + SPREAD))
    return f"{value} +- {error}" if value and error else value


def _number(value: float) -> str:
    """Text with four significant digits and all digits before the point; "" if not finite."""
    if not math.isfinite(value):
        return ""
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def print_figures(figures: Mapping[str, float], prefixes: Collection[str] = ()) -> None:
    """Print all figures, see :func:`tabulate`."""
    for table in tabulate(figures, prefixes):
        standard_console().print(table, "")


def print_part(
    part: EvaluationPart[Errors],
    measured: Sequence[Measured[Errors]],
    figures: Mapping[str, float],
) -> None:
    """Print the figures of one part, and the figures ``part.columns`` of each recording."""
    found = {variant(project.dataset, *part.areas) for project in measured} if part.areas else set()
    prefixes = sorted((found | {COMPARED}) - {""}, key=len, reverse=True)
    table = ListTable("recording", *part.columns, "problems", title=f"{part.name}: recordings")
    for project in measured:
        for name, errors in zip(project.names, project.errors, strict=True):
            own = part.flat([Measured(project.dataset, [errors])])
            parsed = [(FigureKey.parse(key, prefixes), value) for key, value in own.items()]
            cells = []
            for column in part.columns:
                area, _, measure = column.rpartition(".")
                values = (v for k, v in parsed if k.measure == measure and k.area.startswith(area))
                cells.append(_number(next(values, math.nan)))
            problems = escape("; ".join(part.problems(errors)))
            table.add_row(f"{project.dataset}: {name}", *cells, problems)
        for name in project.missing:
            cells = [""] * len(part.columns)
            table.add_row(f"{project.dataset}: {name}", *cells, f"no artefact of {part.stage}")
    standard_console().print(table, "")
    print_figures(figures, prefixes)
