"""Digests of the code that a stage uses, so that editing the core re-runs what it concerns.

The modules that a stage reaches are found by walking imports transitively, those inside functions
too. What counts is the syntax tree without docstrings and comments, and the data files that lie
beside a reached module: rewording a docstring re-runs nothing. The declarations that every stage
shares (settings, schemas, project) are followed name by name: a new setting of one stage does not
touch the others. So are the constants of a room, its modules ``constants`` and ``..._constants``.
"""

from __future__ import annotations

import ast
import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

PACKAGE = "intercap_core"
ROOT = Path(__file__).resolve().parents[1]
DECLARATIONS = frozenset(
    {f"{PACKAGE}.{name}" for name in ("config", "schemas", "project", "sequence_inputs")}
)
# Where compiled code lies, and what is said meanwhile, changes no result.
NEUTRAL = frozenset(f"{PACKAGE}.{name}" for name in ("disk", "kernel_cache", "progress", "signals"))
CONSTANTS = (".constants", "_constants")  # ends of modules that hold a room's numbers
DATA_FOLDERS = ("data", "templates")

WHOLE = "*"  # stands for every name of a module


@dataclass(frozen=True)
class _Statement:
    """A top-level statement of a module, without docstrings."""

    content: bytes  # its syntax tree as text
    defines: frozenset[str]  # names that it binds; empty where it acts in another way
    uses: frozenset[str]  # names that it mentions, those inside text too
    imports: tuple[tuple[str, str], ...]  # (module, name) pairs, anywhere inside it


def code_digest(module: str, *, root: Path = ROOT) -> str:
    """One digest of all that :func:`code_digests` has by room; raises as it does."""
    found = code_digests(module, root=root)
    return hashlib.sha256("".join(f"{k} {v}\n" for k, v in found.items()).encode()).hexdigest()[:16]


def code_digests(module: str, *, root: Path = ROOT) -> dict[str, str]:
    """Digests of all code and data that ``module`` (e.g. "stages.joint") reaches, by room: the
    package's folder or file that it lies in.

    ``root`` is the package's folder. Raises FileNotFoundError where there is no such module.
    """
    states: dict[str, hashlib._Hash] = {}
    reached = modules_reached(module, root=root)
    for name in sorted(reached):
        state = states.setdefault(_room(name), hashlib.sha256())
        state.update(name.encode())
        for statement in _used(name, reached[name], root):
            state.update(statement.content)
    for folder in sorted({_path(name, root).parent for name in reached}):
        for path in _data_files(folder):
            relative = path.relative_to(root)
            state = states.setdefault(relative.parts[0], hashlib.sha256())
            state.update(relative.as_posix().encode())
            state.update(_file_digest(path, path.stat().st_mtime_ns))
    return {room: state.hexdigest()[:16] for room, state in sorted(states.items())}


def _room(module: str) -> str:
    return [*module.split("."), PACKAGE][1]


def modules_reached(module: str, *, root: Path = ROOT) -> dict[str, frozenset[str]]:
    """Modules of the package that ``module`` imports, directly or not, with the names it uses.

    The names are ``{"*"}`` for every module but the shared declarations.
    """
    start = f"{PACKAGE}.{module}"
    if not _path(start, root).is_file():
        raise FileNotFoundError(f"there is no module {start} in {root}")
    reached: dict[str, frozenset[str]] = {}
    waiting = [(name, WHOLE) for name in (start, *_parents(start))]
    while waiting:
        name, used = waiting.pop()
        if name in NEUTRAL:
            continue
        if name not in DECLARATIONS and not name.endswith(CONSTANTS):
            used = WHOLE
        known = reached.get(name, frozenset())
        if used in known or WHOLE in known:
            continue
        reached[name] = frozenset({WHOLE}) if used == WHOLE else known | {used}
        for statement in _used(name, reached[name], root):
            waiting.extend(statement.imports)
    return reached


def _used(module: str, names: frozenset[str], root: Path) -> list[_Statement]:
    """The module's statements that take part when ``names`` are imported from it, in order."""
    path = _path(module, root)
    statements = _statements(module, path, path.stat().st_mtime_ns, root)
    if WHOLE in names:
        return list(statements)
    chosen: set[int] = set()
    wanted = set(names)
    while True:
        found = {
            index
            for index, statement in enumerate(statements)
            if not statement.defines or statement.defines & wanted
        } - chosen
        if not found:
            return [statements[index] for index in sorted(chosen)]
        chosen |= found
        for index in found:
            wanted |= statements[index].uses


@cache
def _statements(module: str, path: Path, mtime_ns: int, root: Path) -> tuple[_Statement, ...]:
    tree = ast.parse(path.read_bytes(), str(path))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [entry for entry in body if not _is_text(entry)]  # type: ignore[attr-defined]
    return tuple(
        _Statement(
            ast.dump(node).encode(),
            frozenset(_defines(node)),
            frozenset(_uses(node)),
            tuple(_imports(node, module, root)),
        )
        for node in tree.body
    )


def _is_text(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _defines(statement: ast.stmt) -> set[str]:
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {statement.name}
    if isinstance(statement, ast.Assign | ast.AnnAssign):
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        return {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}
    if isinstance(statement, ast.Import | ast.ImportFrom):
        return {(alias.asname or alias.name).split(".")[0] for alias in statement.names}
    return set()


def _uses(statement: ast.stmt) -> set[str]:
    names = set()
    for node in ast.walk(statement):
        if isinstance(node, ast.Name):
            names.add(node.id)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            names.add(node.value)  # an annotation may be written as text
    return names


def _imports(node: ast.stmt, module: str, root: Path) -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []
    for inner in ast.walk(node):
        if isinstance(inner, ast.Import):
            targets = [(alias.name, WHOLE) for alias in inner.names]
        elif isinstance(inner, ast.ImportFrom):
            base = _absolute(inner, module, root)
            targets = [(base, alias.name) for alias in inner.names]
            targets += [(f"{base}.{alias.name}", WHOLE) for alias in inner.names]
        else:
            continue
        for name, used in targets:
            if _exists(name, root):
                found.append((name, used))
                found += [(parent, WHOLE) for parent in _parents(name)]
    return found


def _absolute(node: ast.ImportFrom, module: str, root: Path) -> str:
    if not node.level:
        return node.module or ""
    package = module.split(".")
    if _path(module, root).name != "__init__.py":
        package = package[:-1]
    package = package[: len(package) - (node.level - 1)]
    return ".".join([*package, *([node.module] if node.module else [])])


def _path(module: str, root: Path) -> Path:
    relative = Path(*module.split(".")[1:])
    package = root / relative / "__init__.py"
    return package if package.is_file() else (root / relative).with_suffix(".py")


def _exists(module: str, root: Path) -> bool:
    return (module == PACKAGE or module.startswith(f"{PACKAGE}.")) and _path(module, root).is_file()


def _parents(module: str) -> list[str]:
    """The packages that importing ``module`` imports first."""
    parts = module.split(".")
    return [".".join(parts[:count]) for count in range(1, len(parts))]


def _data_files(folder: Path) -> list[Path]:
    return sorted(
        path
        for name in DATA_FOLDERS
        for path in (folder / name).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    )


@cache
def _file_digest(path: Path, mtime_ns: int) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()
