"""Which files of a folder of keypoints speak of one camera, and of which of its images.

``<camera>.json`` (or as mmpose and AlphaPose name it) holds all images; else ``<camera>/`` holds a
file an image, ``<image>_keypoints.json`` as OpenPose writes it or ``<image>.json``. What a file
holds says whose it is. What cannot be used is left out and told, and the rest counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.errors import UserError
from intercap_core.formats.detections.candidate_files import (
    FILES_NAMED,
    note_absent,
    note_broken,
    short,
    sorted_by_image,
)
from intercap_core.formats.detections.coco import UnreadableCandidates, read_head, read_json
from intercap_core.formats.detections.converters import openpose
from intercap_core.formats.detections.converters.coco_people import people_of
from intercap_core.formats.detections.converters.openpose import as_openpose
from intercap_core.formats.detections.image_numbers import CameraImages
from intercap_core.inputs.files import printable

EDGE_PX = 0.5  # the centres of pixels have integer coordinates
# px. A person whose points all lie below this has normalised coordinates (0 to 1, some beyond the
# image), not pixels.
MAX_NORMALISED_PX = 2.0
NOBODY = np.zeros((0, NUM_KEYPOINTS, 3), np.float32)


@dataclass
class Values:
    """Cleans the people of one camera's images of ``size`` (width, height), and counts.

    ``full_confidence`` is what counts as 1.
    """

    size: tuple[int, int]
    full_confidence: float = 1.0
    seen: int = 0
    outside: int = 0
    beyond: int = 0
    shares: int = 0

    def clean(self, people: np.ndarray) -> np.ndarray:
        """People (P, 135, 3) without those of whom nothing is seen, the rest as float32.

        A point that is not finite, lies outside the image or in its very corner (0, 0), or has no
        confidence becomes zeros; confidence beyond the full one is cut to 1.
        """
        x, y, confidence = np.moveaxis(np.asarray(people, np.float64), -1, 0)
        with np.errstate(invalid="ignore"):
            seen = np.isfinite(people).all(-1) & (confidence > 0) & ((x != 0) | (y != 0))
            inside = (np.minimum(x, y) >= -EDGE_PX) & (x < self.size[0] - EDGE_PX)
            inside &= y < self.size[1] - EDGE_PX
        beyond = seen & (confidence > self.full_confidence)
        self.seen += int(seen.sum())
        self.outside += int((seen & ~inside).sum())
        self.beyond += int(beyond.sum())
        known = seen & inside
        share = np.minimum(np.where(known, confidence, 0) / self.full_confidence, 1)
        result = np.where(known[..., None], np.stack([x, y, share], -1), 0).astype(np.float32)
        present = known.any(-1)
        shares = present & (result[..., :2].max((1, 2), initial=0) <= MAX_NORMALISED_PX)
        self.shares += int(shares.sum())
        return result[present & ~shares]

    def notes(self) -> list[str]:
        """What was changed, in words."""
        notes = []
        width, height = self.size
        if self.outside:
            wrong = 2 * self.outside > self.seen
            hint = "; are they of images of another size, or of another camera?" if wrong else ""
            notes.append(
                f"{self.outside} of {self.seen} keypoints lie outside the image of "
                f"{width}x{height} pixels and count as not seen{hint}"
            )
        if self.shares:
            notes.append(
                f"{self.shares} people left out whose points all lie within {MAX_NORMALISED_PX:g} "
                "pixels of the upper left corner: coordinates must be pixels, not shares of the "
                "image"
            )
        if self.beyond:
            notes.append(
                f"{self.beyond} of {self.seen} confidences are beyond {self.full_confidence:g} and "
                "count as 1; detections.keypoint_full_confidence says what is full"
            )
        return notes


RESULTS = "results_"  # what mmpose's demo puts before the name of an image or a video
ALPHAPOSE = "alphapose-results.json"


@dataclass
class People:
    """What is known of one camera: people (P, 135, 3) by image number, also none, and notes."""

    by_image: dict[int, np.ndarray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


@dataclass
class _Reading:
    """One camera's files while they are read."""

    values: Values
    people: People = field(default_factory=People)
    broken: list[str] = field(default_factory=list)  # cut or empty files
    faults: list[str] = field(default_factory=list)  # people or files of another layout
    used: bool = False  # anything could be read

    def finished(self, folder: Path, camera: str) -> People:
        """The people, with notes; raises UserError where all that was found is of no use."""
        notes = self.people.notes
        note_broken(notes, "keypoint files", self.broken)
        if self.faults and not self.used:
            raise UserError(
                f"{folder}: none of camera {camera}'s keypoints can be used: {self.faults[0]}"
            )
        if self.faults:
            first = "; ".join(self.faults[:FILES_NAMED])
            notes.append(f"{len(self.faults)} people or files of keypoints left out: {first}")
        notes += self.values.notes()
        return self.people


def camera_file(folder: Path, camera: str) -> Path | None:
    """The file that holds the keypoints of all images of a camera, if there is one."""
    names = (f"{camera}.json", f"{RESULTS}{camera}.json", f"{camera}/{ALPHAPOSE}")
    return next((folder / name for name in names if (folder / name).is_file()), None)


def image_files(folder: Path) -> list[Path]:
    """The JSON files in a camera's folder, one an image."""
    if not folder.is_dir():
        return []
    paths = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path for path in paths if path.suffix.lower() == ".json")


def has_keypoints(folder: Path, camera: str) -> bool:
    """Whether any file, or a folder for files, speaks of the camera."""
    return camera_file(folder, camera) is not None or (folder / camera).is_dir()


