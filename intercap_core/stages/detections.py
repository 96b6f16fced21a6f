"""Stage ``detections``: keypoint and segmentation files to one artefact in image space."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.capture.image_files import FilesRecording
from intercap_core.capture.intercap import numbers_of
from intercap_core.capture.plain import PlainLayout
from intercap_core.config import DetectionsSettings, SequenceEntry
from intercap_core.detection import openpose
from intercap_core.detection.coco import Instance, boxes_of, read_candidates
from intercap_core.detection.mask_files import (
    BehaveFiles,
    MaskFile,
    UnreadableMask,
    read_mask,
    release_masks,
)
from intercap_core.errors import UserError
from intercap_core.project import digest
from intercap_core.schemas import DETECTIONS, FRAMES

NOBODY = np.zeros((0, NUM_KEYPOINTS, 3), np.float32)
FILES_NAMED = 3  # broken files that a note names; more are counted


@dataclass(frozen=True)
class CameraImages:
    """The colour images that the T frame sets hold of one camera.

    ``number`` (T,) is what files of keypoints and candidates call the image, -1 = no image;
    ``time_us`` (T,) its device time. ``stems`` are the names of its image files without suffix, in
    the order that ``number`` counts, where keypoints may be named after them.
    """

    name: str
    size: tuple[int, int]
    number: np.ndarray
    time_us: np.ndarray
    stems: tuple[str, ...] = ()

    @property
    def sets(self) -> list[int]:
        """Frame sets with an image."""
        return np.flatnonzero(self.number >= 0).tolist()


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

    A file belongs to the colour image of its number: in the camera's own recording, or in the
    image file's name where the layout is the InterCap release's. Of a plain folder of images,
    damaged ones count too, and keypoint files may be named after the images. BEHAVE's keypoints
    and masks lie beside its images and are read from there unless the row names others. Missing or
    cut files and missing cameras are noted, not fatal. Raises UserError where neither keypoints
    nor candidates are found for any image, or a file has another layout than it must.
    """
    with artefacts.read(frames, FRAMES) as source:
        images = _images(source, sequence)
    cameras = [camera.name for camera in images]
    beside = None
    if sequence.layout == "behave":
        beside = BehaveFiles(sequence.recordings, sequence.object)
    found = [_read_camera(sequence, camera, beside, settings) for camera in images]
    if not any(d.keypoints_found.any() or d.candidates_found.any() for d in found):
        raise UserError(
            f"sequence {sequence.sequence}: no detections for any of its images (keypoints "
            f"{sequence.keypoints or 'not named'}, candidates "
            f"{sequence.candidates or 'not named'}); expected "
            f"<keypoints>/{cameras[0]}/<image>_keypoints.json and <candidates>/{cameras[0]}.json; "
            "run the detectors or correct the paths in the table of sequences"
        )
    with artefacts.write(
        output, DETECTIONS, settings_digest=digest(settings), sequence=sequence.sequence
    ) as writer:
        writer.put("camera_names", cameras)
        writer.put("colour_size", [camera.size for camera in images])
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


def _images(source: artefacts.Artefact, sequence: SequenceEntry) -> list[CameraImages]:
    indices = np.where(source["dropped"][:, None], -1, source["colour_index"])
    plain = PlainLayout(sequence) if sequence.layout == "plain" else None
    images = []
    for c, name in enumerate(source.text("camera_names")):
        width, height = (int(n) for n in source["colour_size"][c])
        index = number = indices[:, c]
        times = np.full(len(index), -1, np.int64)
        stems: tuple[str, ...] = ()
        if sequence.layout != "k4a" and (index >= 0).any():
            times = np.where(index >= 0, source[f"cameras/{name}/colour_time"][index], -1)
            if plain is not None:
                number, stems = _plain_numbers(plain, name, index, times)
        if sequence.layout == "intercap":
            number = np.where(index >= 0, numbers_of(times), -1)
        images.append(CameraImages(name, (width, height), number, times, stems))
    return images


