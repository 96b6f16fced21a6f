"""Cache of compiled kernels that is valid for the present code only.

Numba's cache compares a kernel's own file. After an edit of a function or constant in another file,
it would return a kernel that was compiled from the old one. The folder of the cache is therefore
named after a digest of everything that a kernel can reach: the modules that use numba, all modules
that they import, the versions of numba and llvmlite, and the processor (machines may share a home).

This module runs on every import of the package and imports no large library.
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
UNUSED_DAYS = 28  # age from which the kernels of a folder are deleted
KEPT_FOLDERS = 4  # most recently used folders, which are never emptied
FORGOTTEN_DAYS = 365  # age from which the folder itself is deleted
DAY_S = 86400.0

_NAME = re.compile(r"intercap-[0-9a-f]{16}")
_USES_NUMBA = re.compile(rb"(?:from|import)[ \t]+numba\b")
_IMPORT = re.compile(
    rb"from[ \t]+(intercap_core[\w.]*)[ \t]+import[ \t]+(\([^)]*\)|(?:[^\n\\]|\\\n)*)"
    rb"|import[ \t]+(intercap_core[\w.]*)"
)
_WORD = re.compile(rb"\w+")


def use_kernel_cache() -> Path | None:
    """Set numba's cache to the folder of the present code; returns it, None if none is writable.

    The folder lies in ``NUMBA_CACHE_DIR`` if that is set, otherwise in the user's cache folder; if
    neither is writable, in the folder for temporary files.
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
    """Source text by name of every module that a kernel can reach.

    These are the modules that import numba and all modules that they import, directly or
    indirectly. The text is searched with regular expressions, which takes a tenth of the time of
    parsing and may find too many modules, but not too few.
    """
    sources = {name.encode(): text for name, text in _sources(package).items()}
    # the first condition takes a tenth of the time of the second
    waiting = [
        name for name, text in sources.items() if b"numba" in text and _USES_NUMBA.search(text)
    ]
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
    """Version of a library as bytes, without importing it."""
    spec = importlib.util.find_spec(library)
    if spec is None or not spec.submodule_search_locations:
        return b""
    path = Path(spec.submodule_search_locations[0]) / "_version.py"
    if path.is_file():
        return path.read_bytes()
    from importlib import metadata  # a slow import

    return metadata.version(library).encode()


def _processor() -> bytes:
    """Model and instruction sets of this machine's processor."""
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
    """The package's folder among the user's caches; raises OSError if no cache folder is known."""
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if not os.path.isabs(caches):
        raise OSError(f"no folder for caches is known ({caches})")
    return Path(caches) / "intercap"


def _chosen_base() -> Path:
    given = os.environ.get(VARIABLE)
    if given:
        # The parent process may have set it to the folder of its own code.
        return Path(given).parent if _NAME.fullmatch(Path(given).name) else Path(given)
    return cache_base() / "kernels"


def _prepared(folder: Path) -> Path:
    """Create the folder and update its date; raises OSError if it is not writable."""
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
    """Raise OSError unless this user owns the folder, because its contents will be executed."""
    state = folder.lstat()
    if not stat.S_ISDIR(state.st_mode) or (hasattr(os, "getuid") and state.st_uid != _user()):
        raise PermissionError(f"{folder} is not a folder of this user")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder} cannot be written")


def _temporary(name: str, error: OSError) -> Path | None:
    """Folder of the kernels among the temporary files; None if it cannot be used either."""
    import logging
    import tempfile

    logger = logging.getLogger("intercap_core")
    try:
        base = Path(tempfile.gettempdir()) / f"intercap-kernels-{_user()}"
        base.mkdir(mode=0o700, exist_ok=True)
        _assert_own(base)
        folder = _prepared(base / name)
    except OSError:
        logger.warning("compiled kernels cannot be cached (%s)", error)
        return None
    logger.warning("compiled kernels are cached in %s (%s)", folder, error)
    return folder


def remove_unused(base: Path, *, now_s: float | None = None) -> None:
    """Delete the kernels of other code after ``UNUSED_DAYS``, except for recently used folders.

    The folders stay for a year, so that a process that still uses one can write to it. Files that
    another process or user owns or deletes are skipped.
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
    """Delete the files of a folder that are older than a day, and with ``folders_too`` the folder.

    The folder keeps its date, which is that of its last use.
    """
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
