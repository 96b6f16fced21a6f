"""`intercap closeups`: one picture of each hand contact."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.output.site.closeups import closeup, holds, read_handling
from intercap_core.project import load_project


def draw_closeups(
    settings: Path, sequences: Sequence[str], output: Path | None = None
) -> tuple[list[Path], list[str]]:
    """Draw every hand contact of ``sequences``, of all sequences if none is named.

    Raises UserError if a sequence is unknown or has no joint fit.

    Args:
        output: folder of the pictures; default: ``closeups`` in the project's results.

    Returns:
        The written pictures, and the names of the sequences without a hand contact.
    """
    project = load_project(settings)
    folder = output or project.results / "closeups"
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file, expected a folder for pictures; name another output")
    for name in sequences:
        project.require_sequence(name)
    written, empty = [], []
    for name in sequences or project.sequences:
        models = project.models(name)
        if models.object_ is None:
            empty.append(name)
            continue
        handling = read_handling(project.paths(name), models, truth=project.sequences[name].truth)
        contacts = holds(handling.probability)
        if not contacts:
            empty.append(name)
        for hold in contacts:
            path = folder / f"{name}_{hold.side}_{hold.first:04d}-{hold.last:04d}.jpg"
            folder.mkdir(parents=True, exist_ok=True)
            path.write_bytes(closeup(handling, hold).content)
            written.append(path)
    return written, empty
