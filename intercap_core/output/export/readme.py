"""README.txt of an export: frame, units and meaning of every number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2

from intercap_core.body.maps import maps_path
from intercap_core.evaluation.verdict.figures import StatedError
from intercap_core.output.export.about import DEVIATIONS_SOURCE
from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.motion import Coordinates
from intercap_core.schemas import CONTACT_M


def readme(
    content: Content, requested: Sequence[ExportFormat], files: Mapping[str, Mapping[str, str]]
) -> str:
    """Compose README.txt.

    Args:
        requested: formats that the settings list; without an object, those that need one are
            stated as omitted.
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
    settings, about = content.settings, content.about
    variables = {
        "motion": content.motion,
        "viewed": content.viewed,
        "mesh": content.mesh,
        "about": about,
        "kind": settings.mesh_format,
        "images": settings.images or settings.undistort,
        "undistorted": settings.undistort,
        "up": Coordinates.of(content.viewed).header_lines()[1],
        "up_of_master": Coordinates.of(content.motion).header_lines()[1],
    }
    sections = [
        f"\n{format_.name} is omitted, although export.formats lists it: there is no object.\n"
        if format_.needs_object and content.mesh is None
        else environment.from_string(format_.readme).render(variables)
        for format_ in requested
    ]
    return environment.get_template("readme.txt.j2").render(
        variables,
        sections="".join(sections),
        files=files,
        body_file=f"{about.body.path.name}, digest {about.body.to_json()['body_file_digest']}",
        stated_errors=_stated_errors(about.verdict.stated),
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