def _plain_numbers(
    layout: PlainLayout, name: str, index: np.ndarray, times_us: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Places (T,) among all image files of a camera, -1 = no image, and the files' stems.

    ``index`` counts only the images that could be copied, so that a damaged file would move all
    keypoints after it to another image. Of a video it is the place.
    """
    with layout.open(name) as recording:
        if not isinstance(recording, FilesRecording):
            return index, ()
        files = recording.colour_files
    places = {time_us: place for place, (time_us, _) in reversed(list(enumerate(files)))}
    held = times_us[index >= 0].tolist()
    lost = [time_us for time_us in held if time_us not in places]
    if lost:
        raise UserError(
            f"sequence {layout.sequence.sequence!r}: none of the {len(files)} images of camera "
            f"{name} in {recording.source} was taken at {lost[0] / 1e6:.6f} s as the frames "
            "artefact says; images, timestamps or calibration have changed, so run the frames "
            "stage again"
        )
    number = np.full(len(index), -1)
    number[index >= 0] = [places[time_us] for time_us in held]
    return number, tuple(path.stem for _, path in files)


def _read_camera(
    sequence: SequenceEntry,
    images: CameraImages,
    beside: BehaveFiles | None,
    settings: DetectionsSettings,
) -> CameraDetections:
    count, name = len(images.number), images.name
    result = CameraDetections(
        people=[NOBODY] * count,
        instances=[[] for _ in range(count)],
        keypoints_found=np.zeros(count, bool),
        candidates_found=np.zeros(count, bool),
    )
    if not images.sets:
        return result
    if sequence.keypoints is not None:
        folder = sequence.keypoints / name
        if folder.is_dir():
            _add_people(result, _keypoint_files(folder, images))
        else:
            result.notes.append(f"no folder of keypoints {folder.parent.name}/{folder.name}")
    elif beside is not None:
        times = {t: int(images.time_us[t]) for t in images.sets}
        _add_people(result, {t: beside.keypoints(time, name) for t, time in times.items()})
    if sequence.candidates is not None:
        _add_candidates(result, sequence.candidates, images, settings)
    elif beside is not None:
        times = {t: int(images.time_us[t]) for t in images.sets}
        _add_masks(result, {t: beside.masks(time, name) for t, time in times.items()}, images.size)
    return result


def _keypoint_files(folder: Path, images: CameraImages) -> dict[int, Path | None]:
    """The file of each frame set: by the image's name where any is so named, else by number."""
    numbers = {t: int(images.number[t]) for t in images.sets}
    named = openpose.named_keypoint_files(folder, images.stems)
    if named:
        return {t: named.get(images.stems[number]) for t, number in numbers.items()}
    numbered = openpose.keypoint_files(folder)
    return {t: numbered.get(number) for t, number in numbers.items()}


def _add_people(result: CameraDetections, files: dict[int, Path | None]) -> None:
    """Read the keypoint file of each frame set, None = there is none."""
    missing, broken = 0, []
    for t, path in files.items():
        if path is None:
            missing += 1
            continue
        try:
            people = openpose.read_people(path)
        except openpose.UnreadableJson:
            broken.append(_short(path))
            continue
        # BEHAVE states "nobody" as a person without any confidence.
        result.people[t] = people[(people[..., 2] > 0).any(1)]
        result.keypoints_found[t] = True
    if missing:
        result.notes.append(f"no keypoint file for {missing} images")
    _note_broken(result, "keypoint files", broken)


def _add_candidates(
    result: CameraDetections, folder: Path, images: CameraImages, settings: DetectionsSettings
) -> None:
    """Read a camera's COCO results, and masks that the folder keeps as images."""
    path = folder / f"{images.name}.json"
    mask_files = release_masks(folder, images.name)
    if not path.is_file() and mask_files is None:
        result.notes.append(f"no candidates {path.parent.name}/{path.name}")
        return
    numbers = {t: int(images.number[t]) for t in images.sets}
    if path.is_file():
        width, height = images.size
        results = read_candidates(path, width=width, height=height, min_score=settings.min_score)
        for t, number in numbers.items():
            if results.images is None or number in results.images:
                result.instances[t] = list(results.instances.get(number, []))
                result.candidates_found[t] = True
    if mask_files is not None:
        files = {t: [mask_files[n]] if n in mask_files else [] for t, n in numbers.items()}
        _add_masks(result, files, images.size)


def _add_masks(
    result: CameraDetections, files: dict[int, list[MaskFile]], size: tuple[int, int]
) -> None:
    """Read the mask images of each frame set; an empty mask is no candidate."""
    missing, broken = 0, []
    for t, mask_files in files.items():
        missing += not mask_files
        for file in mask_files:
            try:
                instance = read_mask(file, size)
            except UnreadableMask as error:
                broken.append(f"{_short(file.path)} {error}")
                continue
            result.candidates_found[t] = True
            if instance is not None:
                result.instances[t].append(instance)
    if missing:
        result.notes.append(f"no mask for {missing} images")
    _note_broken(result, "masks", broken)


def _short(path: Path) -> str:
    """The file's name with its folder's, which is a camera or a moment."""
    return f"{path.parent.name}/{path.name}"


def _note_broken(result: CameraDetections, what: str, broken: list[str]) -> None:
    if broken:
        more = f" and {len(broken) - FILES_NAMED} more" if len(broken) > FILES_NAMED else ""
        result.notes.append(f"{what} not readable: {', '.join(broken[:FILES_NAMED])}{more}")
