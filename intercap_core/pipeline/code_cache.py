"""What each stage's code comes to, kept from one start to the next.

Walking the core's syntax trees takes seconds, and nothing but an edit changes the outcome. It is
kept in the user's cache folder under a digest of every file that it can depend on.
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
from intercap_core.pipeline.code_digest import DATA_FOLDERS, PACKAGE, ROOT, code_digests
from intercap_core.stage_list import STAGES

MODULES = {
    **{stage: f"stages.{stage}" for stage in STAGES},
    "dataset": "stages.dataset",
    "studio": "studio.capture",
}
KEPT = 16  # outcomes of other code, the newest


@dataclass(frozen=True)
class StageCode:
    """``digests`` of the code that a stage reaches, by room; ``parameters`` that its ``run`` has,
    none for what is no stage."""

    digests: Mapping[str, str]
    parameters: tuple[str, ...]


@cache
def stage_code(name: str) -> StageCode:
    """The code of a stage, of "dataset" or of the "studio"."""
    return _all()[name]


@cache
def _all() -> dict[str, StageCode]:
    folder = cache_base() / "code"
    path = folder / f"{_key()}.json"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        told = json.loads(path.read_text(encoding="utf-8"))
        return {name: StageCode(told[name][0], tuple(told[name][1])) for name in MODULES}
    found = {
        name: StageCode(code_digests(module), _parameters(ROOT / _file(module)))
        for name, module in MODULES.items()
    }
    with contextlib.suppress(OSError):  # a cache that cannot be kept is no fault
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        part.write_text(json.dumps({n: [dict(c.digests), c.parameters] for n, c in found.items()}))
        os.replace(part, path)
        _prune(folder)
    return found


def _file(module: str) -> str:
    return f"{module.replace('.', '/')}.py"


def _parameters(path: Path) -> tuple[str, ...]:
    """Names of the keyword arguments of the function ``run``, without importing its module."""
    for node in ast.parse(path.read_bytes()).body:
        if isinstance(node, ast.FunctionDef) and node.name == "run":
            return tuple(argument.arg for argument in node.args.kwonlyargs)
    return ()


def _key() -> str:
    """Digest of all that an outcome depends on: the package's code and its data files."""
    state = hashlib.sha256()
    for folder, folders, names in os.walk(ROOT):
        folders[:] = sorted(name for name in folders if name != "__pycache__")
        is_data = any(part in DATA_FOLDERS for part in Path(folder).relative_to(ROOT).parts)
        for name in sorted(names):
            path = Path(folder, name)
            if is_data:
                stat = path.stat()
                state.update(f"{path} {stat.st_size} {stat.st_mtime_ns}\n".encode())
            elif name.endswith(".py"):
                text = path.read_bytes()
                state.update(f"{PACKAGE} {path} {len(text)}\n".encode())
                state.update(text)
    return state.hexdigest()[:24]


def _prune(folder: Path) -> None:
    kept = sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime_ns)
    for path in kept[:-KEPT]:
        path.unlink(missing_ok=True)
