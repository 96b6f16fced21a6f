"""Errors of 2D keypoints against the truth of virtual recordings: a real or a simulated detector.

    python -m bench.detector_errors SETTINGS [--sequences NAME ...] [--studio SETTINGS]

``--studio`` names the settings whose studio made the recordings, if these are other ones.

The true keypoints are projected at the true time of each image. Errors are converted to
millimetres at the point's depth. Each group of points has one row:

- ``seen``, ``hidden``: median error of visible points and of occluded ones.
- ``constant``: median size of each point's mean error in a view over the recording.
- ``1 frame``, ``0.5 s``: correlation of the remaining error over this time.
- ``3D``: median error of the points triangulated with the true cameras.
- ``stated``: median standard error of one coordinate, from the views' disagreement.
- ``ratio``: root mean square of 3D error over ``stated``; sqrt(3) = 1.7 if views err independently.
- ``found``: share of the points that the detector reports, of those inside the image.
- ``rank``: rank correlation of confidence and size of the error, -1 for an ideal confidence.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from bench.command import exit_on_user_error
from bench.evaluate.part import number
from intercap_core.commands.console import ListTable, standard_console
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.triangulation import reproject, spread, triangulate
from intercap_core.project import Project, load_project
from intercap_core.studio.measured_detector import groups
from intercap_core.studio.recording import Kinect
from intercap_core.studio.stage import StudioStage

COLUMNS = ("seen", "hidden", "constant", "1 frame", "0.5 s", "3D", "stated", "ratio", "found",
           "rank")  # fmt: skip
DIGITS = (1, 1, 1, 2, 2, 1, 1, 1, 2, 2)


@dataclass(frozen=True)
class DetectorErrors:
    """Errors of one recording: T sets, C cameras, 135 keypoints."""

    error_mm: np.ndarray
    """(T, C, 135, 2) detected minus true place at the point's depth; NaN = not detected."""
    confidence: np.ndarray
    """(T, C, 135) confidence of the detector, from 0 to 1."""
    hidden: np.ndarray
    """(T, C, 135) bool."""
    inside: np.ndarray
    """(T, C, 135) bool: an image exists and contains the true point."""
    triangulated_mm: np.ndarray
    """(T, 135) error of the triangulated point; NaN = none."""
    stated_mm: np.ndarray
    """(T, 135) standard error of one coordinate by the views' disagreement."""
    fps: float
    """Frame sets per second."""


def measure(project: Project, sequence: str, made_by: Project) -> DetectorErrors:
    """Compare the detections artefact of a virtual recording with its true keypoints.

    The studio of ``made_by`` made the recording. Raises UserError if it did not, or if there are no
    detections yet.
    """
    studio = made_by.config.studio
    if studio is None or sequence not in studio.captures:
        raise UserError(f"{made_by.path}: sequence {sequence!r} is not made by the studio")
    path = project.artefact(sequence, "detections")
    if not path.is_file():
        raise UserError(f"{path}: is missing; run the project to stage 'detections' first")
    stage = StudioStage(studio.captures[sequence], studio, project.object_of(sequence))
    rig, found = stage.rig.true, Detections.load(path)
    shape = (stage.frames, len(rig), 135)
    error, place = np.full((2, *shape, 2), np.nan)
    confidence, hidden, inside = np.zeros(shape), np.zeros(shape, bool), np.zeros(shape, bool)
    at_sets = stage.to_master(stage.keypoints(stage.at(stage.set_times)))
    for c, camera in enumerate(rig):
        kinect = Kinect(stage, c, studio.colour_mode)
        moment = stage.at(kinect.exposures)
        points = stage.keypoints(moment)
        covered = kinect.occluded_keypoints(moment)
        local = stage.to_master(points) @ camera.colour_from_master[:3, :3].T
        local += camera.colour_from_master[:3, 3]
        true = camera.colour.project(local)
        size = 1e3 * local[..., 2:] / camera.colour.fx  # millimetres of a pixel
        within = (true > 0).all(-1) & (true < (camera.colour.width, camera.colour.height)).all(-1)
        expected = reproject(at_sets.reshape(-1, 3), Rig((camera,))).reshape(*at_sets.shape[:2], 2)
        for t in kinect.sets:
            inside[t, c], hidden[t, c] = within[t], covered[t]
            people = found.people(t, c)
            if not len(people):
                continue
            away = np.linalg.norm(people[:, :25, :2] - true[t, :25], axis=-1)
            away[people[:, :25, 2] <= 0] = np.nan
            if not np.isfinite(away).any():
                continue
            person = people[np.nanargmin(np.nanmedian(away, 1))]
            known = person[:, 2] > 0
            confidence[t, c] = person[:, 2]
            pixels = person[known, :2] - true[t, known]
            error[t, c, known] = pixels * size[t, known]
            place[t, c, known] = expected[t, known] + pixels
    weights = np.where(np.isfinite(place[..., 0]), confidence, 0.0)
    flat = np.moveaxis(np.nan_to_num(place), 1, 2).reshape(-1, len(rig), 2)
    solved = triangulate(
        flat,
        np.moveaxis(weights, 1, 2).reshape(-1, len(rig)),
        rig,
        max_error_px=project.config.person.max_reprojection_px,
    )
    space = np.linalg.norm(solved.points - at_sets.reshape(-1, 3), axis=1).reshape(shape[0], 135)
    stated = spread(solved, rig).reshape(shape[0], 135)
    return DetectorErrors(
        error, confidence, hidden, inside, 1e3 * space, 1e3 * stated, float(stage.fps)
    )


