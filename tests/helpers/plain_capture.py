"""Plain recordings of two cameras, and the stage detections on them."""

from __future__ import annotations

import json
from pathlib import Path

from intercap_core.config import DetectionsSettings, FramesSettings
from intercap_core.entries import SequenceEntry
from intercap_core.formats.detections.read import Detections
from intercap_core.stages import detections, frames

CAMERAS = ("left", "right")


def write_rig(folder: Path, size: tuple[int, int], focal_px: float) -> dict[str, Path]:
    """Write ``rig.json``, both cameras a metre apart and without distortion, and make a folder for
    each one's images; these by name. ``size`` is width and height, px."""
    lens = {
        "image_size": size,
        "camera_matrix": [[focal_px, 0, size[0] / 2], [0, focal_px, size[1] / 2], [0, 0, 1]],
        "distortion_coefficients": [0, 0, 0, 0],
    }
    cameras = {name: lens | {"R": [0, 0, 0], "T": [c, 0, 0]} for c, name in enumerate(CAMERAS)}
    (folder / "rig.json").write_text(json.dumps({"fps": 10, "cameras": cameras}))
    images = {name: folder / "recordings" / name for name in CAMERAS}
    for path in images.values():
        path.mkdir(parents=True)
    return images


def plain_entry(folder: Path, **inputs: Path) -> SequenceEntry:
    """The row of the recording in ``folder``."""
    return SequenceEntry(
        sequence="s1", subject="a", object="b", layout="plain",
        recordings=folder / "recordings", calibration=folder / "rig.json", **inputs,
    )  # fmt: skip


def detect(capture: SequenceEntry, output: str = "detections.h5", **settings) -> Detections:
    """Run stage detections next to the recordings; stage frames runs once."""
    out = capture.recordings.parent
    if not (out / "frames.h5").exists():
        frames.run(sequence=capture, output=out / "frames.h5", settings=FramesSettings())
    detections.run(
        frames=out / "frames.h5",
        output=out / output,
        sequence=capture,
        settings=DetectionsSettings(**settings),
    )
    return Detections.load(out / output)
