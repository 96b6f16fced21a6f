"""The `intercap` command: check a project, run it, run one stage of it, inspect an artefact.

Commands import numerical libraries themselves, so that `--help` answers at once.
"""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from intercap_core import disk
from intercap_core.errors import UserError
from intercap_core.signals import Terminated, raise_on_signals
from intercap_core.stage_list import STAGES

if TYPE_CHECKING:
    from intercap_core.project import Project

WHOLE, SINGLE, LOOK = "A whole dataset", "One step of one sequence", "Look and maintain"

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help=(
        "Multi-camera RGB-D recordings of people handling objects, turned into a finished 4D "
        "dataset.\n\n"
        "[bold]A first look:[/bold] [cyan]intercap run config/demo/config.yaml[/cyan] makes three "
        "virtual recordings and everything up to the report.\n\n"
        "[bold]Own recordings:[/bold] fill in config/config.yaml, config/sequences.tsv and "
        "config/subjects.tsv (config/README.md explains every entry), then\n\n"
        "[cyan]intercap check[/cyan] lists the problems in them, and\n\n"
        "[cyan]intercap run[/cyan] computes everything that is missing or out of date.\n\n"
        "[bold]A released dataset:[/bold] [cyan]intercap tables intercap ~/InterCap --output "
        "config/intercap[/cyan] writes these tables for InterCap or BEHAVE.\n\n"
        "[bold]One stage:[/bold] [cyan]intercap joint config/demo/config.yaml cup_drink_s02[/cyan] "
        "runs one stage on existing artefacts; "
        "[cyan]intercap inspect results/demo/cup_drink_s02/joint.h5[/cyan] prints the contents of "
        "an artefact."
    ),
)


class ReleasedKind(StrEnum):
    """Kinds of files that `intercap release` lists."""

    card = "card"
    tables = "tables"
    site = "site"
    export = "export"
    artefact = "artefact"


Part = Literal[
    "sequences", "captures", "objects", "bodies", "field_scenes", "field", "detector"
]  # fmt: skip
WIDEST_HOLE = 0.1  # default limit, as a share of the object's length
DEFAULT_SETTINGS = Path("config/config.yaml")
Settings = Annotated[Path, typer.Argument(metavar="SETTINGS", help="The project's config.yaml.")]
SequenceName = Annotated[str, typer.Argument(help="A sequence of the project's table.")]
Cores = Annotated[int, typer.Option(min=0, help="Processor cores to use; 0 = all.")]


@app.command(rich_help_panel=WHOLE)
def check(settings: Settings = DEFAULT_SETTINGS) -> None:
    """Check settings, tables, annotations and recordings, and list every problem.

    Opens each recording and compares its image size with the calibration, its length with its
    header and the other cameras, and its images with the detections. Takes a fraction of a second
    per sequence.

    Example: intercap check config/demo/config.yaml
    """
    from intercap_core.commands.check import check_bodies, check_detector, check_sequences
    from intercap_core.project import load_project

    project = load_project(settings)
    check_bodies(project)
    notes = check_detector(project)
    start = time.monotonic()
    found = check_sequences(project)
    elapsed, faults = time.monotonic() - start, found.faults
    for summary in found.summaries:
        typer.echo(summary)
    for note in [*notes, *found.notes]:
        typer.echo(f"note: {note}")
    for fault in faults:
        typer.echo(f"problem: {fault}", err=True)
    if found.summaries:
        count = len(found.summaries)
        typer.echo(f"checked the recordings of {count} sequences in {elapsed:.1f} s")
    good = len(project.sequences) - len({fault.sequence for fault in faults} - {""})
    typer.echo(f"{settings}: {good} of {len(project.sequences)} sequences are ready to run")
    if faults:
        raise typer.Exit(1)


