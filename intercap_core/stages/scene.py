"""Stage ``scene``: refined camera poses and times, the static background and the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.config import SceneSettings, digest
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.scene.background import Background, camera_background
from intercap_core.scene.camera_agreement import find_disagreements, widened
from intercap_core.scene.camera_verdicts import describe_direction, weakest_motion
from intercap_core.scene.constraints import FloorConstraint
from intercap_core.scene.depth_scale import describe_depth_scale
from intercap_core.scene.extrinsics import Refinement, refine
from intercap_core.scene.floor import AnnotatedFloor, floor_and_up, measured_floor
from intercap_core.scene.ground import GroundPlane, zup_from_master
from intercap_core.scene.lens_exchange import LensExchange, exchange_lenses
from intercap_core.scene.moments import Moments, describe_stated_start, find_moments
from intercap_core.scene.rig_prior import RigPrior
from intercap_core.scene.starts import NOT_DETERMINED, StatedStarts, describe_start
from intercap_core.scene.subject_views import SubjectViews
from intercap_core.scene.surfaces import background_surfaces, moving_surfaces
from intercap_core.scene.up import UpDirection, check_stated_up, trunk_direction
from intercap_core.schemas import SCENE

# A camera is reported if it sees the rig's centre less accurately than this, because its pose is
# uncertain (standard deviation).
WEAK_CAMERA_M = 0.010


@dataclass(frozen=True, eq=False)
class _Scene:
    """Contents of the scene artefact."""

    rig: Rig
    """Refined cameras."""
    backgrounds: list[Background | None]
    """Static depth by camera."""
    moments: Moments
    """Images by moment."""
    refined: Refinement
    """Poses, biases and offsets."""
    ground: GroundPlane
    """The floor."""
    up: UpDirection
    """The up direction: the floor's normal, or without a floor an estimate."""
    ground_notes: list[str]
    """Notes on the floor and the stated up direction."""
    notes: list[list[str]]
    """Notes on each camera."""
    slides: np.ndarray
    """(C, 3) least determined displacement of each camera, see :func:`_slides`."""
    known_to: list[str]
    """(C,) ``slides`` in words; "" = the camera is fixed."""


def run(
    *,
    frames: Path,
    detections: Path,
    output: Path,
    settings: SceneSettings,
    floor: AnnotatedFloor | None,
    starts: Mapping[str, tuple[float, float]] | None = None,
    rig_from: Path | None = None,
) -> None:
    """Write the scene artefact of one sequence.

    Args:
        floor: annotated floor points, master frame, metres; they replace the fit.
        starts: annotated time of the first image and its standard deviation, seconds, by camera.
        rig_from: scene artefact of another sequence, whose poses are start and prior of this one's.

    Raises:
        UserError: the recording has no image; the two artefacts are of different recordings;
            ``rig_from`` has other cameras, or cameras at other places; the annotated floor points
            span no plane; the annotated starts leave no common time; cameras and person contradict
            the stated up direction.
    """
    with Frames.open(frames) as source:
        if not source.available.any():
            raise UserError(
                f"{frames}: sequence {source.sequence} has no image of any camera; check its "
                "recordings and the dropped frames of its annotation, then re-run stage 'frames'"
            )
        people = Detections.load(detections)
        if people.camera_names != source.rig.names or people.num_sets != source.num_sets:
            raise UserError(
                f"{detections}: has {people.num_sets} frame sets of cameras "
                f"{', '.join(people.camera_names)}, expected {source.num_sets} of "
                f"{', '.join(source.rig.names)} as in {frames}; re-run stage 'detections'"
            )
        rig, master = source.rig, source.rig.names.index(source.master)
        prior = None
        if rig_from is not None:
            prior = RigPrior.read(rig_from, source.sequence, rig, source.master)
            rig = rig.moved(prior.poses)
        stated, disagree = _stated_starts(source, starts or {}, master)
        moments = find_moments(
            people, rig, source.time_s, source.fps, source.available, master=master, stated=stated,
            search=settings.find_starts,
        )  # fmt: skip
        subject, image_of = moments.subject, moments.image_of
        scales = describe_depth_scale(source, rig, subject.joints, image_of)
        ground_notes = _check_stated_up(source, subject)
        backgrounds = _backgrounds(source, subject, moments.slip)
        rig, exchanges = exchange_lenses(rig, backgrounds, subject, source.time_s, master)
        surfaces = background_surfaces(rig, backgrounds)
        tolerance = settings.floor_tolerance_mm / 1000
        given_ground = measured_floor(source, rig, surfaces, np.zeros(len(rig)), tolerance, floor)
        refined = refine(
            rig,
            master,
            surfaces,
            moving_surfaces(source, rig, image_of, backgrounds),
            moments,
            source.time_s,
            floor=FloorConstraint.of(rig, surfaces, given_ground),
            free_poses=settings.refine_extrinsics,
            prior=prior,
        )
        disagreements = find_disagreements(people, subject, image_of, rig)
        rig = rig.moved(refined.poses)
        if disagreements:
            left = find_disagreements(people, subject, image_of, rig)
            refined = replace(refined, covariance=widened(refined.covariance, rig, left))
        ground = measured_floor(source, rig, surfaces, refined.bias, tolerance, floor)
        ground, up, more_notes = floor_and_up(source, rig, ground, subject, floor)
        slides, known_to = _slides(rig, refined, up.direction)
        notes = _notes(source, refined, moments, stated, exchanges)
        for one in disagreements:
            notes[one.camera].append(str(one))
        weak = np.linalg.norm(slides, axis=1) > WEAK_CAMERA_M
        of_pose = [words if bad else "" for words, bad in zip(known_to, weak, strict=True)]
        for note, *others in zip(notes, disagree, of_pose, scales, strict=True):
            note += filter(None, others)
        ground_notes += more_notes
        scene = _Scene(
            rig, backgrounds, moments, refined, ground, up, ground_notes, notes, slides, known_to
        )
        _write(output, source, scene, settings)


