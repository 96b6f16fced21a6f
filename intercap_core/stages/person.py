"""Stage ``person``: the subject in every view, its triangulated keypoints and masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.annotation import ExchangedSides, SubjectPoint
from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.config import PersonSettings, digest
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import (
    FROM_DETECTOR,
    FROM_IMAGES,
    NOT_SEGMENTED,
    Detections,
)
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.triangulation import Triangulation, reproject, spread
from intercap_core.person.groups import NOBODY
from intercap_core.person.lifting import Lifter
from intercap_core.person.masks import choose_mask, merge_other_candidates
from intercap_core.person.segmentation.candidate_masks import ImageCandidate, ViewSegments
from intercap_core.person.sides import (
    BODY_POINTS,
    hold_sides,
    images_with_stated_sides,
    swap_sides,
)
from intercap_core.person.subject import SubjectDetections, find_subject, subject_keypoints
from intercap_core.person.subject_hints import named_people, touch_test
from intercap_core.person.subject_joints import (
    at_set_times,
    fill_middles,
    steady_sides,
    triangulate_people,
)
from intercap_core.schemas import PERSON, SCENE


@dataclass(frozen=True, eq=False)
class _Result:
    """Contents of the person artefact; T frame sets, C cameras.

    Index t counts moments: row t belongs to the images that show the moment of set t, which may
    come from other sets (``image_of`` of the scene artefact).
    """

    subject: SubjectDetections
    """The subject's detections."""
    keypoints: np.ndarray
    """(T, C, 135, 3) x, y, confidence with corrected sides."""
    points: Triangulation
    """T * 135 triangulated points."""
    missing: np.ndarray
    """(T,) bool: neither two views nor depth locate the subject."""
    masks: list[bytes]
    """T * C masks of the subject by the detector, RLE; empty = none."""
    beside: list[bytes]
    """T * C unions of the detector's other candidates, RLE; empty = none."""
    segmented: dict[tuple[int, int], ViewSegments]
    """Segmentation without a detector, by moment and camera."""


def run(
    *,
    frames: Path,
    detections: Path,
    scene: Path,
    output: Path,
    settings: PersonSettings,
    object_: ObjectEntry | None = None,
    subject_points: Sequence[SubjectPoint] = (),
    left_right: Sequence[ExchangedSides] = (),
) -> None:
    """Find the subject by geometry and write the person artefact.

    The subject is the person named by the user. Otherwise it is the person with most support near
    the centre who handles the object, see :mod:`intercap_core.person.subject`. In sets with few
    triangulated points, the depth of a single view supplies the others. Sets in which neither two
    views nor depth locate the subject are flagged ``missing``.

    Args:
        object_: its labels identify candidates of the object; None = a person alone.
        subject_points: annotated points on the subject.
        left_right: annotated images with exchanged sides.

    Raises:
        UserError: all sets are missing, the inputs are of different captures, or a point names
            nobody.
    """
    found = Detections.load(detections)
    with artefacts.read(scene, SCENE) as source, Frames.open(frames) as images:
        rig = Rig.from_artefact(source)
        times, image_of = source["times"], source["image_of"]
        time_offset = source["time_offset"]
        if rig.names != found.camera_names or len(times) != found.num_sets:
            raise UserError(
                f"{detections} and {scene}: cameras or frame sets differ "
                f"({len(found.camera_names)} cameras, {found.num_sets} sets against {len(rig)} and "
                f"{len(times)}); re-run stages 'detections' and 'scene' for this sequence"
            )
        found = found.showing(image_of)
        confident = settings.min_confidence
        lifter = Lifter(images.showing(image_of), source, min_confidence=confident)
        labels = None if object_ is None else object_.labels
        subject = find_subject(
            found,
            rig,
            times,
            min_confidence=confident,
            lift=lifter.people,
            touches=None if labels is None else touch_test(found, labels, min_confidence=confident),
            named=named_people(subject_points, found, image_of, min_confidence=confident),
        )
        person = subject.people
        keypoints = subject_keypoints(found, person)
        stated = images_with_stated_sides(left_right, rig.names, image_of, found.sequence)
        keypoints = given = np.where(stated[..., None, None], swap_sides(keypoints), keypoints)
        keypoints = steady_sides(keypoints, rig, min_confidence=confident)
        # Triangulated are pixels moved to the sets' times (columns 0, 1; confidence in 2). The
        # pixels as detected are carried along as columns 3 and 4, so that their sides are exchanged
        # alike. The columns [3, 4, 2] are then written: x, y as detected, confidence.
        moved = at_set_times(keypoints, times, time_offset, rig, min_confidence=confident)
        moved, points = triangulate_people(
            np.concatenate([moved, keypoints[..., :2]], -1),
            rig,
            times,
            min_confidence=confident,
            max_error_px=settings.max_reprojection_px,
        )
        keypoints, points = hold_sides(moved[..., [3, 4, 2]], points, given, stated)
        del moved, given  # 50 kB a set
        lifted = lifter.fill(person, keypoints, points)
        fill_middles(points.points.reshape(found.num_sets, NUM_KEYPOINTS, 3))
        missing = ((person != NOBODY).sum(1) < 2) & ~lifted
        if missing.all():
            raise UserError(
                f"sequence {found.sequence}: the subject can be placed in no frame set: "
                f"{_why(found)}"
            )
        masks = _masks(found, keypoints, points, rig, settings.min_confidence)
        beside = [
            merge_other_candidates(found.candidates(t, c), masks[t * len(rig) + c])
            for t, c in np.ndindex(found.num_sets, len(rig))
        ]
        segmented = _from_images(images.showing(image_of), source, found, points, rig, settings)
    result = _Result(subject, keypoints, points, missing, masks, beside, segmented)
    _write(output, found, result, settings)


