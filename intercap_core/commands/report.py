"""`intercap report`: the site of what is computed, without the workflow."""

from __future__ import annotations

import logging
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.pipeline.step import run_dataset, run_step
from intercap_core.project import Project
from intercap_core.stage_list import SEQUENCE_STAGES, STAGES

log = logging.getLogger(__name__)

_OF_THE_SITE = ("summary", "page")


def write_site(project: Project) -> Path:
    """Write summaries and pages that are missing or were made of other results than are there, then
    the site's first page, whose path is returned.

    A sequence that cannot be reported is told and left out. Raises UserError where none is left.
    """
    for name in project.sequences:
        inputs = {stage: project.artefact(name, stage) for stage in SEQUENCE_STAGES}
        for stage in _OF_THE_SITE:
            if not all(inputs[source].is_file() for source in STAGES[stage].reads):
                continue
            output = project.artefact(name, stage)
            try:
                run_step(stage, project, name, inputs=inputs, output=output, keep=True)
            except UserError as error:
                log.warning("sequence %s has no %s: %s", name, stage, error)
    return run_dataset(project)
