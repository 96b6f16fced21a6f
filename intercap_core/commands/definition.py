"""`intercap keypoint-definition`: a detector's joints, learnt from the project's bodies."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core.body_fit.definition import average_offsets
from intercap_core.project import load_project


def learn_definition(settings: Path, output: Path) -> str:
    """Write the table from all sequences whose bodies are fitted, and say in a sentence what it
    holds. Raises UserError where too few people were recorded with depth."""
    project = load_project(settings)
    fits = [project.artefact(name, "body_fit") for name in project.sequences]
    found, people = average_offsets([path for path in fits if path.is_file()])
    found.write(output, f"{project.config.dataset}, {len(people)} people: {', '.join(people)}")
    offset = 1e3 * np.linalg.norm(found.offsets, axis=1)
    return (
        f"{output}: from {len(people)} people, points {offset.mean():.0f} mm from the body model's "
        f"in the mean, {offset.max():.0f} at most, known to {1e3 * found.sigma.mean():.0f} mm; "
        "name it in body_fit.keypoint_definition"
    )
