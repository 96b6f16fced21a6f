"""Files of keypoints of one camera, sorted by image.

A file of the camera (``<camera>.json``) holds all images; otherwise its folder ``<camera>/`` holds
a file for each image. :mod:`.keypoints` knows the names of the files and reads them. Entries and
files that cannot be used are noted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.errors import UserError
from intercap_core.formats.detections.coco import UnreadableDetections, read_head, read_json
from intercap_core.formats.detections.image_numbers import (
    CameraImages,
    find_repeated_number,
    note_absent,
    note_broken,
    note_faults,
    note_unmatched,
    short_name,
    sort_by_image,
)
from intercap_core.formats.detections.keypoints import KeypointReader, read_people, readers

# If all coordinates of a person are smaller, they are not pixels but shares of the image's size: 0
# to 1, somewhat more outside the image.
MAX_NORMALISED_PX = 2.0
NOBODY = np.zeros((0, NUM_KEYPOINTS, 3), np.float32)


@dataclass
class KeypointCleaner:
    """Removes impossible keypoints of one camera's images and counts them."""

    size: tuple[int, int]
    """Width and height of the images."""
    full_confidence: float = 1.0
    """Confidence that counts as 1."""
    seen: int = 0
    """Number of points with finite coordinates and a confidence above 0."""
    outside: int = 0
    """Number of points outside the image."""
    beyond: int = 0
    """Number of points with more than the full confidence."""
    normalised: int = 0
    """Number of people with normalised coordinates."""

    def clean(self, people: np.ndarray) -> np.ndarray:
        """Return the usable people (P, 135, 3) as float32: x, y (px), confidence from 0 to 1.

        People without a visible point or with normalised coordinates are left out. A point becomes
        zeros if it is not finite, lies outside the image or exactly at (0, 0), or if it has no
        confidence. Confidence beyond the full one is clipped to 1.
        """
        x, y, confidence = np.moveaxis(np.asarray(people, np.float64), -1, 0)
        with np.errstate(invalid="ignore"):
            seen = np.isfinite(people).all(-1) & (confidence > 0) & ((x != 0) | (y != 0))
            # The centres of pixels have integer coordinates.
            inside = (np.minimum(x, y) >= -0.5) & (x < self.size[0] - 0.5)
            inside &= y < self.size[1] - 0.5
        beyond = seen & (confidence > self.full_confidence)
        self.seen += int(seen.sum())
        self.outside += int((seen & ~inside).sum())
        self.beyond += int(beyond.sum())
        known = seen & inside
        share = np.minimum(np.where(known, confidence, 0) / self.full_confidence, 1)
        result = np.where(known[..., None], np.stack([x, y, share], -1), 0).astype(np.float32)
        present = known.any(-1)
        largest = result[..., :2].max((1, 2), initial=0)
        normalised = present & (largest <= MAX_NORMALISED_PX)
        self.normalised += int(normalised.sum())
        return result[present & ~normalised]

    def notes(self) -> list[str]:
        """Messages for the user about points and people that were changed or left out."""
        notes = []
        width, height = self.size
        if self.outside:
            most = 2 * self.outside > self.seen
            hint = "; are they of images of another size, or of another camera?" if most else ""
            notes.append(
                f"{self.outside} of {self.seen} keypoints lie outside the image of "
                f"{width}x{height} pixels and count as not seen{hint}"
            )
        if self.normalised:
            notes.append(
                f"{self.normalised} people left out whose points all lie within "
                f"{MAX_NORMALISED_PX:g} pixels of the upper left corner: coordinates must be "
                "pixels, not shares of the image"
            )
        if self.beyond:
            notes.append(
                f"{self.beyond} of {self.seen} confidences are beyond {self.full_confidence:g} and "
                "count as 1; detections.keypoint_full_confidence sets the full confidence"
            )
        return notes