@app.command(rich_help_panel=WHOLE)
def tables(
    layout: Annotated[
        Literal["intercap", "behave"],
        typer.Argument(metavar="LAYOUT", help="Released dataset: intercap or behave."),
    ],
    root: Annotated[Path, typer.Argument(help="Folder of the unpacked release.")],
    output: Annotated[
        Path, typer.Option(help="Folder for config.yaml and its tables, such as config/intercap.")
    ],
    dataset: Annotated[
        str | None, typer.Option(help="Name of the dataset; default: the layout's name.")
    ] = None,
    calibrations: Annotated[
        Path | None, typer.Option(help="intercap: folder of calibration_first, _second, _third.")
    ] = None,
    annotations: Annotated[
        Path | None, typer.Option(help="intercap: folder of subject01_motion01_seg0, ...")
    ] = None,
    meshes: Annotated[
        Path | None, typer.Option(help="intercap: folder of the release's 01.ply, 02.ply, ...")
    ] = None,
    objects: Annotated[
        Path, typer.Option(help="intercap without meshes: the objects.yaml to use.")
    ] = Path("config/objects.yaml"),
    keypoints: Annotated[
        Path | None, typer.Option(help="intercap: keypoint files, a folder for each sequence.")
    ] = None,
    candidates: Annotated[
        Path | None, typer.Option(help="intercap: segmentations, a folder for each sequence.")
    ] = None,
    results: Annotated[
        Path | None,
        typer.Option(
            help="Released results that replace the joint fit in metrics and pages, a folder for "
            "each sequence. InterCap: its Res/ folder. BEHAVE: the dataset's folder, or the folder "
            "of its 30 fps parameters with meshes."
        ),
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Overwrite existing files.")] = False,
) -> None:
    """Write a project's settings, tables and annotations for a released dataset.

    The release itself is not changed. Missing and contradictory entries are printed, and written
    as remarks into the tables: read them before you run.

    Examples: intercap tables intercap ~/InterCap --output config/intercap;
    intercap tables intercap ~/InterCap --results ~/InterCap/Res --dataset theirs --output
    config/theirs; intercap tables behave ~/BEHAVE --output config/behave; intercap tables behave
    ~/BEHAVE --results ~/BEHAVE --dataset theirs --output config/theirs
    """
    from intercap_core.commands.tables import write_tables
    from intercap_core.tables.intercap import Sources

    sources = Sources(calibrations, annotations, meshes, keypoints, candidates, results)
    draft, written = write_tables(
        layout, root, output, dataset=dataset, sources=sources, objects=objects, replace=replace
    )
    for remark in draft.all_remarks():
        typer.echo(f"note: {remark}", err=True)
    for path in written:
        typer.echo(path)
    typer.echo(f"{len(draft.rows)} sequences; next: intercap check {output / 'config.yaml'}")


@app.command(
    rich_help_panel=WHOLE,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
)
def run(
    context: typer.Context,
    settings: Settings = DEFAULT_SETTINGS,
    cores: Cores = 0,
    profile: Annotated[
        Path | None,
        typer.Option(help="Snakemake workflow profile: profiles/slurm for a Slurm cluster."),
    ] = None,
) -> None:
    """Compute everything that is missing or out of date, and show the progress.

    Wraps Snakemake, which gets all further arguments. If a sequence fails, the others go on, and
    the report covers those that succeed.

    Examples: intercap run config/demo/config.yaml;
    intercap run config/demo/config.yaml --cores 2 -- --until joint;
    intercap run config/lab/config.yaml --profile profiles/slurm
    """
    from intercap_core.commands.run import run_workflow

    status = run_workflow(settings, cores=cores, profile=profile, arguments=context.args)
    raise typer.Exit(status)


@app.command(rich_help_panel=WHOLE)
def status(
    settings: Settings = DEFAULT_SETTINGS,
    every: Annotated[bool, typer.Option("--all", help="Include sequences that are done.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Print which sequences are done, out of date, failed, running or waiting, with the reasons.

    Compares the manifest of each result (settings, annotation, files, code, libraries) with the
    present one and names the differences. `intercap run` computes exactly these results again.
    Nothing is computed.

    Example: intercap status config/demo/config.yaml
    """
    from intercap_core.commands.status import print_status
    from intercap_core.project import load_project

    print_status(load_project(settings), every=every, as_json=as_json)


@app.command(rich_help_panel=LOOK)
def doctor(
    settings: Annotated[
        Path | None, typer.Argument(metavar="SETTINGS", help="Also check this project's needs.")
    ] = None,
) -> None:
    """Check this machine: versions, GPU, body files, disk, file system, locks, scheduler, browser.

    Exits with status 1 if a requirement is not met.

    Example: intercap doctor config/demo/config.yaml
    """
    from intercap_core.commands.doctor import print_findings
    from intercap_core.project import load_project

    project = None if settings is None else load_project(settings)
    raise typer.Exit(0 if print_findings(project) else 1)


@app.command(rich_help_panel=WHOLE)
def verify(settings: Settings = DEFAULT_SETTINGS) -> None:
    """Read every result completely and list the damaged ones; exits with status 1 if there are any.

    To make a damaged result again, delete it and run.

    Example: intercap verify config/demo/config.yaml
    """
    project = _open(settings)
    from intercap_core.commands.status import print_verification

    raise typer.Exit(0 if print_verification(project) else 1)


@app.command(rich_help_panel=WHOLE)
def report(settings: Settings = DEFAULT_SETTINGS) -> None:
    """Write the site from the existing results: a page per sequence, tables, heatmaps, overview.

    Example: intercap report config/demo/config.yaml
    """
    project = _open(settings)
    from intercap_core.commands.report import write_site

    typer.echo(write_site(project))


@app.command(rich_help_panel=WHOLE)
def compare(
    old: Annotated[Path, typer.Argument(help="Results folder of the earlier version.")],
    new: Annotated[Path, typer.Argument(help="Results folder of the later version.")],
    output: Annotated[
        Path | None, typer.Option(help="Folder for the tables by sequence and by frame, CSV.")
    ] = None,
) -> None:
    """Print the differences between two versions of a dataset, by sequence and frame.

    Lists how far body, hands and object moved after the joint fit, which frames gained or lost
    contact or a flag, the stated errors, and the figures of both versions. Copy the results before
    you fix an annotation, and compare afterwards. You can also compare another program's results
    for the same recordings (column results of sequences.tsv) with ours.

    Example: intercap compare results/demo_before results/demo --output changes
    """
    from intercap_core.commands.compare import print_comparison

    for path in print_comparison(old, new, output):
        typer.echo(path)


@app.command(rich_help_panel=WHOLE)
def release(
    settings: Settings = DEFAULT_SETTINGS,
    only: Annotated[
        list[ReleasedKind] | None,
        typer.Option(help="Kinds of files to list; may repeat. Default: all."),
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Verify this folder against the list in it; needs no settings."
        ),
    ] = None,
) -> None:
    """List the dataset's files with checksums, versions and settings, for publication.

    Writes release.json and release.sha256 next to the card (card.md, card.json, croissant.json);
    the card's texts come from the settings' section `card`. Recipients verify the files with
    --check or with sha256sum -c release.sha256.

    Examples: intercap release config/demo/config.yaml --only card --only tables --only export;
    intercap release --check results/demo
    """
    _prepare()
    from intercap_core.commands.release import check_release, write_release
    from intercap_core.output.release.manifest import KINDS
    from intercap_core.project import load_project

    if check is not None:
        raise typer.Exit(0 if check_release(check) else 1)
    typer.echo(write_release(load_project(settings), [*only] if only else KINDS))


def _evaluated(stage: str, which: str = "Projects") -> Any:
    """Option for the projects of a part of the evaluation."""
    words = f"{which} evaluated up to {stage}; may repeat."
    return typer.Option(metavar="SETTINGS", help=words)


@app.command(rich_help_panel=WHOLE)
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
    only: Annotated[
        Part | None,
        typer.Option(
            help="Evaluate one part only: sequences, field and detector up to the metrics, "
            "captures and field_scenes up to the scene, objects up to the object track, bodies up "
            "to the body fit."
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

    Examples: intercap evaluate; intercap evaluate --only bodies --output body.json;
    intercap evaluate --only objects --seed 7 --output results/seed_7/evaluation.json
    """
    from intercap_core.commands.evaluate.run import evaluate as run_evaluation
    from intercap_core.commands.evaluate.run import evaluate_quick

    _check_output(output, replace_any=True)
    if quick and seed is not None:
        raise UserError("--quick is a fixed set; leave out --quick or --seed")
    if update_reference and not quick:
        raise UserError("--update-reference records the quick set; add --quick")
    if quick:
        status = evaluate_quick(output, cores=cores, renew_reference=update_reference)
        raise typer.Exit(status)
    parts = {
        "sequences": settings, "captures": captures, "objects": objects, "bodies": bodies,
        "field_scenes": field_scenes, "field": field, "detector": detector,
    }  # fmt: skip
    chosen = {part: some or [] for part, some in parts.items() if only in (None, part)}
    raise typer.Exit(run_evaluation(chosen, output, cores=cores, seed=seed))


@app.command(rich_help_panel=WHOLE)
def bench(
    settings: Settings = Path("config/bench/config.yaml"),
    output: Annotated[Path, typer.Option(help="Flat JSON of all figures.")] = Path(
        "results/bench.json"
    ),
    cores: Cores = 0,
) -> None:
    """Measure seconds per frame and peak memory on one recording, by stage and end to end.

    Example: intercap bench
    """
    from intercap_core.commands.bench import measure

    _check_output(output, replace_any=True)
    measure(settings, output, cores=cores)


@app.command(rich_help_panel=SINGLE)
def studio(settings: Settings, sequence: SequenceName) -> None:
    """Make one virtual recording whose truth is known.

    Example: intercap studio config/demo/config.yaml cup_drink_s02
    """
    project = _open(settings, sequence)
    from intercap_core.pipeline.step import run_studio

    typer.echo(run_studio(project, sequence))


def _stage_command(stage: str, purpose: str) -> Callable[..., None]:
    """Command that runs one stage of one sequence; its help begins with ``purpose``."""

    def command(
        settings: Settings,
        sequence: SequenceName,
        output: Annotated[
            Path | None, typer.Option(help="Output path; default: its path in the project.")
        ] = None,
        threads: Annotated[int, typer.Option(min=1, help="Threads of numerical libraries.")] = 1,
    ) -> None:
        project = _open(settings, sequence, threads)
        from intercap_core.pipeline.step import run_step

        if not STAGES[stage].writes_folder:
            written = output or project.artefact(sequence, stage)
            _check_output(written, replace_any=output is None)
        typer.echo(run_step(stage, project, sequence, output=output))

    command.__doc__ = (
        f"{purpose}\n\nReads the artefacts of earlier stages of this sequence. Its settings are "
        f"the section `{stage}` of SETTINGS (config/README.md).\n\n"
        f"Example: intercap {stage.replace('_', '-')} config/demo/config.yaml cup_drink_s02"
    )
    return command


for _stage in STAGES.values():
    app.command(_stage.name.replace("_", "-"), rich_help_panel=SINGLE)(
        _stage_command(_stage.name, _stage.purpose)
    )


@app.command(rich_help_panel=LOOK)
def inspect(
    artefact: Annotated[Path, typer.Argument(help="An .h5 file that a stage wrote.")],
    verify: Annotated[bool, typer.Option(help="Read all data and check its checksums.")] = False,
) -> None:
    """Print the contents of an artefact: attributes, datasets with shapes and units, flags.

    Example: intercap inspect results/demo/cup_drink_s02/joint.h5
    """
    from intercap_core.commands.inspect import print_summary

    print_summary(artefact, verify=verify)


@app.command(name="close-mesh", rich_help_panel=LOOK)
def close_mesh(
    mesh: Annotated[Path, typer.Argument(metavar="IN", help="The mesh with holes.")],
    output: Annotated[Path, typer.Argument(metavar="OUT", help="A new .ply or .obj.")],
    widest_mm: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Widest hole to close, mm; default: a tenth of the object's length."
        ),
    ] = None,
) -> None:
    """Close the small holes of an object's mesh with flat covers, and list them.

    Wider holes are an error, because their surface is unknown. The input file is not changed,
    vertices keep their indices, and textures become vertex colours.

    Example: intercap close-mesh scan.ply scan_closed.ply --widest-mm 30
    """
    from intercap_core.geometry.rigid.closing import close_mesh as close

    widest = None if widest_mm is None else 1e-3 * widest_mm
    done = close(mesh, output, widest_m=widest, share=WIDEST_HOLE)
    for hole in done.closed:
        typer.echo(f"closed: {hole}")
    left = f"; {done.strays} open edges form no loop and are left" if done.strays else ""
    state = "watertight" if done.watertight else "still open"
    typer.echo(
        f"{output}: {len(done.closed)} holes closed with {done.faces_added} faces, {state}{left}"
    )


@app.command(name="keypoint-definition", rich_help_panel=LOOK)
def keypoint_definition(
    settings: Settings,
    output: Annotated[Path, typer.Argument(metavar="OUT", help="The table to write, a .tsv.")],
) -> None:
    """Estimate where your keypoint detector's joints lie on the body, from recordings with depth.

    Joints of the same name lie up to 3 cm apart in OpenPose, COCO and MediaPipe. Name the written
    table in body_fit.keypoint_definition to use the estimate for recordings without depth.
    Requires the body_fit results of at least three people with depth.

    Example: intercap keypoint-definition lab/config.yaml lab/detector.tsv
    """
    _prepare()
    from intercap_core.commands.definition import learn_definition

    typer.echo(learn_definition(settings, output))


@app.command(rich_help_panel=LOOK)
def annotate(
    settings: Settings = DEFAULT_SETTINGS,
    sequence: Annotated[
        str | None, typer.Argument(help="A sequence; without it, a list of all, worst first.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 = any free port.")] = 0,
    by: Annotated[
        str,
        typer.Option(metavar="NAME", help="Name of the annotator, stored with answers and time."),
    ] = "",
    cores: Cores = 0,
    profile: Annotated[
        Path | None,
        typer.Option(
            help="Workflow profile of the runs, as for `intercap run`; the page shows the command."
        ),
    ] = None,
    show: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the default browser.")
    ] = False,
) -> None:
    """Correct annotations in the browser: view results over the images, edit, re-run stages.

    Serves a page on the loopback address and prints its URL. From another machine, open a tunnel
    (ssh -L PORT:127.0.0.1:PORT HOST) and use the same URL. docs/annotate.md is a five-minute
    introduction.

    Examples: intercap annotate cup_drink_s02 (of config/config.yaml);
    intercap annotate config/demo/config.yaml;
    intercap annotate config/lab/config.yaml cup_drink_s02 --port 8123 --by ann
    """
    _prepare()
    from intercap_core.annotate.serve import serve

    if sequence is None and not settings.exists() and settings.suffix == "":
        settings, sequence = DEFAULT_SETTINGS, str(settings)  # a single name is a sequence
    with suppress(Terminated):  # Ctrl-C is the normal way to end the server
        serve(
            settings, sequence, port=port, by=by, cores=cores, profile=profile, show=show,
            say=lambda line: typer.echo(line),
        )  # fmt: skip


@app.command(rich_help_panel=LOOK)
def view(
    settings: Settings,
    sequence: SequenceName,
    output: Annotated[
        Path | None, typer.Option(help="Folder for the page; default: view/ in its results.")
    ] = None,
    show: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the default browser.")
    ] = True,
) -> None:
    """View a sequence in 3D over time, in a browser: body, object, point clouds, cameras, contact.

    Shows all fits that exist (sequential and joint) and the truth if it is known; needs at least
    the result of body_fit. The page needs no network and no server. Every page of the site
    contains the same viewer.

    Example: intercap view config/demo/config.yaml cup_drink_s02
    """
    project = _open(settings, sequence)
    from intercap_core.commands.view import view as write_view

    typer.echo(write_view(project, sequence, output, show=show))


