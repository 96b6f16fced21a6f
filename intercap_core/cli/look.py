"""Commands that show or correct results, and check files."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from intercap_core.cli.options import (
    Cores,
    Settings,
    SettingsOrDefault,
    find_sequence,
    open_project,
    prepare,
)
from intercap_core.errors import UserError
from intercap_core.signals import Terminated

app = typer.Typer()
WIDEST_HOLE = 0.1  # default limit, as a share of the object's length


@app.command()
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


@app.command()
def inspect(
    file: Annotated[Path, typer.Argument(help="A result file (.h5), which a stage wrote.")],
    verify: Annotated[bool, typer.Option(help="Read all data and check its checksums.")] = False,
) -> None:
    """Print the contents of a result file: attributes, datasets with shapes and units, flags.

    Example: intercap inspect results/demo/cup_drink_s02/joint.h5
    """
    from intercap_core.commands.inspect import print_summary

    print_summary(file, verify=verify)


@app.command()
def annotate(
    settings: SettingsOrDefault,
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
    ] = True,
) -> None:
    """Correct annotations in the browser: view results over the images, edit, re-run stages.

    Serves a page on the loopback address and prints its URL. From another machine, open a tunnel
    (ssh -L PORT:127.0.0.1:PORT HOST) and use the same URL. docs/annotate.md is a five-minute
    introduction.

    Examples: intercap annotate cup_drink_s02 (of the project in this folder);
    intercap annotate config/demo/config.yaml;
    intercap annotate config/lab/config.yaml cup_drink_s02 --port 8123 --by ann
    """
    prepare()
    from intercap_core.annotate.serve import serve

    settings, sequence = find_sequence(settings, sequence)
    with suppress(Terminated):  # Ctrl-C is the normal way to end the server
        serve(settings, sequence, port=port, by=by, cores=cores, profile=profile, show=show)


@app.command()
def view(
    settings: SettingsOrDefault,
    sequence: Annotated[str | None, typer.Argument(help="A sequence of the project.")] = None,
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

    Examples: intercap view cup_drink_s02 (of the project in this folder);
    intercap view config/demo/config.yaml cup_drink_s02
    """
    settings, sequence = find_sequence(settings, sequence)
    project = open_project(settings, sequence)
    if sequence is None:
        raise UserError(
            f"{settings}: name one of its sequences: {', '.join(project.sequences)}; "
            f"intercap view {settings} SEQUENCE"
        )
    from intercap_core.commands.pictures import view as write_view

    typer.echo(write_view(project, sequence, output, show=show))


@app.command()
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
    """Render hands in contact: the joint fit, the per-stage fits and, if known, the truth.

    Writes one picture per interval of hand contact, at its middle frame and from two sides. Skin
    within 4.5 mm of the object is red. Needs no display and no GPU.

    Examples: intercap closeups config/demo/config.yaml;
    intercap closeups config/demo/config.yaml cup_drink_s02 --output cup
    """
    prepare()
    from intercap_core.commands.pictures import draw_closeups

    written, empty = draw_closeups(settings, sequences or [], output)
    for path in written:
        typer.echo(path)
    if empty:
        typer.echo(f"no hand in contact: {', '.join(empty)}", err=True)


@app.command(name="close-mesh")
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


@app.command(name="keypoint-definition")
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
    project = open_project(settings)
    import numpy as np

    from intercap_core.body_fit.definition import average_offsets

    fits = [project.artefact(name, "body_fit") for name in project.sequences]
    definition, people = average_offsets([path for path in fits if path.is_file()])
    names = ", ".join(people)
    definition.write(output, f"{project.config.dataset}, {len(people)} people: {names}")
    offset = 1e3 * np.linalg.norm(definition.offsets, axis=1)
    typer.echo(
        f"{output}: learned from {len(people)} people; the keypoints are {offset.mean():.0f} mm "
        f"from the body model's on average, at most {offset.max():.0f} mm, with a standard "
        f"deviation of {1e3 * definition.sigma.mean():.0f} mm; set "
        "body_fit.keypoint_definition to this file"
    )
