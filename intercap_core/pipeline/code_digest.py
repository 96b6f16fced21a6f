"""Digests of the code that each stage uses: a change makes only outputs of its users stale.

The modules that a stage reaches are found by following imports, including those inside functions,
and calls of ``plugins.modules_of``.
The digest covers their syntax trees without docstrings and comments, and the data files next to
them: a reworded docstring makes nothing stale. Modules of declarations that all stages share
(settings, tables, schemas, project) are followed name by name. A new setting of one stage therefore
does not make the others stale. The digests are cached in the user's cache folder under a
checksum of the whole package, because walking the syntax trees takes seconds.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from intercap_core.kernel_cache import cache_base
from intercap_core.stage_list import STAGES

PACKAGE = "intercap_core"
ROOT = Path(__file__).resolve().parents[1]
# Modules that many stages import for a few names each: only the names that are used count.
DECLARATIONS = frozenset(
    f"{PACKAGE}.{name}"
    for name in (
        "annotation", "config", "config_types", "entries", "project", "schemas", "sequence_inputs",
    )
)  # fmt: skip
# Modules that change no result: caches, messages, and the list of stages. The parts of that list
# that concern a stage (its artefacts and columns) are in the stage's manifest.
NEUTRAL = frozenset(
    f"{PACKAGE}.{name}" for name in ("disk", "kernel_cache", "progress", "signals", "stage_list")
)
DATA_FOLDERS = ("data", "templates")

WHOLE = "*"  # stands for every name of a module

MODULES = {
    **{stage: f"stages.{stage}" for stage in STAGES},
    "dataset": "stages.dataset",
    "merged exports": "output.export.merged",
    "studio": "studio.capture",
}


@dataclass(frozen=True)
class StageCode:
    """The code of one stage."""

    digests: Mapping[str, str]
    """Digest of the modules that it reaches, by package."""
    parameters: tuple[str, ...]
    """Names of the arguments of its ``run``; () for others than stages."""


@cache
def stage_code(name: str) -> StageCode:
    """The code of a stage or of another name of ``MODULES``."""
    return _all_stage_code()[name]


@cache
def _all_stage_code() -> dict[str, StageCode]:
    """Code of all stages by name, from the cache if the package is unchanged."""
    folder = cache_base() / "code"
    path = folder / f"{_package_checksum()}.json"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        cached = json.loads(path.read_text(encoding="utf-8"))
        return {name: StageCode(cached[name][0], tuple(cached[name][1])) for name in MODULES}
    code = {
        name: StageCode(code_digests(module), _run_parameters(module))
        for name, module in MODULES.items()
    }
    with contextlib.suppress(OSError):  # without a writable cache, the next start computes again
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        part.write_text(json.dumps({n: [dict(c.digests), c.parameters] for n, c in code.items()}))
        os.replace(part, path)
        # keep the 16 newest files, one per version of the code
        for old in sorted(folder.glob("*.json"), key=_date)[:-16]:
            old.unlink(missing_ok=True)
    return code


def _date(path: Path) -> int:
    return path.stat().st_mtime_ns


def _run_parameters(module: str) -> tuple[str, ...]:
    """Names of the keyword arguments of ``run``, without importing the module."""
    for node in ast.parse(_path(f"{PACKAGE}.{module}", ROOT).read_bytes()).body:
        if isinstance(node, ast.FunctionDef) and node.name == "run":
            return tuple(argument.arg for argument in node.args.kwonlyargs)
    return ()


def _package_checksum() -> str:
    """Checksum of the package's code, and of the size and date of its data files.

    Copies of the package in other folders have the same checksum.
    """
    state = hashlib.sha256()
    for folder, folders, names in os.walk(ROOT):
        folders[:] = sorted(name for name in folders if name != "__pycache__")
        relative = Path(folder).relative_to(ROOT)
        is_data = any(part in DATA_FOLDERS for part in relative.parts)
        for name in sorted(names):
            path = Path(folder, name)
            if is_data:
                stat = path.stat()
                state.update(f"{relative / name} {stat.st_size} {stat.st_mtime_ns}\n".encode())
            elif name.endswith(".py"):
                text = path.read_bytes()
                state.update(f"{relative / name} {len(text)}\n".encode())
                state.update(text)
    return state.hexdigest()[:24]


@dataclass(frozen=True)
class _Statement:
    """A top-level statement of a module, without docstrings."""

    content: bytes  # syntax tree as text
    defines: frozenset[str]  # names that it binds; empty for statements with other effects
    uses: frozenset[str]  # names that it mentions, including those in strings
    imports: tuple[tuple[str, str], ...]  # (module, name) pairs, anywhere inside it


def code_digest(module: str, *, root: Path = ROOT) -> str:
    """One digest of all code and data that ``module`` reaches; raises as :func:`code_digests`."""
    found = code_digests(module, root=root)
    return hashlib.sha256("".join(f"{k} {v}\n" for k, v in found.items()).encode()).hexdigest()[:16]


def code_digests(module: str, *, root: Path = ROOT) -> dict[str, str]:
    """Digests of all code and data that ``module`` (e.g. "stages.joint") reaches, by subpackage.

    ``root`` is the folder of the package. Raises FileNotFoundError if the module does not exist.
    """
    states: dict[str, hashlib._Hash] = {}
    reached = modules_reached(module, root=root)
    for name in sorted(reached):
        state = states.setdefault(_subpackage(name), hashlib.sha256())
        state.update(name.encode())
        for statement in _used(name, reached[name], root):
            state.update(statement.content)
    for folder in sorted({_path(name, root).parent for name in reached}):
        for path in _data_files(folder):
            relative = path.relative_to(root)
            state = states.setdefault(relative.parts[0], hashlib.sha256())
            state.update(relative.as_posix().encode())
            state.update(_file_digest(path, path.stat().st_mtime_ns))
    return {name: state.hexdigest()[:16] for name, state in sorted(states.items())}


def _subpackage(module: str) -> str:
    """Second part of a module's name, e.g. "joint"; the package's name for the package itself."""
    return [*module.split("."), PACKAGE][1]


def modules_reached(module: str, *, root: Path = ROOT) -> dict[str, frozenset[str]]:
    """Modules of the package that ``module`` imports, directly or indirectly, with the names used.

    The names are ``{"*"}`` for all modules except the shared declarations.
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
        if name not in DECLARATIONS:
            used = WHOLE
        known = reached.get(name, frozenset())
        if used in known or WHOLE in known:
            continue
        reached[name] = frozenset({WHOLE}) if used == WHOLE else known | {used}
        for statement in _used(name, reached[name], root):
            waiting.extend(statement.imports)
    return reached


