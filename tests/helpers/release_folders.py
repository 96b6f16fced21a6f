"""Writers of the InterCap release's and BEHAVE's folders, from a rig and its images.

Colour is a JPEG as it is, depth (H, W) uint16 on the colour grid, millimetres; None = no file.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import invert
from intercap_core.studio.layouts import write_behave_calibration, write_intercap_calibration

Colour = Callable[[int, int], bytes | None]  # of set t and camera c
Depth = Callable[[int, int], np.ndarray | None]


def write_intercap(
    root: Path,
    rig: Rig,
    *,
    numbers: Iterable[int],
    colour: Colour,
    depth: Depth,
    sequence: str = "01/03/Seg_1",
    calibration: str = "calibration_first",
) -> tuple[Path, Path]:
    """Write one sequence under ``root``; returns the folders of recordings and of calibration.

    ``colour`` and ``depth`` are asked for each frame number and camera index.
    """
    recordings = root / "RGBD_Images" / sequence
    for c in range(len(rig)):
        folder = recordings / f"Frames_Cam{c + 1}"
        (folder / "color").mkdir(parents=True, exist_ok=True)
        (folder / "depth").mkdir(exist_ok=True)
        for number in numbers:
            _write(folder / "color" / f"{number:05d}.jpg", colour(number, c))
            _write(folder / "depth" / f"{number:05d}.png", _png(depth(number, c)))
    folder = root / "Data" / calibration
    write_intercap_calibration(folder, rig, [camera.colour for camera in rig])
    return recordings, folder


def write_behave(
    root: Path,
    rig: Rig,
    *,
    times: Iterable[str],
    colour: Colour,
    depth: Depth,
    sequence: str = "Date03_Sub03_chairwood_hand",
) -> tuple[Path, Path]:
    """Write one sequence under ``root``; camera c of the rig is Kinect c, the world is Kinect 1's.

    ``times`` are the texts in the names of the frame folders, such as "0003.000".
    """
    recordings = root / "sequences" / sequence
    for t, text in enumerate(times):
        folder = recordings / f"t{text}"
        folder.mkdir(parents=True, exist_ok=True)
        for c in range(len(rig)):
            _write(folder / f"k{c}.color.jpg", colour(t, c))
            _write(folder / f"k{c}.depth.png", _png(depth(t, c)))
    date = sequence.partition("_")[0]
    config = root / "calibs" / date / "config"
    of_kinect_1 = rig.moved(invert(rig[1].master_from_colour) @ rig.master_from_colour)
    kinects = Rig(tuple(replace(camera, name=f"k{c}") for c, camera in enumerate(of_kinect_1)))
    lenses = [camera.colour for camera in kinects]
    write_behave_calibration(root / "calibs", kinects, lenses, date)
    info = {
        "config": f"../../calibs/{config.parent.name}/config",
        "intrinsic": "../../calibs/intrinsics",
        "cat": sequence.split("_")[2],
        "gender": "male",
        "empty": None,
        "kinects": list(range(len(rig))),
    }
    (recordings / "info.json").write_text(json.dumps(info))
    return recordings, config


def _png(depth: np.ndarray | None) -> bytes | None:
    if depth is None:
        return None
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    return cv2.imencode(".png", depth, fast)[1].tobytes()


def _write(path: Path, content: bytes | None) -> None:
    if content is not None:
        path.write_bytes(content)