@app.command(rich_help_panel=LOOK)
def closeups(
    settings: Settings,
    sequences: Annotated[
        list[str] | None, typer.Argument(help="Sequences; default: all of the table.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(help="Folder for the pictures; default: closeups/ in the results."),
    ] = None,
) -> None:
    """Render hands in contact: the joint fit, the sequential fits and, if known, the truth.

    Writes one picture per interval of hand contact, at its middle frame and from two sides. Skin
    within 4.5 mm of the object is red. Needs no display and no GPU.

    Examples: intercap closeups config/demo/config.yaml;
    intercap closeups config/demo/config.yaml cup_drink_s02 --output cup
    """
    _prepare()
    from intercap_core.commands.closeups import draw_closeups

    written, empty = draw_closeups(settings, sequences or [], output)
    for path in written:
        typer.echo(path)
    if empty:
        typer.echo(f"no hand in contact: {', '.join(empty)}", err=True)


@app.command(rich_help_panel=LOOK)
def docs(
    root: Annotated[Path, typer.Argument(help="The project's root.")] = Path("."),
    check_only: Annotated[bool, typer.Option("--check", help="Only list stale files.")] = False,
) -> None:
    """Write the files that are generated from code: settings, schemas, pages on artefacts."""
    from intercap_core.commands.docs import generate

    stale = generate(root, write=not check_only)
    for path in stale:
        typer.echo(f"{'stale' if check_only else 'written'}: {path}")
    if check_only and stale:
        raise typer.Exit(1)


def _prepare(threads: int = 1) -> None:
    """Set the number of threads before numerical libraries are imported; log to standard error."""
    import logging

    from intercap_core.pipeline.job import set_threads

    set_threads(threads)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("intercap_core").setLevel(logging.INFO)


def _open(settings: Path, sequence: str | None = None, threads: int = 1) -> Project:
    """Prepare as :func:`_prepare` and load a project; UserError if it lacks ``sequence``."""
    _prepare(threads)
    from intercap_core.project import load_project

    project = load_project(settings)
    if sequence is not None:
        project.require_sequence(sequence)
    return project


def _check_output(path: Path, *, replace_any: bool) -> None:
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
                f"{path}: exists and is not an artefact, so it is not replaced; name another "
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


if __name__ == "__main__":
    main()
