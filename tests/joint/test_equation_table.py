"""The tables of docs/equations.md name what is in the code, and all of it."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import NamedTuple

import pytest

import intercap_core
from intercap_core.config import Config, JointSettings
from intercap_core.joint.problem import DATA_TERMS, TERMS
from intercap_core.joint.terms.term import JointTerm

PACKAGE = Path(intercap_core.__file__).resolve().parent
PAGE = (PACKAGE.parent / "docs" / "equations.md").read_text(encoding="utf-8")
JOINT_TERMS = (*DATA_TERMS, *TERMS)


class Row(NamedTuple):
    paper: str
    term: str
    file: str
    name: str
    setting: str


def _rows(text: str) -> list[Row]:
    """Rows of five cells, heading and rule left out."""
    cells = [[c.strip() for c in line.strip("|").split("|")] for line in text.splitlines()]
    return [Row(*row) for row in cells if len(row) == 5][2:]


ROWS = _rows(PAGE[PAGE.index("## Table") :])


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.term} {row.file}")
def test_row_names_code_and_setting_that_exist(row: Row):
    defined = [
        node.name
        for node in ast.parse((PACKAGE / row.file).read_text()).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
    ]
    assert row.name in defined
    if row.setting not in ("-", "same"):
        section, field = row.setting.split(".")
        annotation = Config.model_fields[section].annotation
        assert field in getattr(annotation, "model_fields", {})


def test_every_term_is_listed_and_every_setting_has_a_row():
    files = {path.stem for path in (PACKAGE / "joint" / "terms").glob("[a-z]*.py")} - {"term"}
    assert files == {term.__module__.rpartition(".")[2] for term in JOINT_TERMS}
    kinds, waiting = set(), [JointTerm]
    while waiting:
        kind = waiting.pop()
        waiting += kind.__subclasses__()
        if kind.__module__.startswith("intercap_core") and "equation" in vars(kind):
            kinds.add(kind)
    assert kinds == set(JOINT_TERMS)
    settings = {f"joint.{name}" for term in JOINT_TERMS for name in term.equation.settings}
    assert {f"joint.{name}" for name in JointSettings.model_fields} == settings | {
        row.setting for row in ROWS if row.setting.startswith("joint.")
    }
