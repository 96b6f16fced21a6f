"""Output folders of a stage, which appear complete or not at all."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from intercap_core.artefacts import PART, part_of
from intercap_core.errors import UserError

EXPORT_MARKER = "export.json"  # names the files of an export and their checksums


def check_replaceable(output: Path, *, marker: str, what: str) -> None:
    """Raise UserError if ``output`` holds anything but an earlier output of the same kind.

    Args:
        marker: name of a file that each such output has.
        what: name of the kind, for the message.
    """
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
    """Context manager: yields an empty folder that replaces ``output`` when the block succeeds.

    The folder has a temporary name next to ``output`` and is deleted if the block raises. If
    ``output`` has the suffix of temporary folders itself, it is filled directly.
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
    """Replace ``output`` by a complete folder; restores ``output`` if that fails."""
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
