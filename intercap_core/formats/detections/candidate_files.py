"""Files of segmentation candidates of one camera, sorted by image.

``<camera>.json`` holds all images (detectron2 and ultralytics use other names, in a folder
``<camera>/``); otherwise ``<camera>/<image>.json`` holds one image. Masks as image files in
``<camera>/`` are read in addition. Entries and files that cannot be used are noted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.formats.detections.coco import (
    CandidateFile,
    DetectionPreview,
    DetectionsByImage,
    UnreadableDetections,
    parse_candidates,
    read_first,
    read_head,
    read_json,
)
from intercap_core.formats.detections.image_numbers import (
    CameraImages,
    find_json_files,
    note_absent,
    note_broken,
    note_faults,
    note_unmatched,
    preview_names,
    refuse_both,
    short_name,
    sort_by_image,
)
from intercap_core.formats.detections.instance import (
    Instance,
    hint_on_size,
    notes_on_extent,
)
from intercap_core.formats.detections.mask_files import (
    MaskFile,
    find_instance_masks,
    find_release_masks,
    read_masks,
)
from intercap_core.formats.recordings.image_files import DamagedImage
from intercap_core.inputs.files import printable

CandidatesByImage = DetectionsByImage[list[Instance]]


def camera_file(folder: Path, camera: str) -> Path | None:
    """The file that holds all images of a camera, if there is one."""
    names = (
        f"{camera}.json",
        f"{camera}/coco_instances_results.json",  # detectron2
        f"{camera}/predictions.json",  # ultralytics
    )
    return next((folder / name for name in names if (folder / name).is_file()), None)


def image_files(folder: Path, camera: str) -> list[Path]:
    """The files that hold one image of a camera each."""
    return [] if camera_file(folder, camera) is not None else find_json_files(folder / camera)


def candidate_paths(folder: Path, camera: str, layout: str) -> list[Path]:
    """All files of a camera that are read."""
    whole = camera_file(folder, camera)
    paths = image_files(folder, camera) if whole is None else [whole]
    if layout == "intercap":
        return paths + [mask.path for mask in (find_release_masks(folder, camera) or {}).values()]
    masks = find_instance_masks(folder / camera) if (folder / camera).is_dir() else {}
    return paths + [mask.path for of_image in masks.values() for mask in of_image]


def holds_instances(folder: Path, camera: str, layout: str) -> bool:
    """Whether the first file of a camera lists results of instance segmentation, or is a mask."""
    path = camera_file(folder, camera) or next(iter(image_files(folder, camera)), None)
    if path is None:
        return bool(candidate_paths(folder, camera, layout))
    try:
        content = read_first(path)
        return bool(parse_candidates(content, (1, 1), {}).entries)
    except UnreadableDetections:
        return False


def read_camera(
    folder: Path,
    images: CameraImages,
    *,
    layout: str,
    min_score: float,
    names: Mapping[int, str],
) -> CandidatesByImage:
    """Read all candidates of one camera.

    Raises UserError if a camera has a file of all images and also files of single images.

    Args:
        layout: layout of the recordings.
        min_score: instances with a lower score are left out.
        names: classes by number, for files that do not list them.
    """
    candidates = CandidatesByImage()
    if not candidate_paths(folder, images.name, layout):
        candidates.notes.append(f"no candidates {folder.name}/{images.name}.json")
        return candidates
    parse = partial(parse_candidates, size=images.size, names=names, min_score=min_score)
    path = camera_file(folder, images.name)
    refuse_both(path, find_json_files(folder / images.name))
    if path is not None:
        try:
            content = parse(read_json(path))
        except UnreadableDetections as error:
            candidates.notes.append(f"{short_name(path)} {error}")
        else:
            _add_file(candidates, content, images, path)
    _add_image_files(candidates, image_files(folder, images.name), images, parse)
    _add_masks_of_camera(candidates, folder, images, layout)
    return candidates


def _add_file(
    candidates: CandidatesByImage, content: CandidateFile, images: CameraImages, path: Path
) -> None:
    """Sort one file's results by image."""
    by_image, absent, remark = sort_by_image(content, images)
    for place, instances in by_image.items():
        candidates.by_image.setdefault(place, []).extend(instances)
    name = short_name(path)
    note_faults(candidates.notes, f"of {content.entries} results in {name}", content.faults)
    candidates.notes += _notes_on_place([content], images.size, f" in {name}")
    if remark:
        candidates.notes.append(f"images of {name} are {remark}")
    note_absent(candidates.notes, absent, images, name)


