"""Commands of a whole dataset."""

from __future__ import annotations

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from intercap_core.cli.options import (
    Cores,
    SequenceName,
    Settings,
    SettingsOrDefault,
    open_project,
    prepare,
)

app = typer.Typer()


ReleasedKind = StrEnum("ReleasedKind", ["card", "tables", "site", "export", "artefact"])
"""Kinds of files that `intercap release` lists."""


@app.command()
def init(
    root: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Folder of recordings, or of an unpacked release."),
    ],
    output: Annotated[Path, typer.Option(help="Project folder for config.yaml and tables.")] = Path(
        "."
    ),
    dataset: Annotated[
        str | None, typer.Option(help="Name of the dataset; default: that of FOLDER or release.")
    ] = None,
    calibrations: Annotated[
        Path | None, typer.Option(help="InterCap: folder of calibration_first, _second, _third.")
    ] = None,
    annotations: Annotated[
        Path | None, typer.Option(help="InterCap: folder of subject01_motion01_seg0, ...")
    ] = None,
    meshes: Annotated[
        Path | None, typer.Option(help="Folder of the objects' meshes; InterCap: of 01.ply, ...")
    ] = None,
    objects: Annotated[
        Path | None, typer.Option(help="objects.yaml to use instead of meshes.")
    ] = None,
    keypoints: Annotated[
        Path | None, typer.Option(help="Keypoint files, a folder for each sequence.")
    ] = None,
    candidates: Annotated[
        Path | None, typer.Option(help="Segmentation masks, a folder for each sequence.")
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
    """Write settings and tables for the recordings in a folder, then check them.

    Recognises layouts, cameras, calibrations, keypoints, segmentation masks (candidates) and
    meshes, and copies of InterCap's and BEHAVE's releases. The folder itself is not changed.
    Entries that cannot be recognised get a default and a comment that begins with FILL IN.

    Examples: intercap init ~/recordings --output lab; intercap init ~/InterCap --output intercap;
    intercap init ~/BEHAVE --results ~/BEHAVE --dataset theirs --output theirs
    """
    from intercap_core.commands.init import print_draft, write_tables
    from intercap_core.tables.project_files import Sources

    sources = Sources(calibrations, annotations, meshes, keypoints, candidates, results)
    draft, written = write_tables(
        root, output, dataset=dataset, sources=sources, objects=objects, replace=replace
    )
    print_draft(draft, root)
    typer.echo(f"written: {', '.join(map(str, written))}")
    check(written[0])
    typer.echo(f"next: intercap run {written[0]}")


@app.command(
    hidden=True, context_settings={"allow_extra_args": True, "ignore_unknown_options": True}
)
def tables(context: typer.Context, layout: str) -> None:
    """Former name of `init`, with the name of the release as first argument.

    Example: intercap tables intercap ~/InterCap --output config/intercap
    """
    raise typer.Exit(
        context.find_root().command.main(["init", *context.args], standalone_mode=False) or 0
    )


@app.command()
def check(settings: SettingsOrDefault) -> None:
    """Check settings, tables, annotations and recordings, and list every problem.

    Problems that others may follow from come first; fix them in this order. Opens each recording
    and compares its image size with the calibration, its length with its header and the other
    cameras, and its images with the detections. Takes a fraction of a second per sequence.

    Example: intercap check config/demo/config.yaml
    """
    from intercap_core.commands.check import check_project
    from intercap_core.commands.console import counted

    start = time.monotonic()
    found = check_project(settings)
    elapsed = time.monotonic() - start
    for summary in found.summaries:
        typer.echo(summary)
    for note in found.notes:
        typer.echo(f"note: {note}")
    for fault in found.faults:
        typer.echo(f"problem: {fault}", err=True)
    if found.summaries:
        count = counted(len(found.summaries), "sequence")
        typer.echo(f"checked the recordings of {count} in {elapsed:.1f} s")
    typer.echo(f"{settings}: {found.ready} of {found.sequences} sequences are ready to run")
    if found.faults:
        raise typer.Exit(1)


@app.command()
def calibrate(
    settings: Settings,
    sequence: SequenceName,
    output: Annotated[
        Path | None,
        typer.Option(help="File to write; default: column calibration of the sequence's row."),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="BOARD",
            help="The board that the recordings show, lengths in metres: "
            "charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY, checkerboard:COLUMNSxROWS:SQUARE "
            "(inner corners) or aprilgrid:COLUMNSxROWS:TAG:GAP:DICTIONARY.",
        ),
    ] = None,
    recordings: Annotated[
        list[Path] | None,
        typer.Option(help="Further recordings of the rig, such as of a board; may repeat."),
    ] = None,
    lenses: Annotated[
        Path | None,
        typer.Option(help="Layout plain: calibration file with the lenses; poses are ignored."),
    ] = None,
    distance: Annotated[
        str | None,
        typer.Option(metavar="A:B:METRES", help="Measured distance between two cameras' lenses."),
    ] = None,
    master: Annotated[
        str | None, typer.Option(help="The camera whose frame is the world; default: the first.")
    ] = None,
    background: Annotated[
        bool,
        typer.Option(
            "--background",
            help="Place three or more depth cameras by the furniture and walls that they share. "
            "A person's joints only confirm the poses.",
        ),
    ] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Overwrite an existing file.")] = False,
) -> None:
    """Find the poses of all cameras from a recording, without or with a board.

    Uses everything that the recording shows: a person who walks through the views, surfaces
    measured by depth, and a board. Cameras may have started at different moments. The scale follows
    from depth, the board, --distance or the subject's height (table of subjects). Writes the
    calibration and a page with a picture of the cameras; nothing is written if a camera cannot be
    placed, and the message names what to record instead.

    Examples: intercap calibrate lab/config.yaml walk_01;
    intercap calibrate lab/config.yaml walk_01 --board charuco:8x6:0.06:0.045:4X4_50
    --recordings ~/board; intercap calibrate lab/config.yaml walk_01 --distance k1:k2:2.35
    """
    project = open_project(settings, sequence)
    from intercap_core.commands.calibrate import calibrate as run_calibration

    path, page = run_calibration(
        project, sequence, output=output, lenses=lenses, board=board,
        recordings=recordings or [], distance=distance, master=master, replace=replace,
        background=background,
    )  # fmt: skip
    typer.echo(f"written: {path}\npicture and table: {page}")


