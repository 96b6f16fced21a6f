"""The layouts of recordings by the name that the table of sequences gives them."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

from intercap_core.config_types import LayoutName
from intercap_core.entries import SequenceEntry
from intercap_core.errors import MissingPackage, UserError
from intercap_core.formats.calibration.extrinsics import CAMERA_NAME
from intercap_core.formats.calibration.files import refuse_scale
from intercap_core.formats.recordings.source import RecordingLayout
from intercap_core.inputs.files import describe_unread

# Patterns of the files and folders that the workflow watches, below the folder of recordings ("" =
# that folder). A folder stands for all files below it.
INPUTS: dict[LayoutName, tuple[str, ...]] = {
    "k4a": ("*.[mM][kK][vV]",),
    "ros": (
        *("*.bag", "*.bag.active", "*.mcap", "*.db3", "metadata.yaml"),
        *("*/*.mcap", "*/*.db3", "*/metadata.yaml"),
    ),
    "intercap": ("[fF][rR][aA][mM][eE][sS]_[cC][aA][mM]*/*",),
    "behave": ("",),
    "plain": (
        "*",
        "*/[cC][oO][lL][oO][rR]",
        "*/[cC][oO][lL][oO][uU][rR]",
        "*/[rR][gG][bB]",
        "*/[dD][eE][pP][tT][hH]",
    ),
}
# Suffixes of other files in such a folder, such as the studio's truth.
_NO_RECORDINGS = {".h5", ".json", ".yaml", ".yml", ".toml", ".txt", ".tsv", ".part"}
_DEEPEST = 3  # levels of folders below the recordings that are searched
# Paths below the folder of recordings that the layouts read, and their description. A folder whose
# path with "/" matches is read as a whole. Names in braces are those of :func:`list_unread`.
_READ: dict[LayoutName, tuple[str, str]] = {
    "k4a": (r"[^/]+\.mkv", "<camera>.mkv"),
    "ros": (
        r"[^/]+\.bag(\.active)?|([^/]+/)?[^/]+\.(mcap|db3)",
        "<camera>.bag (.mcap, .db3), a bag of several cameras, or bag folders of ROS 2",
    ),
    "intercap": (
        r"frames_cam\d{1,2}/(colou?r/\D*\d{1,9}\.(jpe?g|png)|depth[^/]*/\D*\d{1,9}\.png)",
        "Frames_Cam<n>/color/<number>.jpg (or .png) and depth/<number>.png",
    ),
    "behave": (  # the data set's other files, and its folders of fits, are left aside
        r"(?-i:t)\d{1,6}(\.\d{1,6})?/"
        r"(k\d{1,2}\.(color\.(jpe?g|png)|depth\.png)|(?!k\d{1,2}\.(color|depth)\.).+)",
        "t<seconds>/k<n>.color.jpg (or .png) and k<n>.depth.png",
    ),
    "plain": (
        r"{camera}(?-i:_timestamps){times}|{camera}(?-i:/timestamps){times}|{camera}{video}|"
        r"{camera}/({colour}/)?[^/]+{image}|{camera}/depth/[^/]+{depth}",
        "<camera>.mp4 (.mov, .mkv, .avi, ...), or <camera>/ with .jpg, .png, .bmp or .tif, and "
        "<camera>/depth/ with 16-bit .png or .tif; a camera's name has letters, digits, '_' and "
        "'-' alone",
    ),
}


def list_unread(sequence: SequenceEntry) -> list[str]:
    """Notes on files in the folder of recordings that the layout does not read.

    Files with suffixes of text and data, unless they are named after times, and hidden ones are
    left out, as are folders that other columns of the row name.
    """
    from intercap_core.formats.recordings import plain, timestamps

    pattern, expected = _READ[sequence.layout]
    for name, texts in (
        ("times", timestamps.SUFFIXES),
        ("video", plain.VIDEO_SUFFIXES),
        ("image", plain.IMAGE_SUFFIXES),
        ("depth", plain.DEPTH_SUFFIXES),
        ("colour", plain.COLOUR_FOLDERS),
    ):
        pattern = pattern.replace(f"{{{name}}}", f"({'|'.join(map(re.escape, texts))})")
    pattern = pattern.replace("{camera}", CAMERA_NAME.pattern)
    is_read = re.compile(pattern, re.IGNORECASE)
    named = {sequence.keypoints, sequence.candidates, sequence.results, sequence.calibration}
    unread = []
    for folder, below, names in os.walk(sequence.recordings, followlinks=True):
        relative = Path(folder).relative_to(sequence.recordings)
        place = "" if relative == Path() else f"{relative.as_posix()}/"
        below[:] = [
            name
            for name in sorted(below)
            if not name.startswith(".")
            and Path(folder, name) not in named
            and len(relative.parts) < _DEEPEST
            and not is_read.fullmatch(f"{place}{name}/")
        ]
        unread += [
            Path(folder, name)
            for name in sorted(names)
            if not name.startswith(".")
            and (Path(name).suffix.lower() not in _NO_RECORDINGS or "time" in name.lower())
            and not is_read.fullmatch(f"{place}{name}")
        ]
    advice = f"layout {sequence.layout} reads {expected}; rename, move or convert them"
    return describe_unread(sequence.recordings, unread, advice)


def input_files(sequence: SequenceEntry) -> list[Path]:
    """Files and folders whose change makes the frames stale; [] without recordings."""
    folder = sequence.recordings
    if not folder.is_dir():
        return []
    return sorted(
        {
            path
            for pattern in INPUTS[sequence.layout]
            for path in (folder.glob(pattern) if pattern else [folder])
            if not path.name.startswith(".")
            and (
                path.suffix.lower() not in _NO_RECORDINGS
                or path.stem.endswith(("timestamps", "metadata"))
            )
        }
    )


def recognise_recordings(folder: Path) -> tuple[LayoutName, list[str]] | None:
    """The layout of the recordings in a folder, and the names of their cameras; None without any.

    Folders of images and videos are recordings only if there are two of them or more. Raises
    UserError for bags of ROS if the package that reads them is missing.
    """
    from intercap_core.formats.recordings import behave, intercap, k4a, plain
    from intercap_core.formats.recordings.ros import layout as ros

    finders: dict[LayoutName, Callable[[Path], list[str]]] = {
        "intercap": lambda path: list(intercap.find_camera_folders(path)),
        "behave": behave.find_cameras,
        "k4a": k4a.find_cameras,
        "ros": ros.find_cameras,
        "plain": plain.find_cameras,
    }
    for layout, find_cameras in finders.items():
        try:
            cameras = find_cameras(folder)
        except MissingPackage:
            raise
        except UserError:
            continue
        if len(cameras) > (1 if layout == "plain" else 0):
            return layout, cameras
    return None


def open_layout(sequence: SequenceEntry) -> RecordingLayout:
    """Open the recordings of one sequence in the layout of its row.

    Raises UserError if the folder does not exist, and as the layout does.
    """
    if not sequence.recordings.is_dir():
        raise UserError(
            f"{sequence.recordings}: sequence {sequence.sequence!r} has no such folder of "
            "recordings; correct 'recordings' in the table of sequences"
        )
    if sequence.layout in ("intercap", "behave"):
        refuse_scale(sequence.calibration, sequence.calibration_scale)
    # Imported here, so that each process loads only the libraries of its layout.
    match sequence.layout:
        case "k4a":
            from intercap_core.formats.recordings.k4a import KinectLayout

            return KinectLayout(sequence)
        case "ros":
            from intercap_core.formats.recordings.ros.layout import RosLayout

            return RosLayout(sequence)
        case "intercap":
            from intercap_core.formats.recordings.intercap import InterCapLayout

            return InterCapLayout(sequence)
        case "behave":
            from intercap_core.formats.recordings.behave import BehaveLayout

            return BehaveLayout(sequence)
        case "plain":
            from intercap_core.formats.recordings.plain import PlainLayout

            return PlainLayout(sequence)