def _add_image_files(
    candidates: CandidatesByImage,
    paths: Iterable[Path],
    images: CameraImages,
    parse: Callable[..., CandidateFile],
) -> None:
    """Read files that hold one image each, named after it."""
    by_name = {path.name: path for path in paths}
    numbers, remark = images.recognise_names(by_name)
    absent, broken = [], []
    faults: list[str] = []
    read: list[CandidateFile] = []
    for name, path in by_name.items():
        place = numbers.get(name)
        if place is None or place not in images.recorded:
            absent.append(name)
            continue
        try:
            content = parse(read_json(path), one_image=True)
        except UnreadableDetections as error:
            broken.append(f"{short_name(path)} {error}")
            continue
        # An image all of whose entries are faulty stays unknown instead of empty.
        if content.results or not content.entries:
            instances = [instance for _, instance in content.results]
            candidates.by_image.setdefault(place, []).extend(instances)
        faults += [f"{printable(name)}, {fault}" for fault in content.faults]
        read.append(content)
    note_broken(candidates.notes, "candidates", broken)
    note_faults(candidates.notes, f"of {sum(c.entries for c in read)} results", faults)
    candidates.notes += _notes_on_place(read, images.size)
    if remark:
        candidates.notes.append(f"files of candidates are {remark}")
    without = len(images.recorded) - len(by_name) + len(absent)
    if by_name and without > 0:
        candidates.notes.append(f"no file of candidates for {without} images")
    note_unmatched(candidates.notes, "files of candidates", absent)


def _notes_on_place(
    files: list[CandidateFile], size: tuple[int, int], where: str = ""
) -> list[str]:
    """Notes on masks that were scaled, and on probable masks of images of another size.

    ``where`` follows the word "masks" in the notes.
    """
    notes = []
    scaled, shares = sum(file.scaled for file in files), sum(file.shares for file in files)
    instances = [instance for file in files for _, instance in file.results]
    beyond, count = sum(file.beyond for file in files), len(instances)
    if scaled:
        notes.append(f"{scaled} masks{where} scaled to the image's size")
    if shares:
        notes.append(
            f"{shares} masks{where} are given as shares of the image's size and scaled to pixels"
        )
    if beyond:
        notes.append(
            f"{beyond} of {count} masks{where} reach beyond the image of {size[0]}x{size[1]} "
            f"pixels and are cut{hint_on_size(beyond, count)}"
        )
    extent = max((file.extent for file in files), default=0.0)
    return notes + notes_on_extent(f"masks{where}", extent, size)


def _add_masks_of_camera(
    candidates: CandidatesByImage, folder: Path, images: CameraImages, layout: str
) -> None:
    """Add masks from image files of the InterCap release, or of any detector."""
    if layout == "intercap":
        person = find_release_masks(folder, images.name)
        if person is None:
            return
        files = {number: [file] for number, file in person.items()}
    else:
        below = folder / images.name
        by_name = find_instance_masks(below) if below.is_dir() else {}
        if not by_name:
            return
        numbers, remark = images.recognise_names(by_name)
        if remark:
            candidates.notes.append(f"names of masks are {remark}")
        absent = [name for name in by_name if numbers.get(name) not in images.recorded]
        note_unmatched(candidates.notes, "names of masks", absent)
        files = {numbers[name]: masks for name, masks in by_name.items() if name in numbers}
    in_sets = [int(images.number[t]) for t in images.sets]
    add_masks(candidates, {number: files.get(number, []) for number in in_sets}, images.size)


def add_masks(
    candidates: CandidatesByImage, files: Mapping[int, list[MaskFile]], size: tuple[int, int]
) -> None:
    """Read the mask files of each image number; an empty mask is no candidate."""
    missing, broken = 0, []
    for number, mask_files in files.items():
        missing += not mask_files
        for file in mask_files:
            try:
                instances = read_masks(file, size)
            except DamagedImage as error:
                broken.append(f"{short_name(file.path)} {error}")
                continue
            candidates.by_image.setdefault(number, []).extend(instances)
    if missing:
        candidates.notes.append(f"no mask for {missing} images")
    note_broken(candidates.notes, "masks", broken)


def preview_candidates(
    folder: Path, images: CameraImages, *, names: Mapping[int, str]
) -> DetectionPreview:
    """Read the beginning of one camera's file, or the first of its files of one image.

    Masks as image files are not read. ``names``: classes by number.
    """
    preview = DetectionPreview()
    size = images.size
    whole = camera_file(folder, images.name)
    files = image_files(folder, images.name)
    try:
        refuse_both(whole, find_json_files(folder / images.name))
    except UserError as error:
        preview.faults.append(str(error))
        return preview
    preview_names(preview, folder / images.name, [path.name for path in files], images)
    path = whole if whole is not None else next(iter(files), None)
    if path is None:
        return preview
    try:
        content = read_head(path)
        if content is None:
            return preview
        parsed = parse_candidates(content, size, names, one_image=whole is None)
    except UnreadableDetections as error:
        preview.notes.append(f"{path} {error}; the camera will count as without candidates")
        return preview
    if parsed.faults:
        preview.notes.append(
            f"{path}: {len(parsed.faults)} of its first {parsed.entries} results cannot be used "
            f"(first: {parsed.faults[0]})"
        )
    if parsed.shares:
        preview.recognised.append("corners are shares of the image's size")
        parsed.shares = 0
    preview.notes += [f"{path}: {note}" for note in _notes_on_place([parsed], size)]
    preview.labels = {instance.label for _, instance in parsed.results}
    return preview
