"""The layouts of recordings by the name that the table of sequences gives them."""

from __future__ import annotations

from pathlib import Path

from intercap_core.config import LayoutName, SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.files import refuse_scale
from intercap_core.formats.recordings.source import RecordingLayout

# What the workflow watches, below the folder of recordings ("" = the folder itself). Folders stand
# for what is in them: their times change when an image comes or goes, and watching each of a
# sequence's thousands of images would keep a run that has nothing to do busy for minutes.
INPUTS: dict[LayoutName, tuple[str, ...]] = {
    "k4a": ("*.mkv",),
    "intercap": ("Frames_Cam*/*",),
    "behave": ("",),
    "plain": ("*", "*/colour", "*/depth"),
}


# Of what lies beside recordings: never a recording itself, and a truth least of all.
_NO_RECORDINGS = {".h5", ".json", ".yaml", ".yml", ".toml", ".txt", ".tsv", ".part"}


def input_files(sequence: SequenceEntry) -> list[Path]:
    """The files and folders whose change asks for the frames anew; empty without recordings."""
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
    """Open the recordings of one sequence in the layout that its row names.

    Raises UserError where there is no such folder, and as the layout does.
    """
    if not sequence.recordings.is_dir():
        raise UserError(
            f"{sequence.recordings}: sequence {sequence.sequence!r} has no such folder of "
            "recordings; correct 'recordings' in the table of sequences"
        )
    if sequence.layout in ("intercap", "behave"):
        refuse_scale(sequence.calibration, sequence.calibration_scale)
    # Imports inside, one a layout: the workflow sees what the stage reaches, each loads its own.
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
