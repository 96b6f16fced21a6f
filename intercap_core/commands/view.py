"""`intercap view`: a sequence in the browser, from any artefact from body_fit on."""

from __future__ import annotations

import webbrowser
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.output.viewer import page
from intercap_core.project import Project
from intercap_core.stage_list import SEQUENCE_STAGES

_NEEDED = ("frames", "scene", "body_fit")


def view(project: Project, sequence: str, output: Path | None = None, *, show: bool = True) -> Path:
    """Write a page with the sequence's viewer and open it in the browser where ``show``.

    Returns the page, in the folder ``output`` or ``view`` beside the sequence's artefacts. Raises
    UserError where the sequence has no body yet or an artefact is broken.
    """
    row = project.sequences[sequence]
    paths = {stage: project.artefact(sequence, stage) for stage in SEQUENCE_STAGES}
    for stage in _NEEDED:
        if not paths[stage].is_file():
            raise UserError(
                f"{paths[stage]}: there is no such file, so there is nothing to look at yet; run "
                f"`intercap run {project.path} -- --until body_fit` first"
            )
    folder = output or project.results / sequence / "view"
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file, expected a folder for the page; name another output")
    folder.mkdir(parents=True, exist_ok=True)
    page.write_script(
        folder / page.SCRIPT,
        paths,
        object_=project.object_of(sequence),
        body_models=project.config.body_models,
        gender=project.subjects[row.subject].gender,
        truth=row.truth,
    )
    written = folder / "index.html"
    written.write_text(page.standalone(sequence), encoding="utf-8")
    if show:
        webbrowser.open(written.resolve().as_uri())
    return written
