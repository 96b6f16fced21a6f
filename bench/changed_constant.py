"""Find the constants of a package, and import a module with another value of one of them."""

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
from intercap_core.kernel_cache import kernel_modules

PACKAGE = "intercap_core"
ROOT = Path(__file__).resolve().parents[1] / PACKAGE
# A number between 0 and 1 whose name has no such ending is a share or a probability
UNITS = ("M", "M2", "MM", "PX", "S", "MS", "RAD", "DEG", "SIGMA", "1080P", "SCALE", "COST")


@dataclass(frozen=True)
class Constant:
    """A number, or a collection of numbers, that a module binds to a name in capitals."""

    module: str
    """Dotted name of the module."""
    name: str

    @property
    def label(self) -> str:
        """The name that :func:`find_constants` accepts, ``package.module:NAME``."""
        return f"{self.module.removeprefix(f'{PACKAGE}.')}:{self.name}"


def find_constants(selector: str, *, root: Path = ROOT) -> list[Constant]:
    """Return the constants of a package or module, subpackages included, or those of one name.

    Args:
        selector: ``package``, ``package.module``, ``package.NAME`` or ``package.module:NAME``.

    Raises:
        UserError: if there is no such module or constant; suggests similar names.
    """
    place, _, name = selector.partition(":")
    if not name and place.rpartition(".")[2].isupper():
        place, _, name = place.rpartition(".")
    path = root.joinpath(*place.removeprefix(f"{PACKAGE}.").split("."))
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
    if not place or not all(file.is_file() for file in files):
        raise UserError(f"{selector}: there is no module {place!r} in {PACKAGE}")
    known = [
        Constant(_module(file, root), own)
        for file in files
        for statement in ast.parse(file.read_text(encoding="utf-8")).body
        for own in bound_constants(statement)
    ]
    matches = (one for one in known if not name or one.name.lstrip("_") == name.lstrip("_"))
    found = list(dict.fromkeys(matches))  # a name may be bound by several statements
    if not found:
        near = difflib.get_close_matches(name, [one.name for one in known], n=4, cutoff=0.5)
        hint = f"; similar names are {', '.join(near)}" if near else ""
        raise UserError(f"{selector}: there is no such constant in {PACKAGE}.{place}{hint}")
    return found


def _module(file: Path, root: Path) -> str:
    return ".".join((PACKAGE, *file.relative_to(root).with_suffix("").parts))


def kernels_with(module: str) -> list[str]:
    """Names ``folder.file`` of the modules whose kernels may contain a constant of ``module``.

    These are the module and those that import it, directly or indirectly.
    """
    imported = _imports_of_kernels()
    found = {module}
    while more := {name for name, uses in imported.items() if uses & found} - found:
        found |= more
    return sorted(".".join(name.split(".")[-2:]) for name in found)


@cache
def _imports_of_kernels() -> dict[str, set[str]]:
    """Names that each module which a kernel can reach imports from the package."""
    imported: dict[str, set[str]] = {}
    for name, text in kernel_modules().items():
        imported[name] = names = set()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and node.module:
                names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
    return imported


def bound_constants(statement: ast.stmt, *, keys_too: bool = False) -> list[str]:
    """Names in capitals that a statement binds to expressions of numbers.

    Keys of dictionaries may be texts, unless ``keys_too``.
    """
    if isinstance(statement, ast.AnnAssign):
        targets: list[ast.expr] = [statement.target]
    elif isinstance(statement, ast.Assign):
        targets = statement.targets
    else:
        return []
    if statement.value is None:
        return []
    nodes = list(ast.walk(statement.value))
    keys = [] if keys_too else [key for n in nodes if isinstance(n, ast.Dict) for key in n.keys]
    literals = [n.value for n in nodes if isinstance(n, ast.Constant) and n not in keys]
    if not literals or not all(type(value) in (int, float) for value in literals):
        return []
    names = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
    return [name for name in names if name.lstrip("_").isupper()]


def scaled(name: str, value: Any, factor: float) -> Any:
    """Return ``value`` times ``factor``; of tuples, lists and dictionaries every number.

    Integers stay integers of at least 1. A number between 0 and 1 whose name has no unit is a share
    or a probability and stays below 1. Raises UserError for values that are not numbers.
    """
    if isinstance(value, dict):
        return {key: scaled(name, entry, factor) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return type(value)([scaled(name, entry, factor) for entry in value])
    if isinstance(value, np.ndarray):
        return value * factor
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise UserError(f"{name}: {value!r} is not a number")
    if isinstance(value, int | np.integer):
        return max(1, round(value * factor))
    is_share = 0 <= value < 1 and name.rsplit("_", 1)[-1] not in UNITS
    return min(value * factor, 1.0) if is_share else value * factor


def import_changed(constant: Constant, change: Callable[[Any], Any]) -> tuple[Any, Any]:
    """Import the constant's module with another value; returns the value before and after.

    Must be called before another module imports this one, so that default arguments, kernels and
    derived constants use the changed value. Raises UserError if the module is already imported.
    """
    if constant.module in sys.modules:
        raise UserError(f"{constant.module} is already imported; change it in a new process")
    spec = importlib.util.find_spec(constant.module)
    assert spec is not None and spec.origin is not None
    values: list[Any] = []

    def changed(value: Any) -> Any:
        values[:] = value, change(value)
        return values[1]

    tree = ast.parse(Path(spec.origin).read_bytes(), spec.origin)
    rebind = ast.parse(f"{constant.name} = _changed({constant.name})").body
    tree.body = [
        part
        for statement in tree.body
        for part in (statement, *(rebind if constant.name in bound_constants(statement) else ()))
    ]
    module = importlib.util.module_from_spec(spec)
    module.__dict__["_changed"] = changed
    sys.modules[constant.module] = module
    exec(compile(tree, spec.origin, "exec"), module.__dict__)
    parent, _, last = constant.module.rpartition(".")
    setattr(sys.modules[parent], last, module)
    return values[0], values[1]
