"""Every file of an export says in which frame its numbers are, what is up, and in which units."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.output.export.motion import Coordinates
from tests.helpers import exported


def test_exports_state_their_frame(everything: Path, zup_from_master: np.ndarray) -> None:
    manifest = json.loads((everything / "export.json").read_text())
    for name, stated in exported.stated(everything).items():
        fixed = name.split("/")[0] in ("intercap", "bop", "coco")
        up = zup_from_master[2, :3] if fixed else [0, 1, 0] if name == "glb" else [0, 0, 1]
        assert stated["up"] == pytest.approx(up, abs=1e-6), name
        assert stated["up_axis"] == ("-y" if fixed else "y" if name == "glb" else "z"), name
        assert ("x right, y down" in stated["frame"]) == fixed and stated["units"], name
        for what in ("frame", "up", "up_axis", "units"):
            expected = manifest[what][name.split("/")[0]]
            same = pytest.approx(expected) if what == "up" else expected
            assert stated[what] == same, (name, what)
    assert manifest["units"]["bop"].startswith("millimetres")
    assert manifest["units"]["coco"].startswith("pixels")


def test_exports_in_a_camera_frame_say_so(in_camera: Path, zup_from_master: np.ndarray) -> None:
    for name, stated in exported.stated(in_camera).items():
        assert "x right, y down" in stated["frame"], name
        assert stated["up_axis"] == ("y" if name == "glb" else "-y")
        up = [0, 1, 0] if name == "glb" else zup_from_master[2, :3]
        assert stated["up"] == pytest.approx(up, abs=1e-6), name
    text = (in_camera / "README.txt").read_text()
    assert "z-up" not in text and "up: -y (" in text


def test_a_ply_of_bop_says_that_it_is_in_millimetres(everything: Path) -> None:
    (path,) = (everything / "bop" / "models").glob("*.ply")
    head = path.read_bytes()[:400]
    assert b"comment units: millimetres" in head and b"comment frame: the object's own" in head


def test_the_readme_states_the_frame_of_every_format(everything: Path) -> None:
    text = (everything / "README.txt").read_text()
    for name in ("intercap/res", "amass/body", "bop/", "coco/", "glb/", "contact/", "meshes/"):
        assert f"\n{name}" in text
    assert text.count("up: z (0.000000 0.000000 1.000000)") == 3  # amass, glb and meshes
    assert text.count("up: -y (") == 2  # intercap and bop
    for words in (
        "metres", "millimetres", "radians", "within 4.5 mm", "verdict.json", "x = R v + t",
        "pelvis", "it is not SMPL-X",
    ):  # fmt: skip
        assert words in text


@pytest.mark.parametrize(
    ("up", "axis"),
    [
        ([0, 0, 1], "z"),
        ([0, -1, 0], "-y"),
        (Rotation.from_euler("x", 5, degrees=True).apply([0, -1, 0]), "none: see the vector up"),
        ([np.nan] * 3, "unknown"),
    ],
)
def test_the_axis_that_points_up_is_named(up: Any, axis: str) -> None:
    place = Coordinates("somewhere", np.array(up, float))
    assert place.up_axis == axis and place.to_json()["up_axis"] == axis
    json.dumps(place.to_json(), allow_nan=False)