@dataclass
class PeopleByImage:
    """People of one camera."""

    by_image: dict[int, np.ndarray] = field(default_factory=dict)
    """People (P, 135, 3) by image number; P = 0 if the detector found none in the image."""
    notes: list[str] = field(default_factory=list)
    """Messages for the user about people and files that were left out."""


@dataclass
class _Reading:
    """State while one camera's files are read."""

    cleaner: KeypointCleaner
    people: PeopleByImage = field(default_factory=PeopleByImage)
    broken: list[str] = field(default_factory=list)
    """Files that cannot be loaded."""
    faults: list[str] = field(default_factory=list)
    """People or files that cannot be used."""
    used: bool = False
    """Whether anything could be used."""

    def finish(self, folder: Path, camera: str) -> PeopleByImage:
        """The people, with notes; raises UserError if files can be loaded and none can be used."""
        notes = self.people.notes
        note_broken(notes, "keypoint files", self.broken)
        if self.faults and not self.used:
            raise UserError(
                f"{folder}: none of camera {camera}'s keypoints can be used: {self.faults[0]}"
            )
        note_faults(notes, "people or files of keypoints", self.faults)
        notes += self.cleaner.notes()
        return self.people


def find_camera_file(folder: Path, camera: str) -> tuple[Path, KeypointReader] | None:
    """The file that holds the keypoints of all images of a camera, and the reader of its form."""
    for reader in readers():
        for name in reader.camera_files:
            path = folder / name.replace("{camera}", camera)
            if path.is_file():
                return path, reader
    return None


def find_image_files(folder: Path) -> tuple[dict[str, Path], KeypointReader] | None:
    """Files of single images in a camera's folder, by the image's name, and their reader.

    None if the folder has no such file.
    """
    visible = [path for path in folder.iterdir() if not path.name.startswith(".")]
    for reader in readers():
        matched = reader.match_images(sorted(visible))
        if matched:
            return matched, reader
    return None


def keypoint_paths(folder: Path, camera: str) -> tuple[Path | None, list[Path]]:
    """The file of all images of a camera, if there is one, and the files of single images."""
    whole = find_camera_file(folder, camera)
    single = find_image_files(folder / camera) if (folder / camera).is_dir() else None
    return whole[0] if whole else None, sorted(single[0].values()) if single else []


def has_keypoints(folder: Path, camera: str) -> bool:
    """Whether there is a file or a folder for the camera."""
    return find_camera_file(folder, camera) is not None or (folder / camera).is_dir()


def read_camera(folder: Path, images: CameraImages, *, full_confidence: float) -> PeopleByImage:
    """Read all keypoints of one camera.

    Raises UserError if files can be loaded and none can be used, or for two files of one image.
    Files that cannot be loaded are noted.

    Args:
        folder: folder of keypoints of the sequence.
        images: the camera's images.
        full_confidence: confidence that counts as 1.
    """
    reading = _Reading(KeypointCleaner(images.size, full_confidence))
    whole = find_camera_file(folder, images.name)
    if whole is not None:
        _add_camera_file(reading, images, *whole)
    elif (folder / images.name).is_dir():
        _add_image_files(reading, folder / images.name, images)
    else:
        reading.people.notes.append(
            f"no keypoints {folder.name}/{images.name}/ or {folder.name}/{images.name}.json"
        )
    return reading.finish(folder, images.name)


def read_files(
    folder: Path,
    files: Mapping[int, Path | None],
    images: CameraImages,
    *,
    full_confidence: float,
) -> PeopleByImage:
    """Read the JSON file of each image number, None = there is none; raises as read_camera."""
    reading = _Reading(KeypointCleaner(images.size, full_confidence))
    reader = next(reader for reader in readers() if reader.load is read_json)
    _add_files(reading, files, reader)
    return reading.finish(folder, images.name)


