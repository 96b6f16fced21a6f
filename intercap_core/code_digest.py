"""Digests of the code that a stage uses, so that editing the core re-runs what it concerns.

The modules that a stage reaches are found by walking imports transitively, those inside functions
too. What counts is the syntax tree without docstrings and comments, and the data files that lie
beside a reached module: rewording a docstring re-runs nothing. The declarations that every stage
shares (settings, schemas, project) are followed name by name: a new setting of one stage does not
touch the others.
"""

from __future__ import annotations

import ast
import hashlib
from functools import cache
from pathlib import Path

PACKAGE = "intercap_core"
ROOT = Path(__file__).resolve().parent
DECLARATIONS = frozenset({f"{PACKAGE}.{name}" for name in ("config", "schemas", "project")})
DATA_FOLDERS = ("data", "templates")

WHOLE = "*"  # stands for every name of a module


def code_digest(module: str, *, root: Path = ROOT) -> str:
    """Digest of all code and data that ``module`` (e.g. "stages.joint") reaches.

    ``root`` is the package's folder. Raises FileNotFoundError where there is no such module.
    """
    state = hashlib.sha256()
    reached = modules_reached(module, root=root)
    for name in sorted(reached):
        state.update(name.encode())
        for node in _used(name, reached[name], root):
            state.update(ast.dump(node).encode())
    for folder in sorted({_path(name, root).parent for name in reached}):
        for path in _data_files(folder):
            state.update(path.relative_to(root).as_posix().encode())
            state.update(_file_digest(path, path.stat().st_mtime_ns))
    return state.hexdigest()[:16]


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
        if name not in DECLARATIONS:
            used = WHOLE
        known = reached.get(name, frozenset())
        if used in known or WHOLE in known:
            continue
        reached[name] = frozenset({WHOLE}) if used == WHOLE else known | {used}
        for node in _used(name, reached[name], root):
            waiting.extend(_imports(node, name, root))
    return reached


def _path(module: str, root: Path) -> Path:
    relative = Path(*module.split(".")[1:])
    package = root / relative / "__init__.py"
    return package if package.is_file() else (root / relative).with_suffix(".py")


def _parents(module: str) -> list[str]:
    """The packages that importing ``module`` imports first."""
    parts = module.split(".")
    return [".".join(parts[:count]) for count in range(1, len(parts))]


def _exists(module: str, root: Path) -> bool:
    return (module == PACKAGE or module.startswith(f"{PACKAGE}.")) and _path(module, root).is_file()


@cache
def _statements(path: Path, mtime_ns: int) -> tuple[ast.stmt, ...]:
    """Top-level statements of a module, without docstrings."""
    tree = ast.parse(path.read_bytes(), str(path))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [entry for entry in body if not _is_text(entry)]  # type: ignore[attr-defined]
    return tuple(tree.body)


def _is_text(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _used(module: str, names: frozenset[str], root: Path) -> list[ast.stmt]:
    """The module's statements that take part when ``names`` are imported from it, in order."""
    path = _path(module, root)
    statements = _statements(path, path.stat().st_mtime_ns)
    if WHOLE in names:
        return list(statements)
    defined = [_defines(statement) for statement in statements]
    chosen: set[int] = set()
    wanted = set(names)
    while True:
        found = {i for i, its in enumerate(defined) if not its or its & wanted} - chosen
        if not found:
            return [statements[i] for i in sorted(chosen)]
        chosen |= found
        for i in found:
            wanted |= {n.id for n in ast.walk(statements[i]) if isinstance(n, ast.Name)}
            wanted |= _quoted_names(statements[i])


def _defines(statement: ast.stmt) -> set[str]:
    """Names that a top-level statement binds; empty where it acts in another way."""
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {statement.name}
    if isinstance(statement, ast.Assign | ast.AnnAssign):
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        return {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}
    if isinstance(statement, ast.Import | ast.ImportFrom):
        return {(alias.asname or alias.name).split(".")[0] for alias in statement.names}
    return set()


def _quoted_names(statement: ast.stmt) -> set[str]:
    """Names inside annotations that are written as text, e.g. ``-> "Config"``."""
    return {
        node.value
        for node in ast.walk(statement)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and node.value.isidentifier()
    }


def _imports(node: ast.stmt, module: str, root: Path) -> list[tuple[str, str]]:
    """(module, name) pairs of the package that ``node`` imports, anywhere inside it."""
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
