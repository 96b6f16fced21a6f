"""Versions of this program, Python and the libraries that influence numerical results."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

_LIBRARIES = ("numpy", "torch", "open3d", "opencv-python-headless", "h5py", "scipy")


def versions() -> list[tuple[str, str]]:
    """Names and versions of this program, Python and the installed libraries."""
    rows = [("intercap-core", version("intercap-core")), ("Python", platform.python_version())]
    for name in _LIBRARIES:
        try:
            rows.append((name, version(name)))
        except PackageNotFoundError:
            continue
    return rows
