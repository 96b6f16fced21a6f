"""The `intercap` command: check a project, run it, view and correct results.

Commands import numerical libraries themselves, so that `--help` answers at once.
"""

from __future__ import annotations

import copy
import io
import sys
from typing import Annotated

import typer

from intercap_core import disk
from intercap_core.cli import developer, look, project, stage
from intercap_core.errors import UserError
from intercap_core.signals import Terminated, raise_on_signals
from intercap_core.versions import versions

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help=(
        "Multi-camera RGB-D recordings of people handling objects, turned into a finished 4D "
        "dataset.\n\n"
        "[bold]A first look, in a checkout:[/bold] [cyan]intercap run config/demo/config.yaml"
        "[/cyan] makes three virtual recordings and everything up to the report.\n\n"
        "[bold]Own recordings, InterCap, BEHAVE:[/bold] [cyan]intercap init FOLDER --output "
        "lab[/cyan] writes settings and tables,\n\n"
        "[cyan]intercap check lab/config.yaml[/cyan] lists the problems in them, and\n\n"
        "[cyan]intercap run lab/config.yaml[/cyan] computes everything that is missing or out of "
        "date.\n\n"
        "[bold]One stage:[/bold] [cyan]intercap stage joint config/demo/config.yaml "
        "cup_drink_s02[/cyan] runs one stage on the results of earlier ones; "
        "[cyan]intercap inspect results/demo/cup_drink_s02/joint.h5[/cyan] prints the contents of "
        "a result file."
    ),
)


def _add_commands(group: typer.Typer, *, panel: str | None = None, hidden: bool = False) -> None:
    """Add the commands of a group to the top level, ``hidden`` as aliases of earlier versions."""
    for command in group.registered_commands:
        alias = copy.copy(command)
        alias.rich_help_panel, alias.hidden = panel, hidden or command.hidden
        app.registered_commands.append(alias)


_add_commands(project.app, panel="A dataset")
_add_commands(look.app, panel="Look, correct and maintain")
_PANEL = "Groups of commands"
for _group, _name, _purpose in (
    (stage.app, "stage", "Run one stage of one sequence."),
    (developer.app, "dev", "Develop this program: evaluate it, measure time, write documentation."),
):
    app.add_typer(_group, name=_name, help=_purpose, no_args_is_help=True, rich_help_panel=_PANEL)
    _add_commands(_group, hidden=True)


def _print_version(wanted: bool) -> None:
    if wanted:
        for name, version in versions():
            typer.echo(f"{name} {version}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True,
            help="Print the versions of this program, Python and libraries.",
        ),
    ] = False,
) -> None:  # fmt: skip
    """Options of all commands."""


def main() -> None:
    """Entry point. Faults of input or disk are printed in one line and exit with status 1.

    A signal exits with the status that shells expect, 128 plus its number.
    """
    for stream in (sys.stdout, sys.stderr):  # terminals of other encodings, names that are no text
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        with raise_on_signals():
            app()
    except UserError as error:
        print(f"error: {error.shortened()}", file=sys.stderr)
        raise SystemExit(1) from None
    except Terminated as end:
        print(f"{end}: incomplete outputs are removed; run again to continue", file=sys.stderr)
        raise SystemExit(end.status) from None
    except OSError as error:
        if error.errno not in disk.FULL | disk.NOT_WRITABLE:
            raise
        print(f"error: {disk.describe_fault(error)}", file=sys.stderr)
        raise SystemExit(1) from None