def _add_camera_file(
    reading: _Reading, images: CameraImages, path: Path, reader: KeypointReader
) -> None:
    """Read one file of all images and sort its people by image."""
    try:
        loaded = reader.load(path)
    except UnreadableDetections as error:
        reading.people.notes.append(f"{short_name(path)} {error}")
        return
    try:
        content = read_people(loaded, reader.load, one_image=False)
    except UnreadableDetections as error:
        reading.faults.append(f"{short_name(path)} {error}")
        return
    by_image, absent = sort_by_image(content, images)
    for number, persons in by_image.items():
        people = np.stack(persons) if persons else NOBODY
        reading.people.by_image[number] = reading.cleaner.clean(people)
    reading.used |= not content.is_useless
    reading.faults += [f"{short_name(path)}, {fault}" for fault in content.faults]
    note_absent(reading.people.notes, absent, images, short_name(path))


def _add_image_files(reading: _Reading, folder: Path, images: CameraImages) -> None:
    """Read the files of a camera's folder."""
    by_name, reader = find_image_files(folder) or ({}, readers()[0])
    places = images.match_names(by_name)
    repeated = [] if places else find_repeated_number(by_name)
    if repeated:
        first, second = (by_name[name].name for name in repeated[:2])
        reading.faults.append(f"one image has two keypoint files, {first} and {second}; keep one")
    by_number = {place: by_name[name] for name, place in places.items()}
    numbers = [int(images.number[t]) for t in images.sets]
    _add_files(reading, {n: by_number.get(n) for n in numbers}, reader)
    absent = [name for name in by_name if places.get(name) not in images.recorded]
    note_unmatched(reading.people.notes, "keypoint files", absent)


def _add_files(reading: _Reading, files: Mapping[int, Path | None], reader: KeypointReader) -> None:
    """Read the file of each image number."""
    missing = 0
    for number, path in files.items():
        if path is None:
            missing += 1
            continue
        try:
            loaded = reader.load(path)
        except UnreadableDetections:
            reading.broken.append(short_name(path))
            continue
        try:
            content = read_people(loaded, reader.load, one_image=True)
        except UnreadableDetections as error:
            reading.faults.append(f"{short_name(path)} {error}")
            continue
        reading.faults += [f"{short_name(path)}, {fault}" for fault in content.faults]
        if content.results or not content.faults:
            people = np.stack([p for _, p in content.results]) if content.results else NOBODY
            reading.people.by_image[number] = reading.cleaner.clean(people)
            reading.used = True
    if missing:
        reading.people.notes.append(f"no keypoint file for {missing} images")


def preview_keypoints(
    folder: Path, camera: str, *, size: tuple[int, int], full_confidence: float
) -> list[str]:
    """Faults in the beginning of one camera's file, or in its first file of one image.

    Args:
        folder: folder of keypoints of the sequence.
        camera: name of the camera.
        size: width and height of its colour images.
        full_confidence: confidence that counts as 1.
    """
    whole = find_camera_file(folder, camera)
    single = find_image_files(folder / camera) if (folder / camera).is_dir() else None
    if whole is not None:
        path, reader = whole
    elif single is not None:
        path, reader = min(single[0].values()), single[1]
    else:
        return []
    try:
        loaded = read_head(path) if reader.load is read_json else reader.load(path)
        if loaded is None:
            return []
        parsed = read_people(loaded, reader.load, one_image=whole is None)
    except UnreadableDetections as error:
        return [f"{path} {error}"]
    notes, cleaner = [], KeypointCleaner(size, full_confidence)
    if parsed.faults:
        notes.append(
            f"{path}: {len(parsed.faults)} of its first {parsed.entries} people cannot be used "
            f"(first: {parsed.faults[0]})"
        )
    if parsed.results:
        cleaner.clean(np.stack([person for _, person in parsed.results]))
        if not cleaner.seen:
            notes.append(
                f"{path}: none of its first {len(parsed.results)} people has a point with numbers "
                "and a confidence above 0; write the keypoints again"
            )
    return notes + [f"{path}: {note}" for note in cleaner.notes()]
