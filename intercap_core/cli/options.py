"""Arguments and helpers that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from intercap_core.errors import UserError

if TYPE_CHECKING:
    from intercap_core.project import Project


def default_settings() -> Path:
    """``config.yaml`` of the working directory if there is one, else ``config/config.yaml``."""
    here = Path("config.yaml")
    return here if here.exists() else Path("config") / here


Settings = Annotated[Path, typer.Argument(metavar="SETTINGS", help="The project's settings.")]
SettingsOrDefault = Annotated[
    Path,
    typer.Argument(
        metavar="SETTINGS",
        help="The project's settings.",
        default_factory=default_settings,
        show_default="config.yaml or config/config.yaml",
    ),
]
SequenceName = Annotated[str, typer.Argument(help="A sequence of the project's table.")]
Cores = Annotated[int, typer.Option(min=0, help="Processor cores to use; 0 = all.")]


def prepare(threads: int = 1) -> None:
    """Set the number of threads before numerical libraries are imported; log to standard error."""
    import logging

    from intercap_core.pipeline.job import set_threads

    set_threads(threads)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("intercap_core").setLevel(logging.INFO)


def open_project(settings: Path, sequence: str | None = None, threads: int = 1) -> Project:
    """Prepare as :func:`prepare` and load a project; UserError if it lacks ``sequence``."""
    prepare(threads)
    from intercap_core.project import load_project

    project = load_project(settings)
    if sequence is not None:
        project.require_sequence(sequence)
    return project


def find_sequence(settings: Path, sequence: str | None) -> tuple[Path, str | None]:
    """Return settings and sequence; a single argument that is no settings file is a sequence."""
    if sequence is None and not settings.exists() and settings.suffix not in (".yaml", ".yml"):
        return default_settings(), str(settings)
    return settings, sequence


def check_output(path: Path, *, replace_any: bool) -> None:
    """Raise UserError if the output cannot be written, before any computation.

    Unless ``replace_any``, an existing file is replaced only if it is an artefact.
    """
    import tempfile

    if path.is_dir():
        raise UserError(f"{path}: is a folder, expected a file to write; name another output")
    if path.exists() and not replace_any:
        from intercap_core import artefacts

        try:
            artefacts.schema_name(path)
        except artefacts.Unreadable:
            raise UserError(
                f"{path}: exists and is no result file, so it is not replaced; name another "
                "output or delete it"
            ) from None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror}), expected a folder that takes files; "
            "name another output"
        ) from None