def _why(found: Detections) -> str:
    """Reason why nobody can be located, and what to do."""
    seeing = [
        name
        for c, name in enumerate(found.camera_names)
        if any(len(found.people(t, c)) for t in range(found.num_sets))
    ]
    if not seeing:
        noted = zip(found.camera_names, found.notes, strict=True)
        looked = f"{found.path} knows {int(found.keypoints_found.sum())} images that were looked at"
        reason = next((f"{name}: {note}" for name, note in noted if note), looked)
        return (
            f"no image has keypoints of anybody ({reason}); expected people with points in the "
            "image and confidences above 0: check the keypoint files"
        )
    if len(seeing) == 1:
        return (
            f"camera {seeing[0]} alone sees anybody, without depth at its keypoints, so that the "
            "distance is unknown; add a second camera or depth"
        )
    return (
        f"no two views agree on one person ({found.path}); check the keypoint files and the "
        "calibration"
    )


def _masks(
    detections: Detections,
    keypoints: np.ndarray,
    points: Triangulation,
    rig: Rig,
    min_confidence: float,
) -> list[bytes]:
    """The subject's mask in each of T * C images, RLE; empty = none."""
    sets, views = keypoints.shape[:2]
    joints = points.points.reshape(sets, NUM_KEYPOINTS, 3)[:, BODY_POINTS]
    pixels = reproject(np.nan_to_num(joints.reshape(-1, 3), nan=1.0), rig)
    pixels = pixels.reshape(sets, -1, views, 2)
    known = np.isfinite(joints[..., 0])
    result = []
    for t in range(sets):
        for c in range(views):
            body = keypoints[t, c, BODY_POINTS]
            # Triangulated points are more reliable than the detections of one view.
            at = np.where(known[t][:, None], pixels[t, :, c], body[:, :2])
            seen = known[t] | (body[:, 2] >= min_confidence)
            where = f"sequence {detections.sequence}, camera {rig.names[c]}, frame {t}"
            result.append(choose_mask(detections.candidates(t, c), at, seen, where))
    return result


