"""Files of keypoints of one camera, sorted by image.

A file of the camera (``<camera>.json``) holds all images; otherwise its folder ``<camera>/`` holds
a file for each image. :mod:`.keypoints` knows the names of the files and reads them,
:mod:`.people_of_camera` recognises their layout and unit. Entries and files that cannot be used are
noted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.detections.coco import (
    DetectionPreview,
    UnreadableDetections,
    read_first,
    read_head,
    read_json,
)
from intercap_core.formats.detections.image_numbers import (
    CameraImages,
    find_repeated_number,
    note_absent,
    note_unmatched,
    preview_names,
    refuse_both,
    short_name,
    sort_by_image,
)
from intercap_core.formats.detections.keypoints import KeypointReader, read_people, readers, visible
from intercap_core.formats.detections.people_of_camera import (
    NOBODY,
    PeopleByImage,
    PeopleReading,
    recognise_layout,
)

FILES_PREVIEWED = 20


@dataclass(frozen=True)
class KeypointFiles:
    """Files of keypoints of one camera."""

    whole: Path | None
    """File of all images."""
    single: Mapping[str, Path]
    """Files of single images, by the image's name."""
    reader: KeypointReader
    """Reader of ``whole`` if there is one, otherwise of ``single``."""

    @classmethod
    def find(cls, folder: Path, camera: str) -> KeypointFiles:
        """Find the files of a camera in the ``folder`` of a sequence's keypoints."""
        own = folder / camera
        paths = sorted(own.iterdir()) if own.is_dir() else []
        paths = [path for path in paths if not path.name.startswith(".")]
        matches = ((reader.match_images(paths), reader) for reader in readers())
        single, reader = next((match for match in matches if match[0]), ({}, readers()[0]))
        for possible in readers():
            for name in possible.camera_files:
                whole = folder / name.replace("{camera}", camera)
                if whole.is_file():
                    return cls(whole, single, possible)
        return cls(None, single, reader)

    @property
    def used(self) -> list[Path]:
        """The files that are read."""
        return sorted(self.single.values()) if self.whole is None else [self.whole]

    def refuse_both(self) -> None:
        """Raise UserError if there is a file of all images and also files of single images."""
        refuse_both(self.whole, self.single.values())

    def load_first(
        self, notes: list[str], load: Callable[[Path], Any] = read_head
    ) -> dict[Path, Any]:
        """Load the beginning of the file of all images, or some of the files of single images.

        ``load`` parses JSON. Files that cannot be loaded are added to ``notes``.
        """
        loaded: dict[Path, Any] = {}
        for path in self.used[:: -(-len(self.used) // FILES_PREVIEWED) or 1]:
            try:
                reads_json = self.reader.load is read_json
                content = load(path) if reads_json else self.reader.load(path)
            except UnreadableDetections as error:
                notes.append(f"{path} {error}")
                continue
            if content is not None:
                loaded[path] = content
        return loaded


def _read(
    folder: Path,
    images: CameraImages,
    layout: str | None,
    full_confidence: float,
    add: Callable[[PeopleReading], None],
) -> tuple[PeopleReading, PeopleByImage]:
    """Read people by ``add`` in the stated or the recognised layout."""

    def read_as(name: str | None) -> PeopleReading:
        reading = PeopleReading(images, name)
        add(reading)
        return reading

    reading = recognise_layout(read_as(layout), read_as, folder)
    return reading, reading.finish(folder, full_confidence)


def read_camera(
    folder: Path, images: CameraImages, *, full_confidence: float, layout: str | None = None
) -> PeopleByImage:
    """Read all keypoints of one camera.

    Raises UserError if files can be loaded and none can be used, for two files of one image, for
    a file of all images and also files of single images, or for points whose layout cannot be
    recognised. Files that cannot be loaded are noted.

    Args:
        full_confidence: confidence that counts as 1.
        layout: name of the layout of the points, None = recognised.
    """
    files = KeypointFiles.find(folder, images.name)
    files.refuse_both()

    def add(reading: PeopleReading) -> None:
        if files.whole is not None:
            _add_camera_file(reading, files.whole, files.reader)
        elif (folder / images.name).is_dir():
            _add_image_files(reading, files)
        else:
            reading.notes.append(
                f"no keypoints {folder.name}/{images.name}/ or {folder.name}/{images.name}.json"
            )

    return _read(folder, images, layout, full_confidence, add)[1]


def read_files(
    folder: Path,
    files: Mapping[int, Path | None],
    images: CameraImages,
    *,
    full_confidence: float,
    layout: str | None = None,
) -> PeopleByImage:
    """Read the JSON file of each image number, None = there is none; raises as read_camera."""
    reader = next(reader for reader in readers() if reader.load is read_json)
    add = partial(_add_files, files=files, reader=reader)
    return _read(folder, images, layout, full_confidence, add)[1]


def _add_camera_file(reading: PeopleReading, path: Path, reader: KeypointReader) -> None:
    """Read one file of all images and sort its people by image."""
    try:
        loaded = reader.load(path)
    except UnreadableDetections as error:
        reading.notes.append(f"{short_name(path)} {error}")
        return
    content = reading.parse(loaded, reader, path, one_image=False)
    if content is None:
        return
    by_image, absent, remark = sort_by_image(content, reading.images)
    for number, persons in by_image.items():
        reading.raw[number] = np.stack(persons) if persons else NOBODY
    reading.used |= not content.is_useless
    reading.faults += [f"{short_name(path)}, {fault}" for fault in content.faults]
    if remark:
        reading.recognised.append(f"images of {short_name(path)} are {remark}")
    note_absent(reading.notes, absent, reading.images, short_name(path))


def _add_image_files(reading: PeopleReading, files: KeypointFiles) -> None:
    """Read the files of single images."""
    images, by_name = reading.images, files.single
    places, remark = images.recognise_names(by_name)
    repeated = [] if places else find_repeated_number(by_name)
    if repeated:
        first, second = (by_name[name].name for name in repeated[:2])
        reading.faults.append(f"one image has two keypoint files, {first} and {second}; keep one")
    if remark:
        reading.recognised.append(f"keypoint files are {remark}")
    by_number = {place: by_name[name] for name, place in places.items()}
    numbers = [int(images.number[t]) for t in images.sets]
    _add_files(reading, {n: by_number.get(n) for n in numbers}, files.reader)
    absent = [name for name in by_name if places.get(name) not in images.recorded]
    note_unmatched(reading.notes, "keypoint files", absent)


def _add_files(
    reading: PeopleReading, files: Mapping[int, Path | None], reader: KeypointReader
) -> None:
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
        content = reading.parse(loaded, reader, path, one_image=True)
        if content is None:
            continue
        reading.faults += [f"{short_name(path)}, {fault}" for fault in content.faults]
        if content.results or not content.faults:
            reading.raw[number] = (
                np.stack([p for _, p in content.results]) if content.results else NOBODY
            )
            reading.used = True
    if missing:
        reading.notes.append(f"no keypoint file for {missing} images")


def holds_people(folder: Path, camera: str) -> bool:
    """Whether the first files of a camera hold keypoints of a person."""
    files = KeypointFiles.find(folder, camera)
    for content in files.load_first([], read_first).values():
        try:
            one_image = files.whole is None
            if read_people(content, files.reader.load, one_image=one_image).results:
                return True
        except UnreadableDetections:
            continue
    return False


def preview_keypoints(
    folder: Path, images: CameraImages, *, full_confidence: float, layout: str | None = None
) -> DetectionPreview:
    """Read the beginning of one camera's file, or some of its files of one image.

    Arguments as of :func:`read_camera`.
    """
    preview = DetectionPreview()
    files = KeypointFiles.find(folder, images.name)
    if files.whole is None and files.single:
        preview_names(preview, folder / images.name, files.single, images)
    unreadable: list[str] = []
    loaded = files.load_first(unreadable)
    preview.notes += unreadable
    if not files.used:
        return preview

    def add(reading: PeopleReading) -> None:
        entries = 0
        faults: list[str] = []
        for number, (path, content) in enumerate(loaded.items()):
            parsed = reading.parse(content, files.reader, path, one_image=files.whole is None)
            if parsed is not None:
                entries, faults = entries + parsed.entries, faults + parsed.faults
                people = [person for _, person in parsed.results]
                reading.raw[number] = np.stack(people) if people else NOBODY
                reading.used |= bool(people) or not parsed.faults
        if faults:
            reading.notes.append(
                f"{len(faults)} of its first {entries} people cannot be used (first: {faults[0]})"
            )

    try:
        files.refuse_both()
        reading, found = _read(folder, images, layout, full_confidence, add)
    except UserError as error:
        preview.faults.append(str(error))
        return preview
    preview.usable = reading.used if loaded else not unreadable
    preview.recognised += found.recognised
    preview.layouts = reading.assumed if reading.layout is None else {reading.layout}
    where = next(iter(loaded), folder)
    preview.notes += [f"{where}: {note}" for note in found.notes if note not in found.recognised]
    if len(reading.people) and not visible(reading.people).any():
        preview.notes.append(
            f"{where}: none of its first {len(reading.people)} people has a point with numbers "
            "and a confidence above 0; write the keypoints again"
        )
    return preview
