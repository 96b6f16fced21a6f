"""The recordings of an evaluation with new random seeds, for figures on unseen data.

Other people act in the same scripts, with other motions, rooms and errors. Settings and tables are
written to ``results/seed_<N>/config``, results to ``results/seed_<N>``.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.inputs.documents import dump_yaml
from intercap_core.project import Project, load_project, read_yaml, tidy

TABLES = ("sequences", "subjects")


def redraw_settings(settings: Mapping[str, Sequence[Path]], seed: int) -> dict[str, list[Path]]:
    """Write copies of the settings files of each part with new seeds derived from ``seed``.

    Raises UserError if a settings file is invalid.
    """
    return {
        part: [_written(load_project(path), seed) for path in paths]
        for part, paths in settings.items()
    }


def _written(project: Project, seed: int) -> Path:
    """Write one project's settings and tables with new seeds and subjects; returns the settings."""
    root = project.config.results / f"seed_{seed}"
    folder = root / "config"
    folder.mkdir(parents=True, exist_ok=True)
    people = _people(project, seed)
    values: dict[str, Any] = read_yaml(project.path)
    values |= {
        "results": ".",
        "objects": os.path.abspath(project.path.parent / project.config.objects),
        "annotations": os.path.abspath(project.path.parent / project.config.annotations),
    }
    for capture in ((values.get("studio") or {}).get("captures") or {}).values():
        drawn = np.random.SeedSequence([int(capture["seed"]), seed]).generate_state(1)[0]
        # 31 bits, so that the seed fits into any integer type
        capture |= {"seed": int(drawn >> 1), "subject": people[capture["subject"]]}
    for table in TABLES:
        source = tidy(project.path.parent / getattr(project.config, table))
        values[table] = f"{project.config.dataset}_{table}.tsv"
        rows = _rows(source)
        if table == "sequences":
            rows = [_moved(row, source.parent, project, root, people) for row in rows]
        with open(folder / values[table], "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0], delimiter="\t", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    path = folder / f"{project.config.dataset}.yaml"
    path.write_text(dump_yaml(values), encoding="utf-8")
    return path


def _people(project: Project, seed: int) -> dict[str, str]:
    """New subject for each subject of the table: a cyclic permutation without fixed points."""
    names = sorted(project.subjects)
    by = 1 + seed % max(len(names) - 1, 1)
    return {name: names[(i + by) % len(names)] for i, name in enumerate(names)}


def _rows(table: Path) -> list[dict[str, str]]:
    with open(table, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file, delimiter="\t"))


def _moved(
    row: dict[str, str], folder: Path, project: Project, root: Path, people: Mapping[str, str]
) -> dict[str, str]:
    """A row of the table of sequences with the new subject and paths within the new results."""
    results = Path(os.path.abspath(project.config.results))
    moved = dict(row, subject=people[row["subject"]])
    for column, value in row.items():
        path = Path(os.path.abspath(folder / value))
        if value and path.is_relative_to(results):
            moved[column] = os.path.abspath(root / path.relative_to(results))
    return moved
