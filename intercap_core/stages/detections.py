"""Stage ``detections``: keypoints and segmentation candidates of every image, in one artefact."""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.config import DetectionsSettings, digest
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections import candidate_files, keypoint_files
from intercap_core.formats.detections.candidate_files import CandidatesByImage
from intercap_core.formats.detections.class_names import class_names
from intercap_core.formats.detections.image_numbers import CameraImages, camera_images
from intercap_core.formats.detections.instance import Instance, boxes_of
from intercap_core.formats.detections.mask_files import BehaveFiles
from intercap_core.formats.detections.people_of_camera import NOBODY, KeypointCleaner, PeopleByImage
from intercap_core.progress import Progress
from intercap_core.schemas import DETECTIONS, FRAMES

log = logging.getLogger(__name__)

Image = tuple[int, int]  # frame set and camera


@dataclass
class CameraDetections:
    """Detections of one camera; the lists have one entry for each of the T frame sets."""

    people: list[np.ndarray]
    """Keypoints (P, 135, 3) of the people: x, y (px), confidence."""
    instances: list[list[Instance]]
    """Segmentation candidates of each image."""
    keypoints_found: np.ndarray
    """(T,) bool: a detector processed the image for people, even if it found none."""
    candidates_found: np.ndarray
    """(T,) bool: a detector processed the image for instances, even if it found none."""
    notes: list[str] = field(default_factory=list)
    """Remarks for the user on what was left out."""


def run(
    *, frames: Path, output: Path, sequence: SequenceEntry, settings: DetectionsSettings
) -> None:
    """Read the sequence's files of keypoints and candidates and write the detections artefact.

    Files are matched to colour images by number or name
    (:mod:`intercap_core.formats.detections.image_numbers`). BEHAVE's files are read from the
    folders of its images, unless the row of the sequence names other paths. Images without a file
    are processed by the models of the settings: first segmentation, then keypoints. Missing or
    broken files, unusable entries and missing cameras are noted.

    Raises UserError if no image has keypoints or candidates, or if none of a camera's keypoints can
    be used.
    """
    with artefacts.read(frames, FRAMES) as source:
        images = camera_images(source, sequence)
    cameras = [camera.name for camera in images]
    behave = None
    if sequence.layout == "behave":
        behave = BehaveFiles(sequence.recordings, sequence.object)
    found = [_read_camera(sequence, camera, behave, settings) for camera in images]
    attributes = {}
    if settings.segmentation_model is not None:
        _segment(frames, images, found, settings)
        attributes["segmentation_model"] = _identity(settings.segmentation_model)
    if settings.keypoint_model is not None:
        _find_people(frames, images, found, settings)
        attributes["keypoint_model"] = _identity(settings.keypoint_model)
    if not any(d.keypoints_found.any() or d.candidates_found.any() for d in found):
        _raise_nothing(sequence, cameras, found)
    with artefacts.write(
        output,
        DETECTIONS,
        settings_digest=digest({k: v for k, v in settings if not isinstance(v, Path)}),
        sequence=sequence.sequence,
        **attributes,
    ) as writer:
        writer.put("camera_names", cameras)
        writer.put("colour_size", [camera.size for camera in images])
        writer.put("note", ["; ".join(d.notes) for d in found])
        writer.put("keypoints_found", np.stack([d.keypoints_found for d in found], 1))
        writer.put("candidates_found", np.stack([d.candidates_found for d in found], 1))
        for name, detections in zip(cameras, found, strict=True):
            _put_camera(writer, name, detections)


def _identity(path: Path) -> str:
    """Name and SHA-256 checksum of a model file."""
    with open(path, "rb") as file:
        return f"{path.name} {hashlib.file_digest(file, 'sha256').hexdigest()}"


def _raise_nothing(
    sequence: SequenceEntry, cameras: list[str], found: list[CameraDetections]
) -> None:
    """Raise UserError: no image of the sequence has keypoints or candidates."""
    reasons = "; ".join(
        f"{name}: {', '.join(d.notes)}" for name, d in zip(cameras, found, strict=True) if d.notes
    )
    raise UserError(
        f"sequence {sequence.sequence}: no detections for any of its images (keypoints "
        f"{sequence.keypoints or 'not named'}, candidates "
        f"{sequence.candidates or 'not named'}{f'; {reasons}' if reasons else ''}); expected "
        f"<keypoints>/{cameras[0]}/<image>_keypoints.json or <keypoints>/{cameras[0]}.json, and "
        f"<candidates>/{cameras[0]}.json; "
        "run the detectors or correct the paths in the table of sequences"
    )


def _put_camera(writer: artefacts.Writer, name: str, detections: CameraDetections) -> None:
    """Write one camera's detections as concatenated lists with offsets by frame set."""
    group = f"cameras/{name}"
    instances = [i for in_set in detections.instances for i in in_set]
    rle_offsets, rle = artefacts.pack_ragged([i.rle for i in instances])
    writer.put(f"{group}/people_offsets", _offsets(detections.people))
    writer.put(f"{group}/people", np.concatenate([NOBODY, *detections.people]))
    writer.put(f"{group}/candidate_offsets", _offsets(detections.instances))
    writer.put(f"{group}/candidate_labels", [i.label for i in instances])
    writer.put(f"{group}/candidate_scores", np.array([i.score for i in instances], np.float32))
    writer.put(f"{group}/candidate_boxes", boxes_of(instances))
    writer.put(f"{group}/rle_offsets", rle_offsets)
    writer.put(f"{group}/rle", rle)