@app.command()
def scan(
    settings: Settings,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the object.")],
    sequences: Annotated[
        list[str],
        typer.Argument(metavar="SEQUENCE...", help="Recordings in which a person turns it."),
    ],
    output: Annotated[
        Path | None, typer.Option(help="File of the mesh (.ply); default: objects/NAME.ply.")
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option(help="The detector's class of the object; may repeat. Default: any object."),
    ] = None,
    improve: Annotated[
        bool,
        typer.Option(
            "--improve", help="Improve the mesh of objects.yaml by the tracked sequences."
        ),
    ] = False,
    hand_held: Annotated[
        bool,
        typer.Option(
            "--hand-held", help="One camera is carried around the object, which rests on a table."
        ),
    ] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Overwrite an existing mesh.")] = False,
) -> None:
    """Make a closed, coloured mesh of an object from recordings with depth.

    A person picks the object up and turns it so that every side faces the cameras, also its
    underside; several recordings with different grips may be joined. Hands and furniture are left
    out. An object that only stands before the cameras is scanned too, with a flat underside. With
    --hand-held, one depth camera is carried once around an object on a table or on the floor; its
    pose in the calibration is not used, and no keypoints are needed. Writes the mesh, an entry of
    objects.yaml with a proposed symmetry, and a page with pictures. Nothing is written if a quarter
    of the surface was never measured; the message names what to record instead.

    Examples: intercap scan lab/config.yaml kettle turn_kettle_01 --label bottle;
    intercap scan lab/config.yaml kettle turn_kettle_01 turn_kettle_02 --replace;
    intercap scan lab/config.yaml kettle drink_01 --improve --output kettle_better.ply;
    intercap scan lab/config.yaml kettle around_kettle_01 --hand-held
    """
    project = open_project(settings)
    from intercap_core.commands.scan import scan as run_scan

    _, path, page = run_scan(
        project, name, sequences, output=output, labels=label or [], improve=improve,
        hand_held=hand_held, replace=replace,
    )  # fmt: skip
    typer.echo(f"written: {path}\npictures and figures: {page}")


