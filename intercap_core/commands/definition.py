"""`intercap keypoint-definition`: learn where a detector places its keypoints on the body."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core.body_fit.definition import average_offsets
from intercap_core.project import load_project


def learn_definition(settings: Path, output: Path) -> str:
    """Average the detector's keypoint offsets over all fitted bodies and write them as a table.

    Returns a summary in one sentence. Raises UserError if too few people were recorded with depth.
    """
    project = load_project(settings)
    fits = [project.artefact(name, "body_fit") for name in project.sequences]
    definition, people = average_offsets([path for path in fits if path.is_file()])
    names = ", ".join(people)
    definition.write(output, f"{project.config.dataset}, {len(people)} people: {names}")
    offset = 1e3 * np.linalg.norm(definition.offsets, axis=1)
    return (
        f"{output}: learned from {len(people)} people; the keypoints are {offset.mean():.0f} mm "
        f"from the body model's on average, at most {offset.max():.0f} mm, with a standard "
        f"deviation of {1e3 * definition.sigma.mean():.0f} mm; set "
        "body_fit.keypoint_definition to this file"
    )