def _used(module: str, names: frozenset[str], root: Path) -> list[_Statement]:
    """Top-level statements that are needed to define ``names``, in order."""
    path = _path(module, root)
    statements = _statements(path, path.stat().st_mtime_ns, root)
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
def _statements(path: Path, mtime_ns: int, root: Path) -> tuple[_Statement, ...]:
    """Top-level statements of a module; ``mtime_ns`` invalidates the cache after an edit."""
    tree = ast.parse(path.read_bytes(), str(path))
    return tuple(_statement(node, root) for node in tree.body if not _is_text(node))


def _statement(statement: ast.stmt, root: Path) -> _Statement:
    """Read a statement in one pass over its syntax tree."""
    content: list[str] = []
    uses: set[str] = set()
    imports: list[tuple[str, str]] = []

    def read(node: ast.AST) -> None:
        kind = type(node)
        content.append(kind.__name__)
        if kind is ast.Name:
            uses.add(node.id)  # type: ignore[attr-defined]
        elif kind is ast.Constant and isinstance(node.value, str):  # type: ignore[attr-defined]
            uses.add(node.value)  # type: ignore[attr-defined]  # annotations may be strings
        elif kind in _IMPORTING:
            imports.extend(_imports(node, root))
        for name in node._fields:
            value = getattr(node, name, None)
            # the context (load, store) follows from the other fields; versions of Python differ in
            # fields that are empty
            if name == "ctx" or value is None or value == []:
                continue
            content.append(name)
            if isinstance(value, list):
                content.append("[")
                for entry in value:
                    if not isinstance(entry, ast.AST):
                        content.append(repr(entry))
                    elif name != "body" or not _is_text(entry):
                        read(entry)
                content.append("]")
            elif isinstance(value, ast.AST):
                read(value)
            else:
                content.append(repr(value))

    read(statement)
    return _Statement(
        "\n".join(content).encode(), frozenset(_defines(statement)), frozenset(uses), tuple(imports)
    )


def _is_text(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _defines(statement: ast.stmt) -> set[str]:
    """Names that a statement binds; empty for statements with other effects."""
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {statement.name}
    if isinstance(statement, ast.Assign | ast.AnnAssign):
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        return {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}
    if isinstance(statement, ast.Import | ast.ImportFrom):
        return {(alias.asname or alias.name).split(".")[0] for alias in statement.names}
    return set()


_IMPORTING = (ast.Import, ast.ImportFrom, ast.Call)  # nodes of which _imports finds modules


def _imports(node: ast.AST, root: Path) -> list[tuple[str, str]]:
    """Pairs (module, name) that a node imports from the package, with parent packages.

    No import in the package is relative (ruff's rule TID252).
    ``from a import b`` counts both as the name b of module a and as a module a.b, if that exists.
    """
    targets: list[tuple[str, str]] = []
    if isinstance(node, ast.Import):
        targets = [(alias.name, WHOLE) for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        targets = [(str(node.module), alias.name) for alias in node.names]
        targets += [(f"{node.module}.{alias.name}", WHOLE) for alias in node.names]
    elif isinstance(node, ast.Call):
        targets = [(name, WHOLE) for name in _discovered(node, root)]
    found: list[tuple[str, str]] = []
    for name, used in targets:
        if _exists(name, root):
            found.append((name, used))
            found += [(parent, WHOLE) for parent in _parents(name)]
    return found


def _discovered(call: ast.Call, root: Path) -> list[str]:
    """The modules that ``plugins.modules_of("package")`` imports; [] for any other call."""
    function = call.func
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    argument = call.args[0] if call.args else None
    package = argument.value if isinstance(argument, ast.Constant) else None
    if name != "modules_of" or not isinstance(package, str):
        return []
    files = sorted(_path(package, root).parent.glob("*.py"))
    return [f"{package}.{file.stem}" for file in files if file.stem != "__init__"]


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
