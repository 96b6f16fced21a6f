"""`intercap stage`: one stage of one sequence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from intercap_core.cli.options import (
    SequenceName,
    Settings,
    check_output,
    open_project,
)
from intercap_core.stage_list import STAGES

app = typer.Typer()


def _stage_command(stage: str, purpose: str) -> Callable[..., None]:
    """Command that runs one stage of one sequence; its help begins with ``purpose``."""

    def command(
        settings: Settings,
        sequence: SequenceName,
        output: Annotated[
            Path | None, typer.Option(help="Output path; default: its path in the project.")
        ] = None,
        threads: Annotated[int, typer.Option(min=1, help="Threads to use.")] = 1,
    ) -> None:
        project = open_project(settings, sequence, threads)
        from intercap_core.pipeline.step import run_step

        if not STAGES[stage].writes_folder:
            written = output or project.artefact(sequence, stage)
            check_output(written, replace_any=output is None)
        typer.echo(run_step(stage, project, sequence, output=output))

    command.__doc__ = (
        f"{purpose}\n\nReads the result files (.h5) of earlier stages of this sequence. Its "
        f"settings are the section `{stage}` of SETTINGS (config/README.md).\n\n"
        f"Example: intercap stage {stage.replace('_', '-')} config/demo/config.yaml cup_drink_s02"
    )
    return command


for _stage in STAGES.values():
    app.command(_stage.name.replace("_", "-"))(_stage_command(_stage.name, _stage.purpose))
