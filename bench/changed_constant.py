"""Find a constant of the package by name, and import the package with another value of it."""

from __future__ import annotations

import ast
import difflib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.errors import UserError

PACKAGE = "intercap_core"
ROOT = Path(__file__).resolve().parents[1] / PACKAGE
# A number between 0 and 1 whose name ends so is a length, a time or an angle, and no share
UNITS = ("M", "MM", "PX", "S", "MS", "RAD", "DEG", "SIGMA", "1080P", "SCALE", "COST")


@dataclass(frozen=True)
class Constant:
    """A module-level number: dotted ``module``, ``name``, and the expression in its file."""

    module: str
    name: str
    expression: str

    @property
    def room(self) -> str:
        return self.module.split(".")[1]

    @property
    def label(self) -> str:
        """The shortest unambiguous name: ``package.NAME`` or ``package.module:NAME``."""
        _, room, *rest = self.module.split(".")
        return f"{room}.{self.name}" if rest == ["constants"] else f"{room}.{rest[-1]}:{self.name}"


def find_constant(text: str, *, root: Path = ROOT) -> Constant:
    """The constant named ``package.NAME``, ``package.module:NAME`` or by its full dotted name.

    ``package.NAME`` is searched in the package's module ``constants`` first, then in its other
    files, there also as ``_NAME``. Raises UserError with similar names where there is none, and
    with the candidates where there are several.
    """
    module, _, name = text.rpartition(":") if ":" in text else text.rpartition(".")
    parts = module.removeprefix(f"{PACKAGE}.").split(".")
    room = root / parts[0]
    if not module or not room.is_dir():
        raise UserError(f"{text}: no room {parts[0]!r}; write room.NAME or room.module:NAME")
    files = [room.joinpath(*parts[1:]).with_suffix(".py")] if ":" in text else _files(room)
    known = {path: _constants(path) for path in files if path.is_file()}
    found = [
        Constant(_module(path, root), own, names[own])
        for path, names in known.items()
        for own in (name, f"_{name}")
        if own in names
    ]
    central = [c for c in found if c.module.endswith(".constants")]
    if len(central or found) == 1:
        return (central or found)[0]
    if found:
        choices = " or ".join(c.label for c in found)
        raise UserError(f"{text}: several files of {parts[0]} have it; write {choices}")
    names = sorted({own.lstrip("_") for names in known.values() for own in names})
    near = difflib.get_close_matches(name, names, n=4, cutoff=0.5)
    hint = f"; like it are {', '.join(near)}" if near else ""
    raise UserError(f"{text}: no number of that name in {PACKAGE}/{'/'.join(parts)}{hint}")


def _files(room: Path) -> list[Path]:
    central = room / "constants.py"
    return [central, *sorted(path for path in room.glob("*.py") if path != central)]


def _module(path: Path, root: Path) -> str:
    return ".".join((PACKAGE, *path.relative_to(root).with_suffix("").parts))


@cache
def _constants(path: Path) -> dict[str, str]:
    """Upper-case names bound at the top level of the file, with their expressions."""
    found = {}
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        for target, value in _bindings(statement):
            if target.lstrip("_").isupper():
                found[target] = ast.unparse(value)
    return found


def _bindings(statement: ast.stmt) -> list[tuple[str, ast.expr]]:
    """Names and values of ``A = 1``, ``A: float = 1`` and ``A, B = 1, 2``."""
    if isinstance(statement, ast.AnnAssign) and statement.value is not None:
        targets: list[ast.expr] = [statement.target]
    elif isinstance(statement, ast.Assign):
        targets = statement.targets
    else:
        return []
    assert statement.value is not None
    pairs: list[tuple[ast.expr, ast.expr]] = []
    for target in targets:
        both = (target, statement.value)
        if all(isinstance(side, ast.Tuple) for side in both):
            pairs += zip(target.elts, statement.value.elts, strict=True)  # type: ignore[attr-defined]
        else:
            pairs.append(both)
    return [(target.id, value) for target, value in pairs if isinstance(target, ast.Name)]


def scaled(name: str, value: Any, factor: float, around: float = 0.0) -> Any:
    """``value`` times ``factor``, or with its distance from ``around`` times ``factor``.

    Integers stay integers of at least 1. A number between 0 and 1 whose name has no unit is a share
    or a probability and stays in that range. In tuples, lists and dictionaries every number is
    scaled. Raises UserError for values that are not numbers.
    """
    if isinstance(value, dict):
        return {key: scaled(name, entry, factor, around) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return type(value)(scaled(name, entry, factor, around) for entry in value)
    if isinstance(value, np.ndarray):
        return around + (value - around) * factor
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise UserError(f"{name}: {value!r} is no number that could be scaled")
    if isinstance(value, int | np.integer):
        return max(1, round(around + (value - around) * factor))
    changed = around + (float(value) - around) * factor
    share = 0 <= value < 1 and not around and name.rsplit("_", 1)[-1] not in UNITS
    return min(changed, 1.0) if share else changed


def import_changed(constant: Constant, change: Callable[[Any], Any]) -> tuple[Any, Any]:
    """Import the constant's module with another value; returns the value before and after.

    Must be called before any other module of the package is imported, so that other modules,
    default arguments, kernels and derived constants use the changed value. Raises UserError where
    the module is already imported.
    """
    if constant.module in sys.modules:
        raise UserError(f"{constant.module} is imported already; change it in a fresh process")
    spec = importlib.util.find_spec(constant.module)
    assert spec is not None and spec.origin is not None
    replaced: list[tuple[Any, Any]] = []

    def changed(value: Any) -> Any:
        replaced.append((value, change(value)))
        return replaced[-1][1]

    tree = ast.parse(Path(spec.origin).read_bytes(), spec.origin)
    for statement in tree.body:
        for target, value in _bindings(statement):
            if target == constant.name:
                _wrap(statement, value)
    module = importlib.util.module_from_spec(spec)
    module.__dict__["_changed"] = changed
    sys.modules[constant.module] = module
    exec(compile(ast.fix_missing_locations(tree), spec.origin, "exec"), module.__dict__)
    parent, _, last = constant.module.rpartition(".")
    setattr(sys.modules[parent], last, module)
    if not replaced:
        raise UserError(f"{constant.module} binds no {constant.name} at its top level")
    return replaced[-1]


def _wrap(statement: ast.stmt, value: ast.expr) -> None:
    """Put ``_changed(...)`` around ``value`` at its position in ``statement``."""

    class Wrap(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            if node is value:
                return ast.Call(ast.Name("_changed", ast.Load()), [value], [])
            return self.generic_visit(node)

    Wrap().visit(statement)


def in_kernels(constant: Constant, *, root: Path = ROOT) -> bool:
    """Whether a file with compiled kernels uses the constant or a value derived from it.

    Numba's cache ignores the globals of a kernel, so a changed value needs a separate cache.
    """
    own = root.joinpath(*constant.module.split(".")[1:]).with_suffix(".py")
    derived = {constant.name}
    for name, expression in _constants(own).items():
        if derived & {n.id for n in ast.walk(ast.parse(expression)) if isinstance(n, ast.Name)}:
            derived.add(name)
    if _compiles(own):
        return True
    return any(
        _compiles(path) and derived & _imported(path, constant.module)
        for path in root.rglob("*.py")
    )


@cache
def _compiles(path: Path) -> bool:
    return "numba" in path.read_text(encoding="utf-8")


@cache
def _imported(path: Path, module: str) -> frozenset[str]:
    """Names that the file imports from ``module``."""
    return frozenset(
        alias.name
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module == module
        for alias in node.names
    )
