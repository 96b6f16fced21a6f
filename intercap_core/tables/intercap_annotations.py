"""The InterCap release's annotations: intervals of contact, and the object's first pose.

Each sequence has a folder ``subject<s>_motion<o>_seg<k>`` with ``contact.txt`` and ``config.ini``;
the number after "motion" is the object's. There are more folders than sequences.
"""

from __future__ import annotations

import configparser
import re
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from intercap_core.annotation import ANY_REGION, Annotation
from intercap_core.inputs.documents import dump_yaml, parse_integer
from intercap_core.inputs.files import UnreadableFile, read_text
from intercap_core.validation import list_faults

FOLDER = re.compile(
    r"subject(\d{1,2})_(?:motion|object)(\d{1,2})_seg_?(\d{1,2})([A-Za-z0-9_-]*)", re.IGNORECASE
)
Key = tuple[int, int, int]  # subject, object, segment


def find_annotation_folders(root: Path) -> dict[Key, list[Path]]:
    """Folders by sequence; those whose name ends with the segment come first, then by name."""
    folders: dict[Key, list[tuple[str, Path]]] = {}
    for path in sorted(root.iterdir()):
        match = FOLDER.fullmatch(path.name)
        if match and path.is_dir():
            subject, number, segment = (int(text) for text in match.groups()[:3])
            folders.setdefault((subject, number, segment), []).append((match.group(4), path))
    return {key: [path for _, path in sorted(paths)] for key, paths in folders.items()}


def convert(folder: Path, numbers: np.ndarray, *, with_pose: bool) -> tuple[str, list[str]]:
    """Convert a folder's files to an annotation of the frame sets of one recording.

    Returns the annotation as YAML, "" if nothing can be used, and the parts that cannot be read and
    are left out, with the reason.

    Args:
        folder: folder of one sequence.
        numbers: (T,) increasing numbers of the frames that any camera has. Frame set t is frame
            ``numbers[t]``.
        with_pose: convert the object's first pose, which applies to the release's mesh only.
    """
    faults: list[str] = []
    sections: dict[str, Any] = {}
    contact = _contact(folder / "contact.txt", numbers, faults)
    if contact is not None:
        sections["contact"] = contact
    pose = _object_pose(folder / "config.ini", numbers, faults) if with_pose else None
    if pose is not None:
        sections["object_pose"] = pose
    try:
        Annotation.model_validate(sections)
    except ValidationError as error:
        field, text = list_faults(error, Annotation, "entry")[0]
        faults.append(f"{field}: {text}")
        sections.pop(field.partition(".")[0], None)
    if not sections:
        return "", faults
    head = f"# From {folder.name} of the release. Frames are frame sets, from 0.\n"
    return head + dump_yaml(sections), faults


def _contact(
    path: Path,
    numbers: np.ndarray,
    faults: list[str],
) -> list[dict[str, str | int]] | None:
    """Intervals of contact: lines alternate between first frame, from 1, and last frame.

    None if there are none: an empty file does not mean that there is no contact.
    """
    if not path.is_file():
        return None
    try:
        values = [parse_integer(word) for word in read_text(path).split()]
    except (UnreadableFile, ValueError):
        faults.append("contact.txt is not a list of frame numbers")
        return None
    if len(values) % 2:
        faults.append(f"contact.txt has {len(values)} numbers, the last start has no end")
        values.pop()
    intervals: list[dict[str, str | int]] = []
    for first, end in zip(values[::2], values[1::2], strict=True):
        start = first - 1  # counted from 1; the last frame from 1 is the exclusive end from 0
        if start < 0 or end <= start:
            faults.append(f"contact.txt: {first} to {end} is no interval")
            continue
        sets = [int(t) for t in np.searchsorted(numbers, (start, end))]
        if sets[0] == sets[1]:
            faults.append(f"contact.txt: no image from {first} to {end}")
            continue
        intervals.append(
            {"part": ANY_REGION, "start": sets[0], "end": sets[1], "uncertain": "both"}
        )
    return intervals or None


def _object_pose(path: Path, numbers: np.ndarray, faults: list[str]) -> dict[str, Any] | None:
    """The object's pose in the frame from which the release's tracker starts; None without one."""
    if not path.is_file():
        return None
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(read_text(path))
        translation, rotation = (
            [float(word) for word in parser[section][key].split()]
            for section, key in (("init_trans", "trans"), ("init_rot", "rot"))
        )
        frame = parse_integer(parser["init_frame_id"]["id"])
        if len(translation) != 3 or len(rotation) != 3:
            raise ValueError
    except (UnreadableFile, ValueError, KeyError, configparser.Error):
        faults.append(
            "config.ini has no [init_trans] trans, [init_rot] rot (three numbers each) and "
            "[init_frame_id] id"
        )
        return None
    at = int(np.searchsorted(numbers, frame))
    # If an image is missing, the release's tools use one of the next two.
    if frame < 0 or at == len(numbers) or numbers[at] > frame + 2:
        faults.append(f"config.ini gives the object's pose in frame {frame}, which has no image")
        return None
    return {"frame": at, "rotation_vector": rotation, "translation": translation}
