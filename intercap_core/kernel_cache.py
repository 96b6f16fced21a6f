"""Where compiled kernels are kept, so that no kernel is older than the code that it was made of.

Numba keeps a compiled function by the content of its own file alone. A kernel that calls one of
another file, or uses a constant of another file, would go on with the old one after an edit there.
So the cache's folder is named after a digest of everything that a kernel can reach: the modules
that use numba and all that they import, the versions of numba and llvmlite, and the processor (a
home may be shared by machines that differ).

Imports nothing heavy, numba least of all: this runs whenever the package is imported.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import stat
import sys
import time
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
VARIABLE = "NUMBA_CACHE_DIR"
UNUSED_DAYS = 28  # a folder that no process has used for so long is emptied,
KEPT_FOLDERS = 4  # unless it is one of the last few in use
FORGOTTEN_DAYS = 365  # by then no process that knew the folder runs any more
DAY_S = 86400.0

_NAME = re.compile(r"intercap-[0-9a-f]{16}")
_USES_NUMBA = re.compile(rb"(?:from|import)[ \t]+numba\b")
_IMPORT = re.compile(
    rb"from[ \t]+(intercap_core[\w.]*)[ \t]+import[ \t]+(\([^)]*\)|(?:[^\n\\]|\\\n)*)"
    rb"|import[ \t]+(intercap_core[\w.]*)"
)
_WORD = re.compile(rb"\w+")


def use_kernel_cache() -> Path | None:
    """Let numba keep this package's kernels in the folder that belongs to the present code.

    The folder lies in ``NUMBA_CACHE_DIR`` where that is set, otherwise in the user's cache folder;
    where neither can be written, in the folder for temporary files. None where none can.
    """
    name = _folder_name()
    folder: Path | None
    try:
        folder = _prepared(_chosen_base() / name)
    except OSError as error:
        folder = _temporary(name, error)
    if folder is None:
        return None
    os.environ[VARIABLE] = str(folder)
    numba_settings = sys.modules.get("numba.core.config")
    if numba_settings is not None:  # imported before this package: has read the variable already
        numba_settings.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    return folder


def kernel_modules(package: Path = PACKAGE) -> dict[str, bytes]:
    """Source of every module whose code or constants a kernel can reach, by the module's name.

    These are the modules that import numba and what they import, directly or not. The text is
    searched instead of parsed, which takes a tenth of the time and finds rather too much.
    """
    sources = {name.encode(): text for name, text in _sources(package).items()}
    waiting = [name for name, text in sources.items() if _USES_NUMBA.search(text)]
    reached: set[bytes] = set()
    while waiting:
        name = waiting.pop()
        if name in reached or name not in sources:
            continue
        reached.add(name)
        waiting.append(name.rpartition(b".")[0])
        for module, names, whole in _IMPORT.findall(sources[name]):
            base = module or whole
            waiting.append(base)
            waiting += [base + b"." + part for part in _WORD.findall(names)]
    return {name.decode(): sources[name] for name in sorted(reached)}


def _sources(package: Path) -> dict[str, bytes]:
    """Text of every module of the package by name, e.g. "intercap_core.body.model"."""
    found: dict[str, bytes] = {}
    waiting = [(str(package), "intercap_core")]
    while waiting:
        folder, prefix = waiting.pop()
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.name.endswith(".py"):
                    stem = entry.name[:-3]
                    with open(entry.path, "rb") as file:
                        found[prefix if stem == "__init__" else f"{prefix}.{stem}"] = file.read()
                elif entry.name.isidentifier() and entry.name != "__pycache__" and entry.is_dir():
                    waiting.append((entry.path, f"{prefix}.{entry.name}"))
    return found


def _folder_name() -> str:
    state = hashlib.sha256()
    for name, text in kernel_modules().items():
        state.update(f"{name} {len(text)}\n".encode())
        state.update(text)
    for library in ("numba", "llvmlite"):
        state.update(_version(library))
    state.update(f"{sys.implementation.cache_tag} {_user()}\n".encode())
    state.update(_processor())
    return f"intercap-{state.hexdigest()[:16]}"


def _version(library: str) -> bytes:
    """What tells a library's version, without importing it."""
    spec = importlib.util.find_spec(library)
    if spec is None or not spec.submodule_search_locations:
        return b""
    path = Path(spec.submodule_search_locations[0]) / "_version.py"
    if path.is_file():
        return path.read_bytes()
    from importlib import metadata  # takes longer than all the rest

    return metadata.version(library).encode()


