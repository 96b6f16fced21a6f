"""Files of the repository that the package needs and that lie outside of it in a checkout."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


def shipped(name: str) -> Path:
    """Path of a file or folder of the repository, such as ``config/objects.yaml``.

    It lies in the checkout, or in the folder ``shipped`` of the installed package.
    """
    installed = PACKAGE / "shipped"
    return (installed if installed.is_dir() else PACKAGE.parent) / name
