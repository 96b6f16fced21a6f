"""The command `intercap dev evaluate`: compare virtual recordings with truth."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.evaluate import (
    bodies,
    captures,
    detector,
    field,
    field_scenes,
    objects,
    rig,
    scan,
    sequences,
)
from bench.evaluate.constants import total_constants
from bench.evaluate.part import EvaluationPart, Figures, keyed, require_truth
from bench.evaluate.reference import (
    REFERENCE,
    passes_gate,
    read_reference,
    update_reference,
)
from bench.evaluate.seeds import redraw_settings
from bench.evaluate.tables import print_figures, print_part
from bench.evaluate.workflows import (
    bring_up_to_date,
    minutes_of_parts,
)
from intercap_core.errors import UserError
from intercap_core.formats.calibration.files import calibration_readers
from intercap_core.formats.detections.keypoints import readers as keypoint_readers
from intercap_core.formats.recordings.layouts import INPUTS
from intercap_core.formats.recordings.ros.layout import SCHEMES
from intercap_core.output.export.registry import formats as export_formats
from intercap_core.project import load_project
from intercap_core.studio.mediapipe import mediapipe_python

PARTS: dict[str, EvaluationPart[Any]] = {
    part.name: part
    for part in (
        sequences.PART,
        captures.PART,
        objects.PART,
        bodies.PART,
        field_scenes.PART,
        field.PART,
        detector.PART,
        rig.PART,
        scan.PART,
    )
}
QUICK_SETTINGS = Path("config/evaluation/quick.yaml")
QUICK_PARTS = ("sequences", "objects")


def evaluate(
    chosen: Mapping[str, Sequence[Path]],
    output: Path,
    *,
    cores: int = 0,
    seed: int | None = None,
) -> int:
    """Bring the evaluation's recordings up to date, write the figures and print them as tables.

    Returns 1 if a stage failed; recordings that failed are excluded from the figures and named.
    Raises UserError if a project's settings are wrong or none of its sequences has a result.

    Args:
        chosen: settings files of the recordings of each part in ``PARTS``; none = its default.
        output: flat JSON with keys ``area.measure``, and ``area.measure_spread`` for the standard
            error of a figure. docs/evaluation.md describes the areas; ``time`` holds minutes.
        cores: number of cores, 0 = all.
        seed: draw everything random in the recordings from new seeds (:mod:`.seeds`).
    """
    begin = time.monotonic()
    if mediapipe_python() is None and not chosen.get(detector.PART.name, True):
        print("part detector is left out: MediaPipe is not installed (make mediapipe)")
        chosen = {name: paths for name, paths in chosen.items() if name != detector.PART.name}
        if not chosen:
            raise UserError("part detector needs MediaPipe: run 'make mediapipe'")
    settings = {name: list(paths or PARTS[name].settings) for name, paths in chosen.items()}
    if seed is not None:
        settings = redraw_settings(settings, seed)
    projects = {
        name: [load_project(path) for path in paths] for name, paths in settings.items()
    }  # errors in settings are reported before any work
    wanted = {name: PARTS[name].targets(some) for name, some in projects.items()}
    for some in projects.values():
        for project in some:
            require_truth(project)
    status = bring_up_to_date(wanted, cores=cores)
    workers = cores or len(os.sched_getaffinity(0))
    figures: Figures = {}
    for name, some in projects.items():
        part = PARTS[name]
        measured = part.measure_all(some, workers=workers)
        own = part.flat(measured) | part.time_one(some)
        figures |= own
        _write(figures, output)  # before the next part, which may fail
        print_part(part, measured, own)
    minutes = minutes_of_parts(wanted)
    minutes |= {f"{name}_minutes_budget": PARTS[name].budget_minutes for name in wanted}
    minutes["minutes"] = (time.monotonic() - begin) / 60
    of_run = keyed("time.", minutes) | {"constants.total": total_constants()} | format_counts()
    _write(figures | of_run, output)
    print_figures(dict(sorted(of_run.items())))
    print(output)
    return status


def _write(figures: Figures, output: Path) -> None:
    """Write the finite figures with six significant digits."""
    flat = {key: float(f"{value:.6g}") for key, value in figures.items() if math.isfinite(value)}
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(flat, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def format_counts() -> Figures:
    """Numbers of formats that are read and written, ``formats.read`` and ``formats.written``.

    Read are layouts of recordings (of bags one for each recorder), calibrations of other tools and
    files of keypoints. Written are the formats of the export.
    """
    recordings = len(set(INPUTS) - {"ros"}) + len(SCHEMES)
    return {
        "formats.read": recordings + len(calibration_readers()) + len(keypoint_readers()),
        "formats.written": len(export_formats()),
    }


def evaluate_quick(output: Path, *, cores: int = 0, renew_reference: bool = False) -> int:
    """Evaluate the quick set and apply the regression gate; see :func:`evaluate`.

    ``renew_reference``: record the figures as the new reference instead of comparing them.
    Returns 1 if a stage failed or a gated figure is worse than its reference by more than its
    spread. Raises UserError if the reference file cannot be used.
    """
    reference = read_reference(REFERENCE)  # before the run: a malformed file costs no time
    settings = {part: [QUICK_SETTINGS] for part in QUICK_PARTS}
    status = evaluate(settings, output, cores=cores)
    figures = json.loads(output.read_text(encoding="utf-8"))
    if renew_reference:
        if status:
            raise UserError(f"{REFERENCE}: not updated, as a stage failed")
        update_reference(figures, REFERENCE)
        print(f"{REFERENCE}: recorded")
        return 0
    return status if passes_gate(figures, reference) else 1
