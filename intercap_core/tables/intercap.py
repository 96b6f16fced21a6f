"""The tables of a project for the InterCap release."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.intercap import camera_folders, numbered_images
from intercap_core.inputs.documents import read_yaml
from intercap_core.tables.intercap_annotations import Key, annotation_folders, convert
from intercap_core.tables.project_files import Draft, Row

OBJECTS = (
    "suitcase", "skateboard", "football", "umbrella", "tennis_racquet", "toolbox", "chair",
    "bottle", "cup", "stool",
)  # fmt: skip
MALE = (1, 2, 4, 5, 10)  # the release's own list; the others are female
CALIBRATIONS = ("first", "second", "third")
# Where the release says nothing: between the recordings of the first calibration and those of the
# second lie those of the third.
UNSTATED = "third"
_NUMBER, _SEGMENT = re.compile(r"\d{1,2}"), re.compile(r"seg_?(\d{1,2})", re.IGNORECASE)
_BESIDE = ("", "Data", "obj_track", "..", "../Data", "../obj_track")  # of the images' folder


@dataclass(frozen=True)
class Sources:
    """Folders of the release beside the images; None = look for it, or do without.

    ``calibrations`` holds ``calibration_first``, ...; ``annotations`` a folder for each sequence;
    ``meshes`` ``01.ply``, ...; ``keypoints``, ``candidates`` and ``results`` (what the release
    itself found) a folder for each sequence.
    """

    calibrations: Path | None = None
    annotations: Path | None = None
    meshes: Path | None = None
    keypoints: Path | None = None
    candidates: Path | None = None
    results: Path | None = None


def stated_calibration(subject: int, thing: int) -> str | None:
    """Which calibration the release uses for a subject and an object; None = it does not say."""
    early = thing <= 7
    if (subject <= 3 and early) or (subject == 4 and thing <= 4):
        return "first"
    if (subject == 3 and not early) or (subject in (5, 6, 7) and early):
        return "third"
    return None if subject == 4 and early else "second"


def draft(root: Path, sources: Sources, *, dataset: str, objects: Path) -> Draft:
    """List the sequences below ``root``, which is or holds ``RGBD_Images``.

    ``objects`` is the objects.yaml to use where the release's meshes are not given. Raises
    UserError where there are no sequences, or no calibrations.
    """
    images = root / "RGBD_Images" if (root / "RGBD_Images").is_dir() else root
    folders = _sequence_folders(images)
    if not folders:
        raise UserError(
            f"{root}: holds no RGBD_Images/<subject>/<object>/Seg_<k>; give the folder that the "
            "release was unpacked to"
        )
    calibrations = _calibrations(sources.calibrations, images)
    annotations_root = sources.annotations or _beside(images, "configs")
    annotated = annotation_folders(annotations_root) if annotations_root else {}
    meshes = sources.meshes or _beside(images, "objs")
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
    result.objects = _objects(folders, meshes, objects, result)
    if annotated:
        result.remarks.append(f"{len(annotated)} sequences of {annotations_root} have no images")
    if 9 in {key[0] for key in folders}:
        result.remarks.append("subject 09 is female in the release; one loader of others says male")
    return result


def _sequence_folders(images: Path) -> dict[Key, Path]:
    found: dict[Key, Path] = {}
    for subject in _numbered_folders(images):
        for thing in _numbered_folders(subject):
            for path in sorted(p for p in thing.iterdir() if p.is_dir()):
                match = _SEGMENT.fullmatch(path.name)
                key = int(subject.name), int(thing.name), int(match.group(1)) if match else -1
                if match and 1 <= key[1] <= len(OBJECTS):
                    found.setdefault(key, path)
    return dict(sorted(found.items()))


def _numbered_folders(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if _NUMBER.fullmatch(p.name) and p.is_dir())


def _beside(images: Path, name: str) -> Path | None:
    places = (images / place / name for place in _BESIDE)
    return next((place for place in places if place.is_dir()), None)


def _calibrations(given: Path | None, images: Path) -> dict[str, Path]:
    names = {name: f"calibration_{name}" for name in CALIBRATIONS}
    if given is not None:
        found = {name: given / folder for name, folder in names.items()}
    else:
        places = {name: _beside(images, folder) for name, folder in names.items()}
        found = {name: place for name, place in places.items() if place is not None}
    found = {name: folder for name, folder in found.items() if folder.is_dir()}
    if not found:
        raise UserError(
            f"{given or images}: holds no calibration_first, calibration_second or "
            "calibration_third; name the folder that does with --calibrations"
        )
    return found


def _row(key: Key, folder: Path, sources: Sources) -> Row:
    subject, thing, segment = key
    name = f"s{subject:02d}_o{thing:02d}_seg{segment}"
    columns: dict[str, str | Path] = {
        "sequence": name,
        "subject": f"s{subject:02d}",
        "object": OBJECTS[thing - 1],
        "layout": "intercap",
        "recordings": folder,
    }
    usual = (
        name,
        f"{subject:02d}/{thing:02d}/Seg_{segment}",
        f"subject{subject:02d}_motion{thing:02d}_seg{segment}",
        f"subject{subject:02d}_motion{thing:02d}_seg{segment:02d}",
    )
    for column in ("keypoints", "candidates", "results"):
        above = getattr(sources, column)
        places = [above / place for place in usual] if above is not None else []
        there = next((place for place in places if place.is_dir()), None)
        if there is not None:
            columns[column] = there
    return Row(columns)


def _frame_numbers(folder: Path) -> np.ndarray:
    """Numbers (T,) of the frames of which some camera has a colour image, increasing."""
    numbers: set[int] = set()
    for camera in camera_folders(folder).values():
        try:
            numbers |= set(numbered_images(camera)[0])
        except UserError:
            continue  # the frames stage sets this camera aside, and says why
    return np.array(sorted(numbers), np.int64)


def _calibration(key: Key, folder: Path, known: dict[str, Path], row: Row) -> Path:
    stated = stated_calibration(*key[:2])
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
    choice = choose_calibration(entry, known)
    measured = ", ".join(f"{n} {1000 * r:.1f} mm" for n, r in choice.residual_m.items())
    measured = f"residual of the background depth: {measured or 'not measured'}"
    taken = choice.best or (UNSTATED if UNSTATED in known else next(iter(known)))
    why = "the best" if choice.best else "a guess, none is clearly the best"
    row.remarks.append(
        f"the release does not state this calibration; {taken} is {why} ({measured})"
    )
    return known[taken]


def _annotate(
    row: Row,
    folders: list[Path],
    numbers: np.ndarray,
    result: Draft,
    *,
    with_pose: bool,
) -> None:
    """Convert a sequence's annotations; the first is named in the row, others are put aside."""
    name = row.columns["sequence"]
    for index, folder in enumerate(folders):
        converted = convert(folder, numbers, with_pose=with_pose)
        row.remarks += [f"{folder.name}: {fault}" for fault in converted.faults]
        if not converted.text:
            continue
        if "annotation" not in row.columns:
            row.columns["annotation"] = f"annotations/{name}.yaml"
            result.annotations[f"{name}.yaml"] = converted.text
            continue
        other = f"alternatives/{name}_{index}.yaml"
        result.annotations[other] = converted.text
        row.remarks.append(f"{folder.name} annotates this sequence as well: annotations/{other}")


def _objects(
    folders: dict[Key, Path],
    meshes: Path | None,
    objects: Path,
    result: Draft,
) -> Path | dict[str, dict[str, Any]]:
    """Entries for the release's meshes, or the objects.yaml that is there."""
    used = Counter(key[1] for key in folders)
    known = read_yaml(objects) if objects.is_file() else {}
    known = known if isinstance(known, dict) else {}
    if meshes is None:
        if not objects.is_file():
            raise UserError(
                f"{objects}: there is no such file of objects; name one with --objects, or the "
                "release's meshes with --meshes"
            )
        result.remarks.append(
            f"objects are those of {objects}, not the release's own: name its meshes with --meshes "
            "(without them its first poses of objects do not hold and are left out)"
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
