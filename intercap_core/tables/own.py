"""The tables of a project for own recordings, recognised in a folder and the folders below it."""

from __future__ import annotations

import contextlib
import itertools
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from intercap_core import artefacts
from intercap_core.config_types import RESERVED_OBJECTS, RESERVED_SEQUENCES, LayoutName
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.files import calibration_readers
from intercap_core.formats.detections.candidate_files import holds_instances
from intercap_core.formats.detections.keypoint_files import holds_people
from intercap_core.formats.detections.mask_files import is_mask
from intercap_core.formats.recordings.layouts import open_layout, recognise_recordings
from intercap_core.formats.recordings.plain import IMAGE_SUFFIXES, find_images
from intercap_core.geometry.rigid.mesh_files import SUFFIXES as MESH_SUFFIXES
from intercap_core.inputs.documents import read_yaml
from intercap_core.schemas import TRUTH
from intercap_core.tables.project_files import Draft, Row, Sources

FILL_IN = "FILL IN:"
"""Begins a comment about an entry that the recordings do not state."""
SUBJECT = "s01"
"""Subject of sequences whose names state none."""
DEEPEST = 3  # levels of folders that are searched below a given one
# Folders of detections and of results may hold images, which are no recordings.
NO_RECORDINGS = frozenset({"keypoints", "candidates", "masks", "results", "logs", "benchmarks"})
CALIBRATION_SUFFIXES = frozenset({".json", ".yaml", ".yml", ".toml", ".txt"})
MOST_FILES = 40  # in a folder with a calibration: one or two files for each of 16 cameras
_SUBJECT = re.compile(r"(?:^|[_-])((?:s|sub|subject|p)\d{1,4})(?=$|[_-])", re.IGNORECASE)


