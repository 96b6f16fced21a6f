"""Folders that are built once in a test session and read by the tests of several workers."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest


def shared_folder(
    factory: pytest.TempPathFactory, key: str, make: Callable[[Path], object]
) -> Path:
    """Return the folder ``key`` of this session, built by the first caller; tests only read it.

    Args:
        make: fills the folder that it is given.
    """
    root = session_folder(factory) / "shared"
    folder, done = root / key, root / f"{key}.done"
    root.mkdir(exist_ok=True)
    with open(root / f"{key}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            folder.mkdir(parents=True)
            make(folder)
            done.touch()
    return folder


def session_folder(factory: pytest.TempPathFactory) -> Path:
    """Return the folder for temporary files that the workers of this session share."""
    base = factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
