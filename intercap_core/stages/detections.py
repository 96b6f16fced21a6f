"""Stage ``detections``: keypoint and segmentation files to one artefact in image space."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.config import DetectionsSettings, SequenceEntry
from intercap_core.detection import openpose
from intercap_core.detection.coco import CandidateFile, Instance, boxes_of, read_candidates
from intercap_core.errors import UserError
from intercap_core.project import digest
from intercap_core.schemas import DETECTIONS, FRAMES

NOBODY = np.zeros((0, NUM_KEYPOINTS, 3), np.float32)
FILES_NAMED = 3  # broken files that a note names; more are counted


@dataclass
class CameraDetections:
    """What the files say about one camera; lists have one entry a frame set."""

    people: list[np.ndarray]
    instances: list[list[Instance]]
    keypoints_found: np.ndarray
    candidates_found: np.ndarray
    notes: list[str] = field(default_factory=list)


def run(
    *, frames: Path, output: Path, sequence: SequenceEntry, settings: DetectionsSettings
) -> None:
    """Read the sequence's OpenPose and COCO files and write the detections artefact.

    A file belongs to the colour image of its number in the camera's own recording. Missing or cut
    keypoint files and missing cameras are noted, not fatal. Raises UserError where neither
    keypoints nor candidates are found for any image, or a file has another layout than it must.
    """
    with artefacts.read(frames, FRAMES) as source:
        cameras = source.text("camera_names")
        sizes = source["colour_size"]
        images = np.where(source["dropped"][:, None], -1, source["colour_index"])
    found = [
        _read_camera(sequence, name, images[:, c], tuple(int(n) for n in sizes[c]), settings)
        for c, name in enumerate(cameras)
    ]
    if not any(d.keypoints_found.any() or d.candidates_found.any() for d in found):
        raise UserError(
            f"sequence {sequence.sequence}: no detections for any of its images (keypoints "
            f"{sequence.keypoints}, candidates {sequence.candidates}); expected "
            f"<keypoints>/{cameras[0]}/<image>_keypoints.json and <candidates>/{cameras[0]}.json; "
            "run the detectors or correct the paths in the table of sequences"
        )
    with artefacts.write(
        output, DETECTIONS, settings_digest=digest(settings), sequence=sequence.sequence
    ) as writer:
        writer.put("camera_names", cameras)
        writer.put("colour_size", sizes)
        writer.put("note", ["; ".join(d.notes) for d in found])
        writer.put("keypoints_found", np.stack([d.keypoints_found for d in found], 1))
        writer.put("candidates_found", np.stack([d.candidates_found for d in found], 1))
        for name, detections in zip(cameras, found, strict=True):
            _put_camera(writer, name, detections)


def _put_camera(writer: artefacts.Writer, name: str, detections: CameraDetections) -> None:
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
    return np.concatenate([[0], np.cumsum([len(entries) for entries in per_set])]).astype(np.int64)


def _read_camera(
    sequence: SequenceEntry,
    name: str,
    images: np.ndarray,
    size: tuple[int, ...],
    settings: DetectionsSettings,
) -> CameraDetections:
    result = CameraDetections(
        people=[NOBODY] * len(images),
        instances=[[] for _ in images],
        keypoints_found=np.zeros(len(images), bool),
        candidates_found=np.zeros(len(images), bool),
    )
    if not (images >= 0).any():
        return result
    if sequence.keypoints is not None:
        _add_people(result, sequence.keypoints / name, images)
    if sequence.candidates is not None:
        _add_candidates(result, sequence.candidates / f"{name}.json", images, size, settings)
    return result


def _add_people(result: CameraDetections, folder: Path, images: np.ndarray) -> None:
    if not folder.is_dir():
        result.notes.append(f"no folder of keypoints {folder.parent.name}/{folder.name}")
        return
    files = openpose.keypoint_files(folder)
    missing, broken = 0, []
    for t, image in enumerate(images):
        if image < 0:
            continue
        path = files.get(int(image))
        if path is None:
            missing += 1
            continue
        try:
            result.people[t] = openpose.read_people(path)
            result.keypoints_found[t] = True
        except openpose.UnreadableJson:
            broken.append(path.name)
    if missing:
        result.notes.append(f"no keypoint file for {missing} images")
    if broken:
        more = f" and {len(broken) - FILES_NAMED} more" if len(broken) > FILES_NAMED else ""
        result.notes.append(f"keypoint files not readable: {', '.join(broken[:FILES_NAMED])}{more}")


def _add_candidates(
    result: CameraDetections,
    path: Path,
    images: np.ndarray,
    size: tuple[int, ...],
    settings: DetectionsSettings,
) -> None:
    if not path.is_file():
        result.notes.append(f"no candidates {path.parent.name}/{path.name}")
        return
    width, height = size
    results: CandidateFile = read_candidates(
        path, width=width, height=height, min_score=settings.min_score
    )
    for t, image in enumerate(images):
        if image < 0 or (results.images is not None and int(image) not in results.images):
            continue
        result.instances[t] = results.instances.get(int(image), [])
        result.candidates_found[t] = True