@dataclass(frozen=True)
class Recording:
    """Recordings of one sequence."""

    folder: Path
    layout: LayoutName
    cameras: list[str]
    """Names of the cameras."""
    home: Path = Path()
    """Highest folder that holds these recordings alone."""

    def entry(self, calibration: Path) -> SequenceEntry:
        """The row of the table of sequences, as far as it is needed to open the recordings."""
        return SequenceEntry(
            sequence="s", subject="s", recordings=self.folder, layout=self.layout,
            calibration=calibration,
        )  # fmt: skip

    def holds_masks(self) -> bool:
        """Whether the images of all cameras are masks, by one image of each camera."""
        if self.layout != "plain":
            return False
        images = [files[len(files) // 2] for files in find_images(self.folder).values()]
        return bool(images) and all(map(is_mask, images))


def draft(root: Path, sources: Sources, *, dataset: str, objects: Path | None) -> Draft:
    """List the recordings in ``root`` with their calibrations, detections and objects.

    Raises UserError if there are no recordings.

    Args:
        root: folder of recordings.
        sources: folders of keypoints, candidates and meshes outside of ``root``.
        objects: objects.yaml to use; None = found in ``root``, or written for its meshes.
    """
    found = list(find_recordings(root))
    masks = [recording.folder for recording in found if recording.holds_masks()]
    masks = masks if len(masks) < len(found) else []
    recordings = [recording for recording in found if recording.folder not in masks]
    if not recordings:
        raise UserError(
            f"{root}: holds no recordings that are recognised; expected Azure Kinect files, "
            "bags of ROS, a folder of images or a video for each of two or more cameras, or the "
            "folders of the InterCap or BEHAVE release (docs/recordings.md)"
        )
    result = Draft(dataset)
    used = frozenset(recording.folder for recording in recordings)
    result.objects = objects or _objects(sources.meshes or root, used, result.remarks)
    if not _names(result.objects):
        result.remarks.append(
            f"{FILL_IN} no mesh ({', '.join(MESH_SUFFIXES)}) is found, so only the person is "
            "fitted; add the objects to objects.yaml and to the column object"
        )
    result.subject_remarks.append(
        f"{FILL_IN} gender (female, male or neutral) and height without shoes in metres (empty = "
        "unknown)"
    )
    held = Counter(place for folder in used for place in _near(root, folder))
    for recording in recordings:
        home = [place for place in _near(root, recording.folder) if held[place] == 1][-1]
        result.rows.append(_row(root, replace(recording, home=home), used, sources))
    _name_rows(result, [recording.folder.relative_to(root) for recording in recordings], root)
    result.remarks += [
        f"{folder}: holds masks, which no sequence uses; name it in the column candidates"
        for folder in masks
        if all(folder != row.columns.get("candidates") for row in result.rows)
    ]
    return result


def _name_rows(draft: Draft, folders: list[Path], root: Path) -> None:
    """Name the sequences, their subjects and their objects after their folders below ``root``.

    A last folder that all sequences have, such as ``recordings``, is left out of their names.
    """
    objects, taken = _names(draft.objects), set(RESERVED_SEQUENCES)
    unknown: list[str] = []
    names = {folder.name for folder in folders}
    is_common = len(folders) > 1 == len(names) and not _find_object(folders[0].name, objects)
    drops_last = is_common and all(len(folder.parts) > 1 for folder in folders)
    for row, folder in zip(draft.rows, folders, strict=True):
        parts = folder.parts or (root.resolve().name,)
        usual = clean_name("_".join(parts[:-1] if drops_last else parts))
        name = _unique_name([usual], taken)
        if name != usual:
            row.remarks.append(f"{usual} is the name of another sequence or of a folder of results")
        text = clean_name("_".join(parts))
        stated = _SUBJECT.search(text)
        subject = stated[1].lower() if stated else SUBJECT
        row.columns |= {"sequence": name, "subject": subject}
        _add_object(row, text, objects)
        draft.subjects[subject] = "neutral"
        unknown += [] if stated else [name]
    if unknown:
        draft.subject_remarks.append(
            f"{FILL_IN} the names of {len(unknown)} of {len(folders)} sequences (first: "
            f"{unknown[0]}) state no subject such as s02, so their subject is {SUBJECT}; add a row "
            "for each person, and name it in the column subject of sequences.tsv"
        )


def clean_name(text: str) -> str:
    """The text as the name of a sequence, object or dataset."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", text).lstrip("-")[:80] or "recording"


def _unique_name(names: Sequence[str], taken: set[str]) -> str:
    """The first name that is not taken, or the last one with a number; adds it to ``taken``."""
    numbered = (f"{names[-1][:76]}_{number}" for number in itertools.count(2))
    found = next(name for name in itertools.chain(names, numbered) if name not in taken)
    taken.add(found)
    return found


def find_recordings(folder: Path, depth: int = DEEPEST) -> Iterator[Recording]:
    """Recordings in a folder, or else in the folders below it."""
    found = recognise_recordings(folder)
    if found is not None:
        yield Recording(folder, *found)
    elif depth:
        for path in _folders(folder):
            if path.name not in NO_RECORDINGS:
                yield from find_recordings(path, depth - 1)


def _folders(folder: Path) -> list[Path]:
    """Folders in a folder without hidden ones, sorted; [] if it cannot be read."""
    try:
        return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    except OSError:
        return []


def _row(root: Path, recording: Recording, used: frozenset[Path], sources: Sources) -> Row:
    """Row of a sequence, without its name, object and subject."""
    folder = recording.folder
    row = Row({"layout": recording.layout, "recordings": folder}, cameras=recording.cameras)
    row.columns["calibration"] = _find_calibration(row, root, recording, used)
    for kind in ("keypoints", "candidates"):
        found = _find_detections(kind, root, recording, used, getattr(sources, kind))
        if found is not None:
            row.columns[kind] = found
    truth = folder / "truth.h5"
    with contextlib.suppress(artefacts.Unreadable), artefacts.read(truth, TRUTH):
        row.columns["truth"] = truth
    return row


def _near(root: Path, folder: Path) -> list[Path]:
    """The folder and those above it, up to ``root``."""
    return [folder, *(path for path in folder.parents if path.is_relative_to(root))]


def _find_calibration(row: Row, root: Path, recording: Recording, used: frozenset[Path]) -> Path:
    """The nearest calibration that can be read, the one with most of the cameras.

    Without one, the path of a calibration that lacks something, or that of a missing file, with a
    remark.
    """
    faulty: dict[Path, UserError] = {}
    for place in _near(root, recording.folder):
        posed: dict[Path, int] = {}
        for path in _possible_calibrations(place, used):
            try:
                poses = open_layout(recording.entry(path)).extrinsics.master_from_colour
            except UserError as error:
                if any(reader.recognises(path) for reader in calibration_readers()):
                    faulty[path] = error
                continue
            posed[path] = len(set(poses) & set(recording.cameras))
        best = max(posed, key=lambda path: posed[path], default=None)
        if best is not None and posed[best]:
            return best
    for path, fault in faulty.items():
        row.remarks.append(f"{FILL_IN} {fault}")
        return path
    row.remarks.append(
        f"{FILL_IN} no calibration of {', '.join(recording.cameras)} is found in the folder of the "
        "recordings or above; name it in the column calibration (docs/recordings.md), or find it "
        "by intercap calibrate"
    )
    return recording.folder / "calibration.json"


def _possible_calibrations(place: Path, used: frozenset[Path], depth: int = DEEPEST) -> list[Path]:
    """Files in ``place``, the folder itself and those below, except folders of images."""
    files = [p for p in place.iterdir() if p.suffix.lower() in CALIBRATION_SUFFIXES]
    if len(files) > MOST_FILES:
        return []
    below = [
        path
        for folder in (_folders(place) if depth else ())
        if folder not in used
        and folder.name not in NO_RECORDINGS
        and not any(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir())
        for path in _possible_calibrations(folder, used, depth - 1)
    ]
    return [*sorted(files), place, *below]


def _find_detections(
    kind: str, root: Path, recording: Recording, used: frozenset[Path], given: Path | None
) -> Path | None:
    """The nearest folder with keypoints or candidates of one of the cameras, None if there is none.

    It lies in a folder that holds these recordings alone, or in a folder above or in ``given``,
    where it has the path of the recordings or of their home.
    """
    folder, home = recording.folder, recording.home
    places: list[Path] = []
    for near in _near(root, folder):
        below = [path for path in _folders(near) if path not in used]
        below.sort(key=lambda path: path.name != kind)
        places += [path / folder.relative_to(near) for path in below]
        is_alone = near.is_relative_to(home)
        places += below if is_alone else [path / home.relative_to(near) for path in below]
    if given is not None:
        own = folder.relative_to(root), home.relative_to(root)
        places = [given / own[0], given / folder.name, given / own[1], *places]

    def holds_keypoints(place: Path) -> bool:
        return any(holds_people(place, camera) for camera in recording.cameras)

    def holds_candidates(place: Path) -> bool:
        return any(
            holds_instances(place, camera, recording.layout) for camera in recording.cameras
        ) and not holds_keypoints(place)

    holds = {"keypoints": holds_keypoints, "candidates": holds_candidates}[kind]
    return next((place for place in places if place.is_dir() and holds(place)), None)


def _objects(
    folder: Path, used: frozenset[Path], remarks: list[str]
) -> Path | dict[str, dict[str, Any]]:
    """Path of the first objects.yaml in ``folder``, or entries for the meshes in it.

    Adds a remark for each mesh whose file name is taken.
    """
    files = list(_files(folder, used))
    for path in files:
        if path.name == "objects.yaml":
            return path
    entries: dict[str, dict[str, Any]] = {}
    taken = set(RESERVED_OBJECTS)
    for path in files:
        if path.suffix.lower() in MESH_SUFFIXES:
            usual = re.sub(r"^\d+[_-](?=.)", "", clean_name(path.stem))
            name = _unique_name([usual, clean_name(f"{path.parent.name}_{usual}")], taken)
            entries[name] = {"mesh": path}
            if name != usual:
                of = entries[usual]["mesh"] if usual in entries else "people in detections"
                remarks.append(
                    f"{FILL_IN} {path} is object {name}, because {usual} is the name of {of}; "
                    "remove the mesh that is not used from objects.yaml, or rename its entry"
                )
    return entries


def _files(folder: Path, used: frozenset[Path], depth: int = DEEPEST) -> Iterator[Path]:
    """Files in a folder and below it, except in folders of recordings and detections."""
    yield from sorted(path for path in folder.iterdir() if path.is_file())
    for path in _folders(folder) if depth else ():
        if path not in used and path.name not in NO_RECORDINGS:
            yield from _files(path, used, depth - 1)


def _names(objects: Path | dict[str, dict[str, Any]]) -> list[str]:
    """Names of the objects, the longest first."""
    values = read_yaml(objects) if isinstance(objects, Path) else objects
    return sorted(values, key=len, reverse=True) if isinstance(values, dict) else []


def _find_object(text: str, names: list[str]) -> str | None:
    """The first object whose name is a part of the text."""
    return next(
        (n for n in names if re.search(rf"(^|[_-]){re.escape(n)}($|[_-])", text, re.IGNORECASE)),
        None,
    )


def _add_object(row: Row, text: str, names: list[str]) -> None:
    """Name the object that the text contains, or else the only one."""
    found = names[0] if len(names) == 1 else _find_object(text, names)
    if found is not None:
        row.columns["object"] = found
    elif names:
        row.remarks.append(
            f"{FILL_IN} the name of the sequence contains no object; write one of "
            f"{', '.join(sorted(names))} into the column object, or none for a person alone"
        )