def _processor() -> bytes:
    """Kind and abilities of this machine's processor."""
    words = [
        os.uname().machine if hasattr(os, "uname") else os.environ.get("PROCESSOR_ARCHITECTURE")
    ]
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            for line in file:
                if not line.strip():
                    break  # the other cores are the same
                key, _, value = line.partition(":")
                if key.strip() in (
                    "model name",
                    "flags",
                    "Features",
                    "CPU implementer",
                    "CPU part",
                ):
                    words.append(value.strip())
    except OSError:
        pass  # not Linux; numba checks the processor once more
    return "\n".join(str(word) for word in words).encode()


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0


def cache_base() -> Path:
    """The user's folder for what this package keeps from one start to the next.

    Raises OSError where no such folder is known.
    """
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if not os.path.isabs(caches):
        raise OSError(f"no folder for caches is known ({caches})")
    return Path(caches) / "intercap"


def _chosen_base() -> Path:
    given = os.environ.get(VARIABLE)
    if given:
        # A process that this one was started by may have set it to a folder of its own code.
        return Path(given).parent if _NAME.fullmatch(Path(given).name) else Path(given)
    return cache_base() / "kernels"


def _prepared(folder: Path) -> Path:
    """The folder, there and marked as used now; raises OSError where it cannot be written."""
    try:
        folder.mkdir(parents=True)
        fresh = True
    except FileExistsError:
        fresh = False
    _assert_own(folder)
    os.utime(folder)
    if fresh:
        remove_unused(folder.parent)
    return folder


def _assert_own(folder: Path) -> None:
    """Raise OSError unless the folder is this user's to write: what lies in it will be run."""
    state = folder.lstat()
    if not stat.S_ISDIR(state.st_mode) or (hasattr(os, "getuid") and state.st_uid != _user()):
        raise PermissionError(f"{folder} is not a folder of this user")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder} cannot be written")


def _temporary(name: str, error: OSError) -> Path | None:
    import logging
    import tempfile

    logger = logging.getLogger("intercap_core")
    try:
        base = Path(tempfile.gettempdir()) / f"intercap-kernels-{_user()}"
        base.mkdir(mode=0o700, exist_ok=True)
        _assert_own(base)
        folder = _prepared(base / name)
    except OSError:
        logger.warning("compiled kernels cannot be kept (%s)", error)
        return None
    logger.warning("compiled kernels are kept in %s (%s)", folder, error)
    return folder


def remove_unused(base: Path, *, now_s: float | None = None) -> None:
    """Empty the folders of other code that nobody has used for weeks, but for the last few.

    Files go and the folders stay for a year: a process that still uses one compiles again, and
    finds a place to keep the result. What another process removes or owns is passed over.
    """
    now_s = time.time() if now_s is None else now_s
    used: list[tuple[float, Path]] = []
    for folder in base.iterdir():
        if not _NAME.fullmatch(folder.name):
            continue
        try:
            _assert_own(folder)
            used.append((folder.stat().st_mtime, folder))
        except OSError:
            continue
    for last_s, folder in sorted(used, reverse=True)[KEPT_FOLDERS:]:
        if now_s - last_s > UNUSED_DAYS * DAY_S:
            _empty(folder, now_s, folders_too=now_s - last_s > FORGOTTEN_DAYS * DAY_S)


def _empty(folder: Path, now_s: float, *, folders_too: bool) -> None:
    mark = folder.stat()
    for place, _, files in os.walk(folder, topdown=False):
        for name in files:
            path = Path(place) / name
            try:
                if now_s - path.stat().st_mtime > DAY_S:  # younger: being written at this moment
                    path.unlink()
            except OSError:
                continue
        if folders_too:
            try:
                os.rmdir(place)
            except OSError:
                continue
    if folder.exists():
        os.utime(folder, ns=(mark.st_atime_ns, mark.st_mtime_ns))
