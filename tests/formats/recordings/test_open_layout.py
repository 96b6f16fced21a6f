"""The layouts by name: what the workflow watches, and what they all share."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from intercap_core.config_types import LayoutName
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.layouts import INPUTS, input_files, open_layout
from tests.helpers.kinect_files import row


def entry(folder: Path, layout: str) -> SequenceEntry:
    return row(folder, folder / "calibration.json", layout=layout)


FILES = [
    "k1.mkv", "left/00000.jpg", "left/depth/00000.png", "right/colour/00000.jpg", "top.mp4",
    "Frames_Cam1/color/00000.jpg", "frames_cam2/color/00000.jpg", "Frames_Cam1/depth/00000.png",
    "t0000.000/k0.color.jpg",
]  # fmt: skip


@pytest.mark.parametrize(
    ("layout", "watched"),
    [
        ("k4a", {"k1.mkv"}),
        ("intercap", {"Frames_Cam1/color", "Frames_Cam1/depth", "frames_cam2/color"}),
        ("behave", {"."}),
        ("plain", {"left", "left/depth", "right", "right/colour", "top.mp4", "k1.mkv"}),
    ],
)
def test_folders_are_watched_instead_of_their_images(tmp_path, layout, watched):
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found = {path.relative_to(tmp_path).as_posix() for path in input_files(entry(tmp_path, layout))}
    assert watched <= found
    assert not any(name.endswith((".jpg", ".png")) for name in found)
    assert input_files(entry(tmp_path / "none", layout)) == []


@pytest.mark.parametrize("layout", get_args(LayoutName))
def test_every_layout_names_the_missing_folder(tmp_path, layout):
    assert layout in INPUTS
    with pytest.raises(UserError, match="no such folder of recordings"):
        open_layout(entry(tmp_path / "none", layout))
    with pytest.raises(UserError):
        open_layout(entry(tmp_path, layout))
