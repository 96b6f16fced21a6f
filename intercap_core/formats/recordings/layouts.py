"""The layouts of recordings by the name that the table of sequences gives them."""

from __future__ import annotations

from pathlib import Path

from intercap_core.config_types import LayoutName
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.files import refuse_scale
from intercap_core.formats.recordings.source import RecordingLayout

# Patterns of the files and folders that the workflow watches, below the folder of recordings ("" =
# that folder). A folder's time changes if an image is added or removed; watching each of the
# thousands of images would delay every run by minutes.
INPUTS: dict[LayoutName, tuple[str, ...]] = {
    "k4a": ("*.mkv",),
    "intercap": ("Frames_Cam*/*",),
    "behave": ("",),
    "plain": ("*", "*/colour", "*/depth"),
}
# Suffixes of other files in such a folder, such as the studio's truth.
_NO_RECORDINGS = {".h5", ".json", ".yaml", ".yml", ".toml", ".txt", ".tsv", ".part"}


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
            and (path.suffix.lower() not in _NO_RECORDINGS or path.stem.endswith("timestamps"))
        }
    )


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
        case "intercap":
            from intercap_core.formats.recordings.intercap import InterCapLayout

            return InterCapLayout(sequence)
        case "behave":
            from intercap_core.formats.recordings.behave import BehaveLayout

            return BehaveLayout(sequence)
        case "plain":
            from intercap_core.formats.recordings.plain import PlainLayout

            return PlainLayout(sequence)
