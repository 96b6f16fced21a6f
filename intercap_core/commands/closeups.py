"""`intercap closeups`: pictures of hands that hold, one file for each hold."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.output.site.closeups import closeup, holds, read_handling
from intercap_core.project import load_project


def draw_closeups(
    settings: Path, sequences: Sequence[str], output: Path | None = None
) -> tuple[list[Path], list[str]]:
    """Draw every hold of ``sequences``, all of the project's where none is named.

    Returns the pictures written, into ``output`` or the project's results, and the sequences
    without a hold. Raises UserError where a sequence is unknown or was not taken to the joint fit.
    """
    project = load_project(settings)
    folder = output or project.results / "closeups"
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file, expected a folder for pictures; name another output")
    unknown = [name for name in sequences if name not in project.sequences]
    if unknown:
        raise UserError(
            f"there is no sequence {unknown[0]!r} in the table; it lists "
            f"{', '.join(project.sequences)}"
        )
    written, empty = [], []
    for name in sequences or project.sequences:
        models = project.models(name)
        if models.object_ is None:
            empty.append(name)
            continue
        handling = read_handling(project.paths(name), models, truth=project.sequences[name].truth)
        found = holds(handling.probability)
        if not found:
            empty.append(name)
        for hold in found:
            path = folder / f"{name}_{hold.side}_{hold.first:04d}-{hold.last:04d}.jpg"
            folder.mkdir(parents=True, exist_ok=True)
            path.write_bytes(closeup(handling, hold).data)
            written.append(path)
    return written, empty
