"""Stage ``scene``: refined camera poses, the static background and the floor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.camera.rig import Rig
from intercap_core.camera.transforms import apply
from intercap_core.capture.frames import Frames
from intercap_core.capture.synchronise import images_of_moments
from intercap_core.config import SceneSettings
from intercap_core.detection.read import Detections
from intercap_core.errors import UserError
from intercap_core.project import digest
from intercap_core.scene.background import Background, background_of
from intercap_core.scene.extrinsics import (
    BACKGROUND_CELL_M,
    Refinement,
    background_surfaces,
    refine,
)
from intercap_core.scene.ground import Ground, annotated_ground, fit_ground, zup_from_master
from intercap_core.scene.registration import PairResiduals
from intercap_core.scene.surface import Surface
from intercap_core.schemas import SCENE

Floor = Sequence[tuple[float, float, float]]


def run(
    *, frames: Path, detections: Path, output: Path, settings: SceneSettings, floor: Floor | None
) -> None:
    """Write the scene artefact of one sequence.

    ``floor`` are annotated floor points, master frame, metres, which override the fit. Slips and
    time offsets are written as zeros: nothing here estimates them. Raises UserError where the
    recording has no image at all, or the annotated points give no plane.
    """
    with Frames.open(frames) as source:
        if not source.available.any():
            raise UserError(
                f"{frames}: sequence {source.sequence} has no image of any camera; check its "
                "recordings and the dropped frames of its annotation, then re-run stage 'frames'"
            )
        backgrounds = [background_of(source, c) for c in range(len(source.rig))]
        surfaces = background_surfaces(source.rig, backgrounds)
        found = _refined(source, detections, surfaces, settings)
        rig = source.rig.moved(found.poses)
        ground = _ground(source, rig, surfaces, found.bias, settings, floor)
        _write(output, source, rig, backgrounds, found, ground, settings)


def _refined(
    source: Frames,
    detections: Path,
    surfaces: dict[int, Surface],
    settings: SceneSettings,
) -> Refinement:
    rig = source.rig
    if settings.refine_extrinsics and len(rig) > 1:
        found = Detections.load(detections)
        return refine(source, found, surfaces, rig.names.index(source.master))
    none = PairResiduals(np.zeros((0, 2), np.int32), np.zeros(0, np.int64), np.zeros(0))
    return Refinement(rig.master_from_colour, np.zeros(len(rig)), False, none, none)


def _ground(
    source: Frames,
    rig: Rig,
    surfaces: dict[int, Surface],
    bias: np.ndarray,
    settings: SceneSettings,
    floor: Floor | None,
) -> Ground:
    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for c, surface in surfaces.items():
        pose = rig[c].master_from_depth
        points.append(apply(pose, surface.points - bias[c] * surface.rays))
        normals.append(surface.normals @ pose[:3, :3].T)
    tolerance = settings.floor_tolerance_mm / 1000
    everything = np.concatenate(points)
    if floor is not None:
        try:
            return annotated_ground(
                np.array(floor, np.float64), everything, rig, source.gravity, tolerance_m=tolerance
            )
        except UserError as error:
            raise UserError(f"sequence {source.sequence}: {error}") from None
    return fit_ground(
        everything,
        np.concatenate(normals),
        rig,
        source.gravity,
        tolerance_m=tolerance,
        # Every camera may see the same floor: count the area as if all of them did.
        cell_m=BACKGROUND_CELL_M / np.sqrt(max(1, len(surfaces))),
    )


def _write(
    output: Path,
    source: Frames,
    rig: Rig,
    backgrounds: list[Background | None],
    found: Refinement,
    ground: Ground,
    settings: SceneSettings,
) -> None:
    pairs, before, after = _common_pairs(found.before, found.after)
    with artefacts.write(
        output,
        SCENE,
        settings_digest=digest(settings),
        sequence=source.sequence,
        master=source.master,
        fps=source.fps,
        extrinsics_refined=found.improved,
        ground_found=ground.found,
        ground_source=ground.source,
        ground_rms=ground.rms,
        ground_inliers=ground.inliers,
    ) as writer:
        for key, values in rig.datasets().items():
            writer.put(key, values)
        writer.put("present", source.present)
        writer.put("times", source.time_s)
        writer.put("master_from_colour", rig.master_from_colour)
        writer.put("master_from_colour_start", source.rig.master_from_colour)
        writer.put("depth_bias", found.bias)
        writer.put("pairs", pairs)
        writer.put("pair_points", before.count)
        writer.put("pair_residual_before", before.median)
        writer.put("pair_residual_after", after.median)
        writer.put("time_offset", np.zeros(len(rig)))
        writer.put("time_offset_sigma", np.full(len(rig), np.nan))
        slip = np.zeros((source.num_sets, len(rig)), np.int32)
        writer.put("slip", slip)
        writer.put("image_of", images_of_moments(slip, source.available))
        writer.put("ground_point", ground.point)
        writer.put("ground_normal", ground.normal)
        writer.put("zup_from_master", zup_from_master(ground, rig, source.gravity))
        for camera, background in zip(rig, backgrounds, strict=True):
            if background is not None:
                writer.put(f"cameras/{camera.name}/background", background.depth)


def _common_pairs(
    before: PairResiduals, after: PairResiduals
) -> tuple[np.ndarray, PairResiduals, PairResiduals]:
    """Keep the pairs that overlap both before and after."""
    kept = sorted({tuple(p) for p in before.pairs} & {tuple(p) for p in after.pairs})
    chosen = []
    for residuals in (before, after):
        place = {tuple(p): i for i, p in enumerate(residuals.pairs)}
        rows = np.array([place[p] for p in kept], int)
        chosen.append(
            PairResiduals(residuals.pairs[rows], residuals.count[rows], residuals.median[rows])
        )
    return chosen[0].pairs, chosen[0], chosen[1]
