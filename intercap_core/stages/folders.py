"""Folders that a stage writes: they appear whole or not at all."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from intercap_core.artefacts import PART, part_of
from intercap_core.errors import UserError

EXPORT_MARKER = "export.json"  # of an export, and the digests of its files


def check_replaceable(output: Path, *, marker: str, what: str) -> None:
    """Raise UserError where ``output`` holds anything but an earlier ``what``, which has a file
    ``marker``."""
    if output.is_dir():
        if any(output.iterdir()) and not (output / marker).is_file():
            raise UserError(
                f"{output}: the folder is neither empty nor an earlier {what} (it has no "
                f"{marker}); name a new or empty folder, or clear this one yourself"
            )
    elif output.exists() or output.is_symlink():
        raise UserError(f"{output}: is a file, expected a folder for the {what}; name another")


@contextlib.contextmanager
def replaced(output: Path) -> Iterator[Path]:
    """An empty folder that takes the place of ``output`` when the block ends without an error.

    It is filled under a temporary name beside its own, and what was there goes only when the new
    one is complete. An ``output`` that has such a name is filled itself.
    """
    output = output.resolve()
    part = output if output.suffix == PART else part_of(output)
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        yield part
        if part != output:
            put(part, output)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def put(part: Path, output: Path) -> None:
    """Put a complete folder in the place of ``output``, which goes, or stays where this fails."""
    old = part.with_suffix(".old")
    try:
        if output.exists():
            output.rename(old)
        part.rename(output)
    except BaseException:
        if old.exists() and not output.exists():
            old.rename(output)
        raise
    shutil.rmtree(old, ignore_errors=True)
