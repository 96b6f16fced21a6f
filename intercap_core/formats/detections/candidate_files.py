"""Which files of a folder of candidates speak of one camera, and of which of its images.

``<camera>.json`` holds all images (so do the names that detectron2 and ultralytics give, in a
folder ``<camera>/``); else ``<camera>/<image>.json`` holds one. Masks as images in ``<camera>/``
are read beside either. What cannot be used is left out and told, and the rest counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from intercap_core.formats.detections.coco import (
    CandidateFile,
    ImageKey,
    UnreadableCandidates,
    candidates_of,
    read_head,
    read_json,
)
from intercap_core.formats.detections.image_numbers import CameraImages
from intercap_core.formats.detections.instance import Instance
from intercap_core.formats.detections.mask_files import (
    MaskFile,
    UnreadableMask,
    instance_masks,
    read_masks,
    release_masks,
)
from intercap_core.inputs.files import printable

Result = TypeVar("Result")

FILES_NAMED = 3  # broken files or entries that a note names; more are counted
ALL_IMAGES = ("coco_instances_results.json", "predictions.json")  # in the camera's own folder


@dataclass
class Candidates:
    """What is known of one camera: instances by image number, also empty lists, and notes."""

    by_image: dict[int, list[Instance]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def camera_file(folder: Path, camera: str) -> Path | None:
    """The file that holds all images of a camera, if there is one."""
    paths = (folder / f"{camera}.json", *(folder / camera / name for name in ALL_IMAGES))
    return next((path for path in paths if path.is_file()), None)


def image_files(folder: Path, camera: str) -> list[Path]:
    """The files that hold one image of a camera each."""
    below = folder / camera
    if camera_file(folder, camera) is not None or not below.is_dir():
        return []
    paths = (path for path in below.iterdir() if not path.name.startswith("."))
    return sorted(path for path in paths if path.suffix.lower() == ".json")


def has_candidates(folder: Path, camera: str, layout: str) -> bool:
    """Whether any file speaks of the camera."""
    if camera_file(folder, camera) is not None or image_files(folder, camera):
        return True
    if layout == "intercap":
        return release_masks(folder, camera) is not None
    return (folder / camera).is_dir() and bool(instance_masks(folder / camera))


def read_camera(
    folder: Path,
    images: CameraImages,
    *,
    layout: str,
    min_score: float,
    names: Mapping[int, str],
) -> Candidates:
    """Read all that ``folder`` holds of one camera. ``names`` are the classes by number."""
    found = Candidates()
    if not has_candidates(folder, images.name, layout):
        found.notes.append(f"no candidates {folder.name}/{images.name}.json")
        return found
    width, height = images.size
    path = camera_file(folder, images.name)
    if path is not None:
        try:
            content = candidates_of(
                read_json(path), width=width, height=height, min_score=min_score, names=names
            )
        except UnreadableCandidates as error:
            found.notes.append(f"{short(path)} {error}")
        else:
            _add_file(found, content, images, path)
    _add_image_files(found, image_files(folder, images.name), images, min_score, names)
    _add_masks_of_camera(found, folder, images, layout)
    return found


def _add_file(found: Candidates, content: CandidateFile, images: CameraImages, path: Path) -> None:
    """Sort one file's results by image."""
    useless = bool(content.entries) and len(content.faults) == content.entries
    by_image, absent = sorted_by_image(
        content.results, content.images, content.faulty, images, useless=useless
    )
    for place, instances in by_image.items():
        found.by_image.setdefault(place, []).extend(instances)
    if content.faults:
        first = "; ".join(content.faults[:FILES_NAMED])
        found.notes.append(
            f"{len(content.faults)} of {content.entries} results in {short(path)} left out: {first}"
        )
    if content.scaled:
        found.notes.append(f"{content.scaled} masks in {short(path)} scaled to the image's size")
    note_absent(found.notes, absent, images, short(path))


def sorted_by_image(
    results: list[tuple[ImageKey, Result]],
    spoken: list[ImageKey] | None,
    faulty: list[ImageKey],
    images: CameraImages,
    *,
    useless: bool,
) -> tuple[dict[int, list[Result]], list[str]]:
    """Results by image number, and what images are called that were not recorded.

    Images of which the file speaks, all where it does not say (``spoken`` None), have a list, maybe
    an empty one; those of entries that could not be used (``faulty``) only with results. A
    ``useless`` file, none of whose entries could be used, speaks of no image by itself.
    """
    keys = [*(key for key, _ in results), *faulty, *(spoken or ())]
    by_name = images.numbers_of_names(key.name for key in keys if key.name is not None)
    ids = {key.number for key in keys if key.number is not None}
    if len(images.recorded & ids) > len(images.recorded.intersection(by_name.values())):
        by_name = {}  # names that number something else, such as times

    def number(key: ImageKey) -> int | None:
        if key.name is not None and (by_name or key.number is None):
            return by_name.get(key.name)
        return key.number

    if useless and spoken is None:
        known: set[int] = set()  # nothing of it can be used, so it says nothing of other images
    elif spoken is None:
        known = set(images.recorded)
    else:
        known = {n for n in map(number, spoken) if n is not None}
    # An image whose results are all unusable is not one without instances.
    known -= {n for n in map(number, faulty) if n is not None}
    by_image: dict[int, list[Result]] = {n: [] for n in sorted(known & images.recorded)}
    absent = []
    for key, result in results:
        place = number(key)
        if place is not None and place in images.recorded:
            by_image.setdefault(place, []).append(result)
        else:
            absent.append(key.name if key.name is not None else str(key.number))
    return by_image, absent


