"""`intercap dev`: commands for the development of this program.

Their code is in the folders ``bench`` and ``tools`` of a checkout.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from intercap_core.cli.options import (
    Cores,
    SequenceName,
    Settings,
    check_output,
    open_project,
)
from intercap_core.errors import UserError

app = typer.Typer()


Part = Literal[
    "sequences", "captures", "objects", "bodies", "field_scenes", "field", "detector", "rig", "scan"
]  # fmt: skip


def _of_checkout(name: str) -> Any:
    """Import a module of ``bench`` or ``tools``; raises UserError outside of a checkout."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if not name.startswith(error.name or "-"):
            raise
        raise UserError(
            "this command needs a checkout of the repository, which has the folders bench and "
            "tools; run `make environment` in it and use its .venv/bin/intercap"
        ) from None


def _evaluated(stage: str, which: str = "Projects") -> Any:
    """Option for the projects of a part of the evaluation."""
    words = f"{which} evaluated up to {stage}; may repeat."
    return typer.Option(metavar="SETTINGS", help=words)


@app.command()
def evaluate(
    settings: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SETTINGS",
            help="Projects evaluated up to the metrics. Default here and of the options below: the "
            "recordings in config/.",
        ),
    ] = None,
    captures: Annotated[list[Path] | None, _evaluated("the scene")] = None,
    objects: Annotated[list[Path] | None, _evaluated("the object track")] = None,
    bodies: Annotated[list[Path] | None, _evaluated("the body fit")] = None,
    field_scenes: Annotated[
        list[Path] | None, _evaluated("the scene", "Projects with field conditions,")
    ] = None,
    field: Annotated[
        list[Path] | None,
        _evaluated("the metrics", "Projects with and without field conditions,"),
    ] = None,
    detector: Annotated[
        list[Path] | None,
        _evaluated("the metrics", "Projects with keypoints of a real detector (make mediapipe),"),
    ] = None,
    rig: Annotated[
        list[Path] | None,
        _evaluated("the detections", "Projects whose camera poses are withheld and found,"),
    ] = None,
    scan: Annotated[
        list[Path] | None,
        _evaluated("the body fit", "Projects in which objects are turned and scanned,"),
    ] = None,
    only: Annotated[
        Part | None,
        typer.Option(
            help="Evaluate one part only: sequences, field and detector up to the metrics, "
            "captures and field_scenes up to the scene, objects up to the object track, bodies and "
            "scan up to the body fit, rig up to the detections."
        ),
    ] = None,
    output: Annotated[Path, typer.Option(help="Flat JSON of all figures.")] = Path(
        "results/evaluation.json"
    ),
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Evaluate six recordings in about five minutes; exit with an error if a figure is "
            "worse than in bench/reference-quick.json by more than its spread.",
        ),
    ] = False,
    update_reference: Annotated[
        bool,
        typer.Option(
            "--update-reference",
            help="With --quick: record the figures in bench/reference-quick.json.",
        ),
    ] = False,
    seed: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Draw other people, motions, rooms and errors; results go to results/seed_<N>.",
        ),
    ] = None,
    cores: Cores = 0,
) -> None:
    """Run the virtual evaluation recordings and print their errors against the truth.

    Examples: intercap dev evaluate; intercap dev evaluate --only bodies --output body.json;
    intercap dev evaluate --only objects --seed 7 --output results/seed_7/evaluation.json
    """
    check_output(output, replace_any=True)
    if quick and seed is not None:
        raise UserError("--quick is a fixed set; leave out --quick or --seed")
    if update_reference and not quick:
        raise UserError("--update-reference records the quick set; add --quick")
    evaluation = _of_checkout("bench.evaluate.run")
    if quick:
        status = evaluation.evaluate_quick(output, cores=cores, renew_reference=update_reference)
        raise typer.Exit(status)
    parts = {
        "sequences": settings, "captures": captures, "objects": objects, "bodies": bodies,
        "field_scenes": field_scenes, "field": field, "detector": detector, "rig": rig,
        "scan": scan,
    }  # fmt: skip
    chosen = {part: some or [] for part, some in parts.items() if only in (None, part)}
    raise typer.Exit(evaluation.evaluate(chosen, output, cores=cores, seed=seed))


@app.command()
def bench(
    settings: Settings = Path("config/bench/config.yaml"),
    output: Annotated[Path, typer.Option(help="Flat JSON of all figures.")] = Path(
        "results/bench.json"
    ),
    cores: Cores = 0,
) -> None:
    """Measure seconds per frame and peak memory on one recording, by stage and end to end.

    Example: intercap dev bench
    """
    check_output(output, replace_any=True)
    _of_checkout("bench.workflow_speed").measure(settings, output, cores=cores)


@app.command()
def studio(settings: Settings, sequence: SequenceName) -> None:
    """Make one virtual recording whose truth is known.

    Example: intercap dev studio config/demo/config.yaml cup_drink_s02
    """
    project = open_project(settings, sequence)
    from intercap_core.pipeline.step import run_studio

    typer.echo(run_studio(project, sequence))


@app.command()
def docs(
    root: Annotated[Path, typer.Argument(help="The project's root.")] = Path("."),
    check_only: Annotated[bool, typer.Option("--check", help="Only list stale files.")] = False,
) -> None:
    """Write the files that are generated from code: settings, schemas, pages on result files."""
    stale = _of_checkout("tools.generated_docs").generate(root, write=not check_only)
    for path in stale:
        typer.echo(f"{'stale' if check_only else 'written'}: {path}")
    if check_only and stale:
        raise typer.Exit(1)