def _from_images(
    images: Frames,
    scene: artefacts.Artefact,
    found: Detections,
    points: Triangulation,
    rig: Rig,
    settings: PersonSettings,
) -> dict[tuple[int, int], ViewSegments]:
    """Segment images without a detector; returns results by moment and camera.

    By the setting ``segmentation``: "auto" = images that no detector has processed, "detector" =
    none, "images" = all.
    """
    wanted = images.available
    if settings.segmentation == "auto":
        wanted = wanted & ~found.candidates_found
    if settings.segmentation == "detector" or not wanted.any():
        return {}
    from intercap_core.person.segmentation.image_segmentation import segment_images

    joints = points.points.reshape(*wanted.shape[:1], NUM_KEYPOINTS, 3)
    sigma = spread(points, rig).reshape(joints.shape[:2])
    return segment_images(images, scene, joints, sigma, wanted)


def _write(output: Path, detections: Detections, result: _Result, settings: PersonSettings) -> None:
    """Write the artefact; masks of the detector take precedence over segmented ones."""
    subject, points = result.subject, result.points
    masks, beside = list(result.masks), list(result.beside)
    sets, views = subject.people.shape
    mask_source = np.where(detections.candidates_found, FROM_DETECTOR, NOT_SEGMENTED)
    if settings.segmentation == "images":
        mask_source[:] = NOT_SEGMENTED
        masks, beside = [b""] * len(masks), [b""] * len(masks)
    candidates: list[list[ImageCandidate]] = [[] for _ in masks]
    for (t, c), segments in result.segmented.items():
        image = t * views + c
        candidates[image] = segments.candidates
        if not masks[image]:
            masks[image], beside[image] = segments.person, segments.beside
            mask_source[t, c] = FROM_IMAGES
    offsets, rle = artefacts.pack_ragged(masks)
    inlier = np.swapaxes(points.inlier.reshape(sets, NUM_KEYPOINTS, views), 1, 2)
    with artefacts.write(
        output,
        PERSON,
        settings_digest=digest(settings),
        sequence=detections.sequence,
        images_alone=settings.segmentation == "images",
        chosen_by=subject.chosen_by,
        doubts="; ".join(subject.doubts),
    ) as writer:
        writer.put("camera_names", list(detections.camera_names))
        writer.put("person", subject.people)
        writer.put("others", subject.others)
        writer.put("keypoints", result.keypoints)
        writer.put("joints", points.points.reshape(sets, NUM_KEYPOINTS, 3))
        writer.put("joint_views", points.views.reshape(sets, NUM_KEYPOINTS))
        writer.put("joint_error", points.error.reshape(sets, NUM_KEYPOINTS))
        writer.put("inlier", inlier)
        writer.put("missing", result.missing)
        writer.put("mask_offsets", offsets)
        writer.put("mask_rle", rle)
        beside_offsets, beside_rle = artefacts.pack_ragged(beside)
        writer.put("beside_offsets", beside_offsets)
        writer.put("beside_rle", beside_rle)
        writer.put("mask_source", mask_source)
        if result.segmented or settings.segmentation == "images":
            _put_candidates(writer, candidates)


def _put_candidates(writer: artefacts.Writer, candidates: list[list[ImageCandidate]]) -> None:
    """Write the segmented candidates: one list for each image, in the order of (T, C)."""
    every = [candidate for of_image in candidates for candidate in of_image]
    offsets, rle = artefacts.pack_ragged([candidate.rle for candidate in every])
    writer.put("candidate_offsets", np.cumsum([0, *map(len, candidates)]))
    writer.put("candidate_scores", np.array([c.score for c in every], np.float32))
    writer.put("candidate_extents", np.array([c.extent_m for c in every], np.float32))
    writer.put("candidate_things", np.array([c.component for c in every], np.int32))
    writer.put("candidate_rle_offsets", offsets)
    writer.put("candidate_rle", rle)