def note_absent(notes: list[str], names: list[str], images: CameraImages, where: str) -> None:
    """Note results of images that were not recorded."""
    if not names:
        return
    has = f"images {min(images.recorded)} to {max(images.recorded)}" if images.recorded else "none"
    if images.stems:
        has += printable(f", {images.stems[0]} to {images.stems[-1]}")
    off_by_one = {str(max(images.recorded, default=-1) + 1)} == set(names)
    hint = "; image numbers count from 0" if off_by_one else ""
    notes.append(
        f"{len(names)} results in {where} are of images that the recording does not have (first: "
        f"{printable(names[0][:80])}; it has {has}){hint}"
    )


def _add_image_files(
    found: Candidates,
    paths: Iterable[Path],
    images: CameraImages,
    min_score: float,
    names: Mapping[int, str],
) -> None:
    """Read files that hold one image each, named after it."""
    by_name = {path.name: path for path in paths}
    numbers = images.numbers_of_names(by_name)
    absent, broken = [], []
    faults: list[str] = []
    scaled = entries = 0
    for name, path in by_name.items():
        place = numbers.get(name)
        if place is None or place not in images.recorded:
            absent.append(name)
            continue
        try:
            content = candidates_of(
                read_json(path),
                width=images.size[0],
                height=images.size[1],
                min_score=min_score,
                names=names,
                one_image=True,
            )
        except UnreadableCandidates as error:
            broken.append(f"{short(path)} {error}")
            continue
        if content.results or not content.entries:
            found.by_image.setdefault(place, []).extend(one for _, one in content.results)
        faults += [f"{printable(name)}, {fault}" for fault in content.faults]
        entries, scaled = entries + content.entries, scaled + content.scaled
    note_broken(found.notes, "candidates", broken)
    if faults:
        first = "; ".join(faults[:FILES_NAMED])
        found.notes.append(f"{len(faults)} of {entries} results left out: {first}")
    if scaled:
        found.notes.append(f"{scaled} masks scaled to the image's size")
    without = len(images.recorded) - len(by_name) + len(absent)
    if by_name and without > 0:
        found.notes.append(f"no file of candidates for {without} images")
    if absent:
        found.notes.append(
            f"{len(absent)} files of candidates belong to no image (first: "
            f"{printable(absent[0][:80])})"
        )


def _add_masks_of_camera(
    found: Candidates, folder: Path, images: CameraImages, layout: str
) -> None:
    if layout == "intercap":
        person = release_masks(folder, images.name)
        if person is None:
            return
        files = {number: [file] for number, file in person.items()}
    else:
        below = folder / images.name
        named = instance_masks(below) if below.is_dir() else {}
        if not named:
            return
        numbers = images.numbers_of_names(named)
        absent = [name for name in named if numbers.get(name) not in images.recorded]
        if absent:
            found.notes.append(
                f"masks of {len(absent)} images are named after no image (first: "
                f"{printable(absent[0][:80])})"
            )
        files = {numbers[name]: of for name, of in named.items() if name in numbers}
    held = [int(images.number[t]) for t in images.sets]
    add_masks(found, {number: files.get(number, []) for number in held}, images.size)


def add_masks(
    found: Candidates, files: Mapping[int, list[MaskFile]], size: tuple[int, int]
) -> None:
    """Read the mask images of each image; an empty mask is no candidate."""
    missing, broken = 0, []
    for number, mask_files in files.items():
        missing += not mask_files
        for file in mask_files:
            try:
                instances = read_masks(file, size)
            except UnreadableMask as error:
                broken.append(f"{short(file.path)} {error}")
                continue
            found.by_image.setdefault(number, []).extend(instances)
    if missing:
        found.notes.append(f"no mask for {missing} images")
    note_broken(found.notes, "masks", broken)


def short(path: Path) -> str:
    """The file's name with its folder's, which is a camera or a moment."""
    return printable(f"{path.parent.name}/{path.name}")


def note_broken(notes: list[str], what: str, broken: list[str]) -> None:
    """Note files that cannot be read, the first by name."""
    if broken:
        more = f" and {len(broken) - FILES_NAMED} more" if len(broken) > FILES_NAMED else ""
        notes.append(f"{what} not readable: {', '.join(broken[:FILES_NAMED])}{more}")


@dataclass
class Look:
    """What was seen of one camera: what is wrong, in words, and the labels."""

    notes: list[str] = field(default_factory=list)
    labels: set[str] = field(default_factory=set)


def look_at_candidates(
    folder: Path, camera: str, *, size: tuple[int, int], names: Mapping[int, str]
) -> Look:
    """Read the beginning of one camera's file, or its first file of one image.

    ``size`` (width, height) of the colour images; ``names`` are the classes by number. Masks as
    images are not looked at.
    """
    look = Look()
    whole = camera_file(folder, camera)
    path = whole if whole is not None else next(iter(image_files(folder, camera)), None)
    if path is None:
        return look
    try:
        content = read_head(path)
        if content is None:
            return look
        found = candidates_of(
            content,
            width=size[0],
            height=size[1],
            min_score=0.0,
            names=names,
            one_image=whole is None,
        )
    except UnreadableCandidates as error:
        look.notes.append(f"{path} {error}; the camera will count as without candidates")
        return look
    if found.faults:
        look.notes.append(
            f"{path}: {len(found.faults)} of its first {found.entries} results cannot be used "
            f"(first: {found.faults[0]})"
        )
    if found.scaled:
        look.notes.append(
            f"{path}: masks are of another resolution than the images of {size[0]}x{size[1]} and "
            "will be scaled"
        )
    look.labels = {instance.label for _, instance in found.results}
    return look
