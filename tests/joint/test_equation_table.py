"""The table of equations names what is in the code, and all of it."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import NamedTuple

import pytest

import intercap_core
from intercap_core.config import Config

PACKAGE = Path(intercap_core.__file__).resolve().parent
PAGE = PACKAGE.parent / "docs" / "equations.md"


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


PAGE_TEXT = PAGE.read_text(encoding="utf-8")
ROWS = _rows(PAGE_TEXT[PAGE_TEXT.index("## Table") :])


def _tree(file: str) -> ast.Module:
    return ast.parse((PACKAGE / file).read_text())


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.term} {row.file}")
def test_what_a_row_names_exists(row: Row) -> None:
    defined = [
        node.name
        for node in _tree(row.file).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
    ]
    assert row.name in defined
    if row.setting not in ("-", "same"):
        section, field = row.setting.split(".")
        annotation = Config.model_fields[section].annotation
        assert field in getattr(annotation, "model_fields", {})


def test_every_equation_has_a_row() -> None:
    numbers = {number.strip() for row in ROWS for number in row.paper.split(",")}
    assert numbers - {"beyond"} == {*"123456", "A.1", "A.2", "A.3", "A.4", "A.5", "A.6"}


def test_every_term_of_the_joint_energy_has_a_row() -> None:
    folder = PACKAGE / "joint" / "terms"
    terms = {
        (f"joint/terms/{path.name}", node.name)
        for path in folder.glob("*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef)
        and any(isinstance(base, ast.Name) and base.id == "Term" for base in node.bases)
    }
    assert len(terms) == 16
    assert terms <= {(row.file, row.name) for row in ROWS}


def test_every_weight_of_the_joint_energy_has_a_row() -> None:
    annotation = Config.model_fields["joint"].annotation
    weights = {f"joint.{name}" for name in getattr(annotation, "model_fields", {})}
    assert weights <= {row.setting for row in ROWS}


@pytest.mark.parametrize("row", [row for row in ROWS if row.paper.startswith("6")], ids=str)
def test_files_of_equation_6_name_it(row: Row) -> None:
    described = ast.get_docstring(_tree(row.file)) or ""
    assert "equation 6" in described
    assert row.term.split(":")[0].split(",")[0].split(" with")[0] in described