@app.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
)
def run(
    context: typer.Context,
    settings: SettingsOrDefault,
    cores: Cores = 0,
    profile: Annotated[
        Path | None,
        typer.Option(help="Folder of a Snakemake workflow profile; slurm: that of the package."),
    ] = None,
) -> None:
    """Compute everything that is missing or out of date, and show the progress.

    Wraps Snakemake, which gets all further arguments. If a sequence fails, the others go on, and
    the report covers those that succeed.

    Examples: intercap run config/demo/config.yaml;
    intercap run config/demo/config.yaml --cores 2 -- --until joint;
    intercap run lab/config.yaml --profile lab/slurm
    """
    from intercap_core.commands.run import run_workflow

    status = run_workflow(settings, cores=cores, profile=profile, arguments=context.args)
    raise typer.Exit(status)


@app.command()
def status(
    settings: SettingsOrDefault,
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


@app.command()
def verify(settings: SettingsOrDefault) -> None:
    """Read every result completely and list the damaged ones; exits with status 1 if there are any.

    To make a damaged result again, delete it and run.

    Example: intercap verify config/demo/config.yaml
    """
    project = open_project(settings)
    from intercap_core.commands.status import print_verification

    raise typer.Exit(0 if print_verification(project) else 1)


@app.command()
def report(settings: SettingsOrDefault) -> None:
    """Write the site from the existing results: a page per sequence, tables, heatmaps, overview.

    Example: intercap report config/demo/config.yaml
    """
    project = open_project(settings)
    from intercap_core.pipeline.step import write_site

    typer.echo(write_site(project))


@app.command()
def compare(
    old: Annotated[Path, typer.Argument(help="Results folder of the earlier version.")],
    new: Annotated[Path, typer.Argument(help="Results folder of the later version.")],
    output: Annotated[
        Path | None, typer.Option(help="Folder for the tables by sequence and by frame, CSV.")
    ] = None,
) -> None:
    """Print the differences between two versions of a dataset, by sequence and frame.

    Lists how far body, hands and object moved after the joint fit, which frames gained or lost
    contact or a flag, the estimated errors, and the figures of both versions. Copy the results
    before you fix an annotation, and compare afterwards. You can also compare another program's
    results for the same recordings (column results of sequences.tsv) with ours.

    Example: intercap compare results/demo_before results/demo --output changes
    """
    from intercap_core.commands.compare import print_comparison

    for path in print_comparison(old, new, output):
        typer.echo(path)


@app.command()
def release(
    settings: SettingsOrDefault,
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

    Writes release.json and release.sha256 next to the card (README.md, datasheet.md,
    card.json, croissant.json), and names the statements of the datasheet that the settings lack;
    the card's texts come from the settings' section `card`. Recipients verify the files with
    --check or with sha256sum -c release.sha256.

    Examples: intercap release config/demo/config.yaml --only card --only tables --only export;
    intercap release --check results/demo
    """
    prepare()
    from intercap_core.commands.release import check_release, write_release
    from intercap_core.output.release.manifest import KINDS
    from intercap_core.project import load_project

    if check is not None:
        raise typer.Exit(0 if check_release(check) else 1)
    typer.echo(write_release(load_project(settings), [*only] if only else KINDS))
