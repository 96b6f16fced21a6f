"""`intercap view` and `intercap closeups`: a sequence in the browser, pictures of hand contacts."""

from __future__ import annotations

import webbrowser
from collections.abc import Sequence
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.output.site.closeups import closeup, holds, read_handling
from intercap_core.output.viewer import page
from intercap_core.project import Project, load_project


def view(project: Project, sequence: str, output: Path | None = None, *, show: bool = True) -> Path:
    """Write a page with the sequence's viewer into ``output``; returns its path.

    Raises UserError if the artefact of frames, scene or body_fit is missing, or one is damaged.
    """
    paths = project.paths(sequence)
    for needed in (paths.frames, paths.scene, paths.body_fit):
        if not needed.is_file():
            raise UserError(
                f"{needed}: no such file, expected the artefact of an earlier stage; run "
                f"`intercap run {project.path} -- --until body_fit` first"
            )
    folder = output or project.results / sequence / "view"
    _require_folder(folder, "the page")
    folder.mkdir(parents=True, exist_ok=True)
    page.write_script(
        folder / page.SCRIPT,
        paths,
        project.models(sequence),
        truth=project.sequences[sequence].truth,
    )
    written = folder / "index.html"
    written.write_text(page.standalone(sequence), encoding="utf-8")
    if show:
        webbrowser.open(written.resolve().as_uri())
    return written


def draw_closeups(
    settings: Path, sequences: Sequence[str], output: Path | None = None
) -> tuple[list[Path], list[str]]:
    """Draw every hand contact of ``sequences``, of all sequences if none is named.

    Returns the written pictures, and the names of the sequences without a hand contact. Raises
    UserError if a sequence is unknown or has no joint fit.
    """
    project = load_project(settings)
    folder = output or project.results / "closeups"
    _require_folder(folder, "pictures")
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


def _require_folder(path: Path, purpose: str) -> None:
    """Raise UserError if the output ``path`` exists and is no folder."""
    if path.exists() and not path.is_dir():
        raise UserError(f"{path}: is a file, expected a folder for {purpose}; name another output")
