"""Stage annotation: check one sequence's annotation file before anything depends on it.

The checked copy is what the other stages read. Where the file is broken, this job fails and
nothing that was computed before is touched.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

from intercap_core import artefacts
from intercap_core.config import Annotation
from intercap_core.errors import UserError
from intercap_core.project import read_annotation
from intercap_core.schemas import FRAMES


def run(*, annotation: Path | None, frames: Path, output: Path) -> None:
    """Write the checked annotation as JSON; an empty one where ``annotation`` is None.

    Where ``frames`` can be read already, intervals and frames past the recording's end are found
    here too; else the stages that come after it find them. Raises UserError naming file and field.
    """
    checked = Annotation() if annotation is None else read_annotation(annotation)
    if annotation is not None:
        with contextlib.suppress(artefacts.Unreadable):
            check_length(checked, frames, annotation)
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(checked.model_dump_json(indent=1) + "\n", encoding="utf-8")


def check_length(annotation: Annotation, frames: Path, named: Path) -> None:
    """Raise UserError where an entry lies past the recording's end."""
    with artefacts.read(frames, FRAMES) as source:
        count = len(source["times"])
    problem = annotation.check_frames(count)
    if problem:
        raise UserError(f"{named}: {problem} (numbered from 0); correct the entry")


def read_checked(path: Path) -> Annotation:
    """Read what :func:`run` wrote."""
    return Annotation.model_validate_json(path.read_text(encoding="utf-8"))