def _stated_starts(
    source: Frames, starts: Mapping[str, tuple[float, float]], master: int
) -> tuple[StatedStarts, list[str]]:
    """Starts by annotation and sound combined, and messages (C,) on disagreements; "" = none."""
    names, heard = source.rig.names, source.sound_starts
    if not starts and not heard:
        return StatedStarts.nothing(len(names)), [""] * len(names)
    first = source.first_image_s
    annotated = StatedStarts.of(starts, names, master, first, "the annotation")
    try:
        annotated.check_common(source.time_s, names)
    except UserError as error:
        raise UserError(f"sequence {source.sequence}: {error}") from None
    by_sound = StatedStarts.of(heard, names, master, first, "the sound").unless_in_step()
    return annotated.combine(by_sound)


def _backgrounds(
    source: Frames, subject: SubjectViews, slip: np.ndarray
) -> list[Background | None]:
    """Background of each camera.

    The person is masked at the moment that each image shows. ``slip``: (T, C) delays in sets.
    """
    last = source.num_sets - 1
    moment = np.clip(np.arange(source.num_sets)[:, None] - slip, 0, last)
    return [
        camera_background(source, c, subject.joints[moment[:, c]]) for c in range(len(source.rig))
    ]


def _check_stated_up(source: Frames, subject: SubjectViews) -> list[str]:
    """Notes on contradictions to the stated up direction; adds the sequence to errors."""
    try:
        return check_stated_up(
            source.stated_up, source.rig, source.gravity, trunk_direction(subject.joints)
        )
    except UserError as error:
        raise UserError(f"sequence {source.sequence}: {error}") from None


