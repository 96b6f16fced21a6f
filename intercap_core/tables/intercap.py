"""The tables of a project for the InterCap release."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.intercap import find_camera_folders, find_images
from intercap_core.inputs.documents import read_yaml
from intercap_core.shipped import shipped
from intercap_core.tables.intercap_annotations import Key, convert, find_annotation_folders
from intercap_core.tables.project_files import Draft, Row, Sources

OBJECTS = (
    "suitcase", "skateboard", "football", "umbrella", "tennis_racquet", "toolbox", "chair",
    "bottle", "cup", "stool",
)  # fmt: skip
MALE = (1, 2, 4, 5, 10)  # the release's own list; the others are female
CALIBRATIONS = ("first", "second", "third")
_NUMBER, _SEGMENT = re.compile(r"\d{1,2}"), re.compile(r"seg_?(\d{1,2})", re.IGNORECASE)


def is_release(root: Path) -> bool:
    """Whether the folder is a copy of the release, or its folder of images."""
    return (root / "RGBD_Images").is_dir() or bool(_sequence_folders(root))


def find_stated_calibration(subject: int, object_number: int) -> str | None:
    """The calibration that the release states for a subject and an object; None = not stated."""
    early = object_number <= 7  # the release states calibrations by ranges of subjects and objects
    if (subject <= 3 and early) or (subject == 4 and object_number <= 4):
        return "first"
    if (subject == 3 and not early) or (subject in (5, 6, 7) and early):
        return "third"
    return None if subject == 4 and early else "second"


def draft(root: Path, sources: Sources, *, dataset: str, objects: Path | None) -> Draft:
    """List the sequences of the release.

    Raises UserError if there are no sequences or no calibrations.

    Args:
        root: the folder ``RGBD_Images``, or the one that holds it.
        sources: the other folders of the release.
        objects: objects.yaml to use instead of the release's meshes; None = that of the package
            if there are no meshes.
    """
    images = root / "RGBD_Images" if (root / "RGBD_Images").is_dir() else root
    folders = _sequence_folders(images)
    if not folders:
        raise UserError(
            f"{root}: holds no RGBD_Images/<subject>/<object>/Seg_<k>; give the folder that the "
            "release was unpacked to"
        )
    calibrations = _calibrations(sources.calibrations, images)
    annotations_root = sources.annotations or _find_folder(images, "configs")
    annotated = find_annotation_folders(annotations_root) if annotations_root else {}
    meshes = None if objects else sources.meshes or _find_folder(images, "objs")
    result = Draft(dataset)
    for key, folder in folders.items():
        row = _row(key, folder, sources)
        numbers = _frame_numbers(folder)
        if not len(numbers):
            result.remarks.append(f"{row.columns['sequence']} has no images and is left out")
            continue
        row.columns["calibration"] = _calibration(key, folder, calibrations, row)
        _annotate(row, annotated.pop(key, []), numbers, result, with_pose=meshes is not None)
        result.subjects[f"s{key[0]:02d}"] = "male" if key[0] in MALE else "female"
        result.rows.append(row)
    objects = objects or shipped("config/objects.yaml")
    result.objects = _objects(folders, meshes, objects, result)
    if annotated:
        result.remarks.append(f"{len(annotated)} sequences of {annotations_root} have no images")
    if 9 in {key[0] for key in folders}:
        result.remarks.append("subject 09 is female in the release; another loader states male")
    return result


def _sequence_folders(images: Path) -> dict[Key, Path]:
    """Folders of images by subject, object and segment, sorted."""
    folders: dict[Key, Path] = {}
    for subject in _numbered_folders(images):
        for object_folder in _numbered_folders(subject):
            for path in sorted(p for p in object_folder.iterdir() if p.is_dir()):
                match = _SEGMENT.fullmatch(path.name)
                segment = int(match.group(1)) if match else -1
                key = int(subject.name), int(object_folder.name), segment
                if match and 1 <= key[1] <= len(OBJECTS):
                    folders.setdefault(key, path)
    return dict(sorted(folders.items()))


def _numbered_folders(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if _NUMBER.fullmatch(p.name) and p.is_dir())


def _find_folder(images: Path, name: str) -> Path | None:
    """The folder ``name`` at any of its usual places near the images; None if there is none."""
    near = ("", "Data", "obj_track", "..", "../Data", "../obj_track")
    places = (images / place / name for place in near)
    return next((place for place in places if place.is_dir()), None)


def _calibrations(given: Path | None, images: Path) -> dict[str, Path]:
    """The existing folders of calibrations by name: first, second, third."""
    names = {name: f"calibration_{name}" for name in CALIBRATIONS}
    if given is not None:
        folders = {name: given / folder for name, folder in names.items()}
    else:
        places = {name: _find_folder(images, folder) for name, folder in names.items()}
        folders = {name: place for name, place in places.items() if place is not None}
    folders = {name: folder for name, folder in folders.items() if folder.is_dir()}
    if not folders:
        raise UserError(
            f"{given or images}: holds no calibration_first, calibration_second or "
            "calibration_third; name the folder that does with --calibrations"
        )
    return folders


def _row(key: Key, folder: Path, sources: Sources) -> Row:
    """Row of a sequence, without calibration and annotation."""
    subject, number, segment = key
    name = f"s{subject:02d}_o{number:02d}_seg{segment}"
    columns: dict[str, str | Path] = {
        "sequence": name,
        "subject": f"s{subject:02d}",
        "object": OBJECTS[number - 1],
        "layout": "intercap",
        "recordings": folder,
    }
    usual = (
        name,
        f"{subject:02d}/{number:02d}/Seg_{segment}",
        f"subject{subject:02d}_motion{number:02d}_seg{segment}",
        f"subject{subject:02d}_motion{number:02d}_seg{segment:02d}",
    )
    for column in ("keypoints", "candidates", "results"):
        parent = getattr(sources, column)
        folders = [parent / place for place in usual] if parent is not None else []
        existing = next((folder for folder in folders if folder.is_dir()), None)
        if existing is not None:
            columns[column] = existing
    return Row(columns)


def _frame_numbers(folder: Path) -> np.ndarray:
    """Numbers (T,) of the frames of which any camera has a colour image, increasing."""
    numbers: set[int] = set()
    for camera in find_camera_folders(folder).values():
        try:
            numbers |= set(find_images(camera)[0])
        except UserError:
            continue  # the frames stage excludes this camera and notes the reason
    return np.array(sorted(numbers), np.int64)


def _calibration(key: Key, folder: Path, known: dict[str, Path], row: Row) -> Path:
    """The folder that the release states for a sequence, or else one that fits its depth."""
    stated = find_stated_calibration(*key[:2])
    if stated is not None:
        if stated not in known:
            raise UserError(
                f"{row.columns['sequence']} needs calibration_{stated}, found only "
                f"{', '.join(f'calibration_{name}' for name in known)}; name the folder that holds "
                "all three with --calibrations"
            )
        return known[stated]
    from intercap_core.tables.calibration_choice import choose_calibration

    entry = SequenceEntry(
        sequence=str(row.columns["sequence"]),
        subject=str(row.columns["subject"]),
        object=str(row.columns["object"]),
        layout="intercap",
        recordings=folder,
        calibration=folder,
    )
    best, residuals = choose_calibration(entry, known)
    measured = ", ".join(f"{n} {1000 * r:.1f} mm" for n, r in residuals.items())
    measured = f"residual of the background depth: {measured or 'not measured'}"
    # The unstated recordings lie between those of the first and those of the third calibration.
    name = best or ("third" if "third" in known else next(iter(known)))
    why = "the best" if best else "a guess, none is clearly the best"
    row.remarks.append(f"the release does not state this calibration; {name} is {why} ({measured})")
    return known[name]


def _annotate(
    row: Row,
    folders: list[Path],
    numbers: np.ndarray,
    result: Draft,
    *,
    with_pose: bool,
) -> None:
    """Convert a sequence's annotations; the row names the first, others become alternatives."""
    name = row.columns["sequence"]
    for index, folder in enumerate(folders):
        text, faults = convert(folder, numbers, with_pose=with_pose)
        row.remarks += [f"{folder.name}: {fault}" for fault in faults]
        if not text:
            continue
        if "annotation" not in row.columns:
            row.columns["annotation"] = f"annotations/{name}.yaml"
            result.annotations[f"{name}.yaml"] = text
            continue
        other = f"alternatives/{name}_{index}.yaml"
        result.annotations[other] = text
        row.remarks.append(f"{folder.name} annotates this sequence as well: annotations/{other}")


