"""What a row states of the cameras of a rig, and the calibration file that is made of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import Extrinsics, write_rig_file
from intercap_core.formats.calibration.opencv import read_content, states_lenses
from intercap_core.formats.recordings import k4a, plain
from intercap_core.formats.recordings.ros import layout as ros

_POSE_FIELDS = ("R", "T", "rvec", "tvec")
_LENS_FIELDS = ("camera_matrix", "distortion_coefficients")


@dataclass(frozen=True, eq=False)
class RigDraft:
    """What is known of the cameras before the calibration."""

    names: tuple[str, ...]
    """Names of the cameras by the recordings, the master first."""
    content: dict[str, Any] | None
    """Calibration in OpenCV's terms that the result completes; None if the recordings hold the
    lenses."""
    without_lens: frozenset[str]
    """Cameras whose lens is not stated."""


def draft_rig(row: SequenceEntry, lenses: Path | None, master: str | None) -> RigDraft:
    """Find the cameras of a row and their stated lenses.

    Raises UserError if the recordings have fewer than two cameras or lack the master, if the layout
    states poses, and if the file of lenses cannot be read.

    Args:
        lenses: calibration with lenses, with or without poses; None = ``calibration`` of the row if
            that file exists.
        master: name of the master; None = as the lenses' file states, else the first by name.
    """
    if not row.recordings.is_dir():
        raise UserError(
            f"{row.recordings}: sequence {row.sequence!r} has no such folder of recordings; "
            "correct 'recordings' in the table of sequences"
        )
    finders = {"k4a": k4a.find_cameras, "ros": ros.find_cameras, "plain": plain.find_cameras}
    if row.layout not in finders:
        raise UserError(
            f"sequence {row.sequence!r} has layout {row.layout}, whose release holds the cameras' "
            "poses; expected layout k4a, ros or plain"
        )
    names = finders[row.layout](row.recordings)
    if not names:
        raise UserError(
            f"{row.recordings}: holds no recording of layout {row.layout}; correct 'recordings' or "
            "'layout' in the table of sequences"
        )
    if len(names) < 2:
        raise UserError(
            f"{row.recordings}: holds recordings of camera {names[0]!r} only, expected two cameras "
            "or more; one camera needs no poses: write its lens with R and T zero"
        )
    source = lenses or (row.calibration if row.calibration.exists() else None)
    is_plain = row.layout == "plain"
    # Bags without CameraInfo need a stated lens; all other recordings hold the lenses.
    if not is_plain and (row.layout == "k4a" or source is None or not states_lenses(source)):
        return RigDraft(_ordered(names, master, row.recordings), None, frozenset())
    content = _read_lenses(source)
    entries = {name: dict(content["cameras"].get(name) or {}) for name in names}
    first = master or content.get("master")
    names = list(_ordered(names, None if first is None else str(first), row.recordings))
    for name, entry in entries.items():
        for field in _POSE_FIELDS:
            entry.pop(field, None)
        if "image_width" in entry and "image_height" in entry:
            entry["image_size"] = [entry.pop("image_width"), entry.pop("image_height")]
        if "image_size" not in entry and is_plain:
            entry["image_size"] = _image_size(row.recordings, name)
    without = frozenset(n for n in names if any(f not in entries[n] for f in _LENS_FIELDS))
    content |= {"master": names[0], "cameras": {name: entries[name] for name in names}}
    return RigDraft(tuple(names), content, without)


def _read_lenses(source: Path | None) -> dict[str, Any]:
    """Content of a calibration file in OpenCV's terms, or of a folder with a file per camera."""
    if source is None:
        return {"cameras": {}}
    content = read_content(source)
    if not isinstance(content.get("cameras"), dict):
        raise UserError(
            f"{source}: expected 'cameras' with a lens for each; docs/recordings.md shows one"
        )
    return dict(content)


def _ordered(names: Sequence[str], master: str | None, folder: Path) -> tuple[str, ...]:
    if master is not None and master not in names:
        raise UserError(
            f"{folder}: holds no camera {master!r}, which is to be the master; expected one of "
            f"{', '.join(names)}"
        )
    first = master or names[0]
    return (first, *(name for name in names if name != first))


def _image_size(recordings: Path, name: str) -> list[int]:
    from intercap_core.formats.recordings.image_files import find_size
    from intercap_core.formats.recordings.video import read_video_size

    images = plain.find_images(recordings).get(name)
    size = find_size(images[:1]) if images else None
    for path in recordings.iterdir():
        if path.stem == name and path.suffix.lower() in plain.VIDEO_SUFFIXES:
            size = size or read_video_size(path)
    if size is None:
        raise UserError(f"{recordings}: camera {name} has no readable image; expected one")
    return list(size)


def posed_content(draft: RigDraft, poses: np.ndarray) -> dict[str, Any]:
    """The draft's calibration with poses (C, 4, 4) master_from_colour."""
    assert draft.content is not None
    entries = {}
    for name, pose in zip(draft.names, poses, strict=True):
        entry = dict(draft.content["cameras"][name])
        if name in draft.without_lens and "camera_matrix" not in entry:
            width, height = entry["image_size"]
            focal = 0.9 * max(width, height)  # 58 degrees wide, until the board is seen
            matrix = [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]
            entry |= {"camera_matrix": matrix, "distortion_coefficients": [0.0] * 5}
        rotation = pose[:3, :3].T
        entry |= {"R": rotation.tolist(), "T": (-rotation @ pose[:3, 3]).tolist()}
        entries[name] = entry
    return draft.content | {"cameras": entries}


def write_calibration(path: Path, draft: RigDraft, poses: np.ndarray) -> None:
    """Write poses (C, 4, 4) as a rig file, or with the lenses as a file in OpenCV's terms."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if draft.content is None:
        by_name = dict(zip(draft.names, poses, strict=True))
        write_rig_file(path, Extrinsics(draft.names[0], by_name))
    else:
        path.write_text(json.dumps(posed_content(draft, poses), indent=1) + "\n", encoding="utf-8")
