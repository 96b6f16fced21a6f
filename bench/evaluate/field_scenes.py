"""Part ``field_scenes`` of `intercap dev evaluate`: scene artefacts under field conditions.

Cameras that start at different times or have different rates, rooms whose measured surface is
mostly floor, a person on a balance beam.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bench.evaluate import field_errors
from bench.evaluate.faulty_rigs import name_faults
from bench.evaluate.field_errors import FieldScene
from bench.evaluate.part import (
    EvaluationPart,
    Figures,
    Measured,
    config_files,
    keyed,
    truth_of,
)
from bench.evaluate.start_windows import Recording, measure_windows, window_figures
from intercap_core.project import Project

FieldScenes = Measured[FieldScene]
# Prefixes of the datasets of each condition
STARTS, RATES, FLOOR, BEAM = "field_starts", "field_rates", "field_floor", "field_beam"


def measure(project: Project, sequence: str) -> FieldScene:
    """Errors of one recording after ``scene``; of ``floor`` also faulty variants, of ``beam`` and
    ``starts`` also starts in windows."""
    paths, truth = project.paths(sequence), truth_of(project, sequence)
    scene = field_errors.measure(paths.frames, paths.scene, truth)
    dataset = str(project.config.dataset)
    if dataset.startswith(FLOOR):
        faults = name_faults(paths.frames, paths.detections, paths.scene)
        return replace(scene, faults=tuple(faults))
    if dataset.startswith((BEAM, STARTS)):
        recording = Recording.read(paths.frames, paths.detections, truth)
        return replace(scene, windows=measure_windows(recording))
    return scene


def flat(evaluations: Sequence[FieldScenes]) -> Figures:
    """Keys ``field.<measure>``; ``rates_`` for different rates; starts also by dataset."""
    found = keyed("field.", field_errors.floor_figures(_select(evaluations, FLOOR)))
    found |= keyed("field.", field_errors.start_figures(_select(evaluations, STARTS)))
    found |= keyed("field.rates_", field_errors.start_figures(_select(evaluations, RATES)))
    found |= keyed("field.", field_errors.beam_figures(_select(evaluations, BEAM)))
    windows = [e.windows for measured in evaluations for e in measured.errors if e.windows]
    found |= keyed("field.", window_figures(windows))
    found |= keyed("field.", field_errors.fault_figures(_select(evaluations, FLOOR)))
    for measured in evaluations:
        if measured.dataset.startswith(STARTS):
            rate = measured.dataset.removeprefix(STARTS)
            figures = field_errors.start_figures(measured.errors)
            found |= {f"field.{key}{rate}": value for key, value in figures.items()}
    return found


def _select(evaluations: Sequence[FieldScenes], prefix: str) -> list[FieldScene]:
    """Recordings of the datasets whose names start with ``prefix``."""
    return [e for found in evaluations if found.dataset.startswith(prefix) for e in found.errors]


PART = EvaluationPart(
    name="field_scenes",
    stage="scene",
    settings=config_files("field", "starts_30", "rates", "floor", "beam"),
    budget_minutes=6.6,
    measure=measure,
    flat=flat,
    columns=(
        "offset_error_worst_ms", "offset_wrong", "extrinsics_floor_heavy_mm",
        "extrinsics_floor_heavy_worst_mm", "extrinsics_worse_cameras", "floor_missing",
        "floor_mm", "tilt_deg", "moved_camera_named_share", "moved_camera_false_alarms",
    ),
    areas=("field",),
)  # fmt: skip