def _offsets(per_set: list[np.ndarray] | list[list[Instance]]) -> np.ndarray:
    """Offsets (T + 1,) int64 of the entries of each set in the concatenated list."""
    return np.concatenate([[0], np.cumsum([len(entries) for entries in per_set])]).astype(np.int64)


def _read_camera(
    sequence: SequenceEntry,
    images: CameraImages,
    behave: BehaveFiles | None,
    settings: DetectionsSettings,
) -> CameraDetections:
    """Read the keypoint and candidate files of one camera."""
    count, name = len(images.number), images.name
    result = CameraDetections(
        people=[NOBODY] * count,
        instances=[[] for _ in range(count)],
        keypoints_found=np.zeros(count, bool),
        candidates_found=np.zeros(count, bool),
    )
    if not images.sets:
        return result
    times = {t: int(images.time_us[t]) for t in images.sets}
    full = settings.keypoint_full_confidence
    if sequence.keypoints is not None:
        people = keypoint_files.read_camera(
            sequence.keypoints,
            replace(images, first_number=settings.keypoint_first_number),
            full_confidence=full,
            layout=settings.keypoint_layout,
        )
        _add_people(result, people, images)
    elif behave is not None:
        paths = {int(images.number[t]): behave.keypoints(time, name) for t, time in times.items()}
        people = keypoint_files.read_files(
            sequence.recordings,
            paths,
            images,
            full_confidence=full,
            layout=settings.keypoint_layout,
        )
        _add_people(result, people, images)
    if sequence.candidates is not None:
        candidates = candidate_files.read_camera(
            sequence.candidates,
            replace(images, first_number=settings.candidate_first_number),
            layout=sequence.layout,
            min_score=settings.min_score,
            names=class_names(settings.category_names),
        )
        _add_candidates(result, candidates, images)
    elif behave is not None:
        candidates = CandidatesByImage()
        files = {int(images.number[t]): behave.masks(time, name) for t, time in times.items()}
        candidate_files.add_masks(candidates, files, images.size)
        _add_candidates(result, candidates, images)
    return result


def _add_people(result: CameraDetections, people: PeopleByImage, images: CameraImages) -> None:
    """Give each frame set the people of its image."""
    for t in images.sets:
        found = people.by_image.get(int(images.number[t]))
        if found is not None:
            result.people[t] = found
            result.keypoints_found[t] = True
    result.notes += people.notes


def _add_candidates(
    result: CameraDetections, candidates: CandidatesByImage, images: CameraImages
) -> None:
    """Give each frame set the candidates of its image."""
    for t in images.sets:
        instances = candidates.by_image.get(int(images.number[t]))
        if instances is not None:
            result.instances[t] = list(instances)
            result.candidates_found[t] = True
    result.notes += candidates.notes


def _segment(
    frames: Path,
    images: list[CameraImages],
    found: list[CameraDetections],
    settings: DetectionsSettings,
) -> None:
    """Run the segmentation model on the images without candidates from files."""
    from intercap_core.formats.detections.onnx_segmentation import Segmenter

    wanted = _unknown(images, [d.candidates_found for d in found])
    if not wanted:
        return
    pictures = _pictures(frames, wanted, found, "segmented")
    for (t, c), instances in Segmenter.load(settings).segment(pictures):
        found[c].instances[t] = instances
        found[c].candidates_found[t] = True


def _find_people(
    frames: Path,
    images: list[CameraImages],
    found: list[CameraDetections],
    settings: DetectionsSettings,
) -> None:
    """Run the keypoint model on the images without keypoints from files."""
    from intercap_core.formats.detections.onnx_pose import PoseModel

    wanted = _unknown(images, [d.keypoints_found for d in found])
    if not wanted:
        return
    model = PoseModel.load(settings)
    cleaners = [
        KeypointCleaner(camera.size, settings.keypoint_full_confidence) for camera in images
    ]
    for (t, c), picture in _pictures(frames, wanted, found, "found people in"):
        found[c].people[t] = cleaners[c].clean(model.find(picture, found[c].instances[t]))
        found[c].keypoints_found[t] = True
    for detections, cleaner in zip(found, cleaners, strict=True):
        detections.notes += cleaner.notes()


def _unknown(images: list[CameraImages], known: list[np.ndarray]) -> list[Image]:
    """Images (set, camera) that no detector has processed.

    ``known``: for each camera a mask (T,) of the processed images.
    """
    return [
        (t, c)
        for c, (camera, found) in enumerate(zip(images, known, strict=True))
        for t in camera.sets
        if not found[t]
    ]


def _pictures(
    frames: Path, wanted: list[Image], found: list[CameraDetections], doing: str
) -> Iterator[tuple[Image, np.ndarray]]:
    """Yield the wanted images (H, W, 3); a note counts those of a camera that do not decode.

    ``doing``: word before "images", for the progress and the note.
    """
    from intercap_core.formats.recordings.frames import Frames

    damaged: Counter[int] = Counter()
    progress = Progress(log, doing, len(wanted), "images")
    with Frames.open(frames) as recording:
        for t, c in wanted:
            try:
                picture = recording.colour(t, c)
            except UserError:
                picture = None
            if picture is None:
                damaged[c] += 1
            else:
                yield (t, c), picture
            progress.step()
    for c, count in damaged.items():
        found[c].notes.append(f"{count} damaged images left out ({doing} the others)")