def _objects(
    folders: dict[Key, Path],
    meshes: Path | None,
    objects: Path,
    result: Draft,
) -> Path | dict[str, dict[str, Any]]:
    """Entries for the release's meshes, or the path of objects.yaml without meshes."""
    used = Counter(key[1] for key in folders)
    known = read_yaml(objects)
    known = known if isinstance(known, dict) else {}
    if meshes is None:
        result.remarks.append(
            f"objects are those of {objects}, not the release's own (--meshes); its first poses of "
            "objects refer to its own meshes and are left out"
        )
        return objects
    entries: dict[str, dict[str, Any]] = {}
    for number in sorted(used):
        name = OBJECTS[number - 1]
        files = [meshes / f"{number:02d}.{suffix}" for suffix in ("ply", "obj")]
        mesh = next((path for path in files if path.is_file()), None)
        if mesh is None:
            raise UserError(
                f"{files[0]}: there is no such mesh of object {name!r}; name the folder of the "
                "release's meshes with --meshes"
            )
        entry: dict[str, Any] = {"mesh": mesh}
        contact = meshes / f"{number:02d}.pkl"
        if contact.is_file():
            entry["contact_vertices"] = contact
        labels = (known.get(name) or {}).get("labels")
        entries[name] = entry | ({"labels": labels} if labels else {})
    result.remarks.append(
        "symmetries of the release's meshes are not known: add them to objects.yaml"
    )
    return entries
