"""`intercap view`: show a sequence in the browser; needs its frames, scene and body_fit."""

from __future__ import annotations

import webbrowser
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.output.viewer import page
from intercap_core.project import Project


def view(project: Project, sequence: str, output: Path | None = None, *, show: bool = True) -> Path:
    """Write a page with the sequence's viewer; returns its path.

    Raises UserError if the artefact of frames, scene or body_fit is missing, or one is damaged.

    Args:
        output: folder of the page; default: ``view`` next to the sequence's artefacts.
        show: open the page in the browser.
    """
    paths = project.paths(sequence)
    for needed in (paths.frames, paths.scene, paths.body_fit):
        if not needed.is_file():
            raise UserError(
                f"{needed}: no such file, expected the artefact of an earlier stage; run "
                f"`intercap run {project.path} -- --until body_fit` first"
            )
    folder = output or project.results / sequence / "view"
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file, expected a folder for the page; name another output")
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