def figures(recordings: list[DetectorErrors], points: np.ndarray) -> tuple[float, ...]:
    """Figures of a group of ``points``, in the order of :data:`COLUMNS`."""
    samples = [_samples(recording, points) for recording in recordings]
    pooled = {key: np.concatenate([sample[key] for sample in samples]) for key in samples[0]}
    ratio = np.clip(pooled["triangulated"] / pooled["stated"], 0, 10)  # a larger ratio counts as 10
    return (
        *(_median_length(pooled[key]) for key in ("seen", "hidden", "constant")),
        _correlation(pooled["one frame"]),
        _correlation(pooled["half a second"]),
        float(np.median(pooled["triangulated"])),
        float(np.median(pooled["stated"])),
        float(np.sqrt(np.mean(ratio**2))),
        float(pooled["found"].mean()),
        float(spearmanr(pooled["confidence"], pooled["length"]).statistic),
    )


def _samples(recording: DetectorErrors, points: np.ndarray) -> dict[str, np.ndarray]:
    """Samples of one recording from which the figures are computed, millimetres.

    ``seen``, ``hidden``, ``constant`` (N, 2) are errors; ``one frame``, ``half a second`` (N, 2)
    pairs of the same coordinate at two times; the others (N,).
    """
    error = recording.error_mm[:, :, points]
    found, hidden = np.isfinite(error[..., 0]), recording.hidden[:, :, points]
    # limited to 100 mm, so that single gross errors do not determine means and correlations
    visible = np.where((found & ~hidden)[..., None], np.clip(error, -100, 100), np.nan)
    often = np.isfinite(visible[..., 0]).sum(0) >= 0.5 * len(visible)
    total = np.nansum(visible, axis=0)
    mean = total / np.maximum(np.isfinite(visible).sum(0), 1)
    rest = np.where(often[..., None], visible - mean, np.nan)
    solved = recording.stated_mm[:, points] > 0
    return {
        "seen": error[found & ~hidden],
        "hidden": error[found & hidden],
        "constant": mean[often],
        "one frame": _pairs(rest, 1),
        "half a second": _pairs(rest, max(1, round(0.5 * recording.fps))),
        "triangulated": recording.triangulated_mm[:, points][solved],
        "stated": recording.stated_mm[:, points][solved],
        "found": found[recording.inside[:, :, points]],
        "confidence": recording.confidence[:, :, points][found],
        "length": np.linalg.norm(error[found], axis=-1),
    }


def _pairs(values: np.ndarray, lag: int) -> np.ndarray:
    """Pairs (N, 2) of known values (T, ...) that are ``lag`` frames apart."""
    pairs = np.stack([values[:-lag], values[lag:]], axis=-1).reshape(-1, 2)
    return pairs[np.isfinite(pairs).all(1)]


def _correlation(pairs: np.ndarray) -> float:
    return float(np.corrcoef(pairs.T)[0, 1]) if len(pairs) > 2 else float("nan")


def _median_length(errors: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(errors, axis=1))) if len(errors) else float("nan")


def main() -> None:
    """Read the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("settings", type=Path)
    parser.add_argument("--sequences", nargs="+", default=())
    parser.add_argument("--studio", type=Path)
    options = parser.parse_args()
    with exit_on_user_error():
        project = load_project(options.settings)
        names = list(options.sequences) or list(project.sequences)
        made_by = load_project(options.studio or options.settings)
        recordings = [measure(project, name, made_by) for name in names]
    table = ListTable("points", *COLUMNS, title=f"{options.settings}, mm")
    for name, points in groups().items():
        row = figures(recordings, points)
        table.add_row(name, *(number(v, d) for v, d in zip(row, DIGITS, strict=True)))
    standard_console().print(table)


if __name__ == "__main__":
    main()
