"""`intercap report`: write the site from the existing results, without Snakemake."""

from __future__ import annotations

import logging
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.pipeline.step import run_dataset, run_step
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

log = logging.getLogger(__name__)


def write_site(project: Project) -> Path:
    """Write missing and stale summaries and pages and the site's first page; returns its path.

    Sequences that cannot be reported are left out with a warning. Raises UserError if none is left.
    """
    for name in project.sequences:
        for stage in ("summary", "page"):
            if not all(project.artefact(name, read).is_file() for read in STAGES[stage].reads):
                continue
            try:
                run_step(stage, project, name, keep=True)
            except UserError as error:
                log.warning("sequence %s has no %s: %s", name, stage, error)
    return run_dataset(project)