def _write(output: Path, source: Frames, scene: _Scene, settings: SceneSettings) -> None:
    """Write the scene artefact; column 0 of ``pairs`` is background, column 1 moving surfaces."""
    rig, refined, ground = scene.rig, scene.refined, scene.ground
    pairs = refined.pairs
    verdicts = [
        "; ".join(filter(None, both)) for both in zip(refined.verdicts, scene.known_to, strict=True)
    ]
    with artefacts.write(
        output,
        SCENE,
        settings_digest=digest(settings),
        sequence=source.sequence,
        master=source.master,
        fps=source.fps,
        extrinsics_refined=bool(refined.refined.any()),
        extrinsics_converged=refined.converged,
        verdict=refined.verdict,
        ground_found=ground.found,
        ground_source=ground.source,
        ground_rms=ground.rms,
        ground_inliers=ground.inliers,
        up_source=scene.up.source,
        up_deviation_deg=scene.up.deviation_deg,
    ) as writer:
        if scene.ground_notes:
            writer.attributes["ground_note"] = "; ".join(scene.ground_notes)
        for key, values in rig.datasets().items():
            writer.put(key, values)
        writer.put("present", source.present)
        writer.put("times", source.time_s)
        writer.put("master_from_colour", rig.master_from_colour)
        writer.put("master_from_colour_start", source.rig.master_from_colour)
        writer.put("depth_bias", refined.bias)
        writer.put("camera_covariance", refined.covariance)
        writer.put("camera_refined", refined.refined)
        writer.put("camera_verdict", verdicts)
        writer.put("camera_slide", scene.slides)
        writer.put("note", ["; ".join(lines) for lines in scene.notes])
        writer.put("pairs", pairs.pairs)
        for k, kind in enumerate(("pair", "pair_moving")):
            residual = "pair_residual" if k == 0 else kind
            writer.put(f"{kind}_points", pairs.points[:, k])
            writer.put(f"{residual}_before", pairs.before[:, k])
            writer.put(f"{residual}_after", pairs.after[:, k])
        writer.put("pair_weak", pairs.weak)
        writer.put("time_offset", refined.offset)
        writer.put("time_offset_sigma", refined.offset_sigma)
        writer.put("slip", scene.moments.slip)
        writer.put("image_of", scene.moments.image_of)
        writer.put("ground_point", ground.point)
        writer.put("ground_normal", ground.normal)
        writer.put("zup_from_master", zup_from_master(ground, rig, scene.up))
        for camera, background in zip(rig, scene.backgrounds, strict=True):
            if background is not None:
                writer.put(f"cameras/{camera.name}/background", background.depth)


def _notes(
    source: Frames,
    refined: Refinement,
    moments: Moments,
    stated: StatedStarts,
    exchanges: Sequence[LensExchange],
) -> list[list[str]]:
    """Notes (C,) on the lens, pose, time and slips of each camera."""
    notes = [[note] if note else [] for note in refined.notes]
    for swap in exchanges:
        evidence = f"background {1e3 * swap.before:.1f} to {1e3 * swap.after:.1f} mm"
        for own, other in (swap.cameras, swap.cameras[::-1]):
            notes[own].append(
                f"its focal length and principal point and those of {source.rig.names[other]} are "
                f"exchanged in the calibration and were corrected ({evidence})"
            )
    starts = moments.starts
    for c in np.flatnonzero(source.present & ~stated.known & (starts.sets != 0)).tolist():
        notes[c].append(f"it started {describe_start(starts.late[c])}; its images were moved")
    for c in np.flatnonzero(source.present).tolist():
        left, sigma = float(refined.offset[c]), float(refined.offset_sigma[c])
        note = describe_stated_start(stated, starts, moments.slips, c, left, sigma)
        notes[c] += [note] if note else []
    for c, doubt in enumerate(starts.undetermined):
        if doubt and source.present[c] and not stated.known[c]:
            aside = "; set aside, because the cameras were not started together"
            notes[c].append(
                f"{NOT_DETERMINED}: {doubt}{aside if starts.in_doubt[c] else ''}; if it is out of "
                "step, state when it started (starts of the annotation)"
            )
    if starts.too_short:
        notes[source.rig.names.index(source.master)].append(
            "starts of the other cameras were not searched: the recording has too few frame sets"
        )
    for interval in moments.slips.intervals:
        count, way = abs(interval.slip), "late" if interval.slip > 0 else "early"
        frames = "1 frame" if count == 1 else f"{count} frames"
        notes[interval.camera].append(
            f"its images are {frames} {way} in sets {interval.first} to {interval.last}"
        )
    for c, present in enumerate(source.present):
        if present and np.isnan(refined.offset_sigma[c]):
            notes[c].append("its time offset is not determined")
    return notes


def _slides(rig: Rig, refined: Refinement, up: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Least determined displacement of each camera; ``up``: (3,).

    Returns:
        Displacement (C, 3) of the rig's centre as seen by the camera, one standard deviation along
        the least determined direction, metres; 0 = fixed.
        Description of each; "" = fixed.
    """
    slides, words = np.zeros((len(rig), 3)), [""] * len(rig)
    for c, pose in enumerate(rig.master_from_colour):
        sigma, way = weakest_motion(refined.covariance[c, :, c], pose, ring_centre(rig))
        if sigma > 0:
            slides[c] = sigma * way
            least = describe_direction(way, pose, up)
            words[c] = f"its pose is known to {1e3 * sigma:.1f} mm, least {least}"
    return slides, words
