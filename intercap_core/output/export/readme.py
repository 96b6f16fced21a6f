"""README.txt of an export: frame, units and meaning of every number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2

from intercap_core.body.maps import maps_path
from intercap_core.config import ExportSettings
from intercap_core.evaluation.verdict.figures import StatedError
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export.about import DEVIATIONS_SOURCE, About
from intercap_core.output.export.motion import Coordinates, Motion
from intercap_core.schemas import CONTACT_M

NEED_OBJECT = ("bop", "contact")  # formats that describe an object only


def readme(
    motion: Motion,
    viewed: Motion,
    mesh: ObjectMesh | None,
    formats: Sequence[str],
    about: About,
    files: Mapping[str, Mapping[str, str]],
    settings: ExportSettings,
) -> str:
    """Compose README.txt.

    Args:
        motion: the motion in the master camera's frame.
        viewed: the motion in the frame of amass, glb and meshes.
        mesh: None without an object; the formats that need one are then omitted.
        formats: formats that the settings list.
        files: written body files, from :func:`.body_files.write`.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "data"),
        autoescape=False,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template("readme.txt.j2").render(
        motion=motion,
        viewed=viewed,
        mesh=mesh,
        formats=formats,
        about=about,
        files=files,
        kind=settings.mesh_format,
        images=settings.images or settings.undistort,
        undistorted=settings.undistort,
        body_file=f"{about.body.path.name}, digest {about.body.to_json()['body_file_digest']}",
        stated_errors=_stated_errors(about.verdict.stated),
        up=Coordinates.of(viewed).header_lines()[1],
        up_of_master=Coordinates.of(motion).header_lines()[1],
        contact_mm=1e3 * CONTACT_M,
        deviations_source=DEVIATIONS_SOURCE,
        maps={name: maps_path(Path(name)).name for name in files},
    )


def _stated_errors(errors: Sequence[StatedError]) -> str:
    """Describe the errors estimated without truth."""
    stated = [
        f"{e.part} {e.stated:.1f} mm ({e.stated / e.factor:.1f} to {e.stated * e.factor:.1f})"
        for e in errors
        if not e.silent
    ]
    silent = [f"no estimate for the {e.part}: {e.silent}" for e in errors if e.silent]
    words = [f"mean {', '.join(stated)}"] if stated else []
    return "; ".join([*words, *silent])