def read_camera(folder: Path, images: CameraImages, *, full_confidence: float) -> People:
    """Read all that ``folder`` holds of one camera; ``full_confidence`` counts as 1.

    Raises UserError where there are keypoints and none can be used, or two of one image.
    """
    reading = _Reading(Values(images.size, full_confidence))
    path = camera_file(folder, images.name)
    if path is not None:
        _add_camera_file(reading, images, path)
    elif (folder / images.name).is_dir():
        _add_image_files(reading, folder / images.name, images)
    else:
        reading.people.notes.append(
            f"no keypoints {folder.name}/{images.name}/ or {folder.name}/{images.name}.json"
        )
    return reading.finished(folder, images.name)


def read_files(
    folder: Path,
    files: Mapping[int, Path | None],
    images: CameraImages,
    *,
    full_confidence: float,
) -> People:
    """Read the file of each image, None = there is none, somewhere below ``folder``; fails as
    :func:`read_camera` does."""
    reading = _Reading(Values(images.size, full_confidence))
    _add_files(reading, files)
    return reading.finished(folder, images.name)


def _add_camera_file(reading: _Reading, images: CameraImages, path: Path) -> None:
    """Read one file of all images and sort its people by image."""
    try:
        parsed = read_json(path)
    except UnreadableCandidates as error:
        reading.people.notes.append(f"{short(path)} {error}")
        return
    try:
        content = people_of(parsed)
    except UnreadableCandidates as error:
        reading.faults.append(f"{short(path)} {error}")
        return
    useless = bool(content.entries) and len(content.faults) == content.entries
    by_image, absent = sorted_by_image(
        content.results, content.images, content.faulty, images, useless=useless
    )
    for number, found in by_image.items():
        people = np.stack(found) if found else NOBODY
        reading.people.by_image[number] = reading.values.clean(people)
    reading.used |= not useless
    reading.faults += [f"{short(path)}, {fault}" for fault in content.faults]
    note_absent(reading.people.notes, absent, images, short(path))


def _add_image_files(reading: _Reading, folder: Path, images: CameraImages) -> None:
    """Read the files of a camera's folder: by the image's name where any is so named, else by
    number."""
    numbers = [int(images.number[t]) for t in images.sets]
    named = openpose.named_keypoint_files(folder, images.stems)
    numbered = {} if named else openpose.keypoint_files(folder)
    if named:
        _add_files(reading, {n: named.get(images.stems[n]) for n in numbers})
        return
    if numbered:
        _add_files(reading, {n: numbered.get(n) for n in numbers})
        return
    paths = {path.name.removeprefix(RESULTS): path for path in image_files(folder)}
    places = images.numbers_of_names(paths)
    by_number = {place: paths[name] for name, place in places.items()}
    absent = [name for name in paths if places.get(name) not in images.recorded]
    _add_files(reading, {n: by_number.get(n) for n in numbers})
    if absent:
        reading.people.notes.append(
            f"{len(absent)} keypoint files belong to no image (first: {printable(absent[0][:80])})"
        )


def _add_files(reading: _Reading, files: Mapping[int, Path | None]) -> None:
    missing = 0
    for number, path in files.items():
        if path is None:
            missing += 1
            continue
        try:
            content = read_json(path)
        except UnreadableCandidates:
            reading.broken.append(short(path))
            continue
        try:
            people = _people_of_image(reading, content, path)
        except UserError as error:
            reading.faults.append(str(error))
            continue
        except UnreadableCandidates as error:
            reading.faults.append(f"{short(path)} {error}")
            continue
        if people is not None:
            reading.people.by_image[number] = reading.values.clean(people)
            reading.used = True
    if missing:
        reading.people.notes.append(f"no keypoint file for {missing} images")


def _people_of_image(reading: _Reading, content: Any, path: Path) -> np.ndarray | None:
    """People (P, 135, 3) of a file of one image, None = all of them are of no use."""
    content = as_openpose(content)
    if openpose.is_openpose(content):
        return openpose.people_of(content, short(path))
    found = people_of(content, one_image=True)
    reading.faults += [f"{short(path)}, {fault}" for fault in found.faults]
    if found.faults and not found.results:
        return None
    return np.stack([one for _, one in found.results]) if found.results else NOBODY


def look_at_keypoints(
    folder: Path, camera: str, *, size: tuple[int, int], full_confidence: float
) -> list[str]:
    """What is wrong with the beginning of one camera's file, or its first file of one image.

    ``size`` (width, height) of the colour images; ``full_confidence`` counts as 1.
    """
    whole = camera_file(folder, camera)
    path = whole if whole is not None else next(iter(image_files(folder / camera)), None)
    if path is None:
        return []
    notes, values = [], Values(size, full_confidence)
    try:
        content = read_head(path)
        if content is None:
            return []
        if whole is None:
            content = as_openpose(content)
        if whole is None and openpose.is_openpose(content):
            people = openpose.people_of(content, str(path))
        else:
            found = people_of(content, one_image=whole is None)
            if found.faults:
                notes.append(
                    f"{path}: {len(found.faults)} of its first {found.entries} people cannot be "
                    f"used (first: {found.faults[0]})"
                )
            people = np.array([person for _, person in found.results]).reshape(
                -1, *NOBODY.shape[1:]
            )
    except UnreadableCandidates as error:
        return [f"{path} {error}"]
    except UserError as error:
        return [str(error)]
    values.clean(people)
    if len(people) and not values.seen:
        notes.append(
            f"{path}: none of its first {len(people)} people has a point with numbers and a "
            "confidence above 0; write the keypoints again"
        )
    return notes + [f"{path}: {note}" for note in values.notes()]
