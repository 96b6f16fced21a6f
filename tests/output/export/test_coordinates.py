"""Every file of an export says in which frame its numbers are, what is up, and in which units."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.inputs.arrays import read_pickle
from intercap_core.output.export.motion import Coordinates
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted


def _npz(path: Path) -> dict[str, Any]:
    with np.load(path) as file:
        return {key: file[key].tolist() for key in ("frame", "up_axis", "up", "units")}


def _coordinates(folder: Path) -> dict[str, dict[str, Any]]:
    """What the files of each format say, by format."""
    glb = pygltflib.GLTF2().load(str(folder / "glb" / "cap.glb"))
    coco = json.loads((folder / "coco" / "annotations.json").read_text())
    return {
        "amass": _npz(folder / "amass" / "body.npz"),
        "amass/object": _npz(folder / "amass" / "object.npz"),
        "intercap": read_pickle(folder / "intercap" / "res.pkl")["about"],
        "intercap/npz": _npz(folder / "intercap" / "res.npz"),
        "bop": json.loads((folder / "bop" / "about.json").read_text()),
        "coco": coco["info"],
        "glb": glb.asset.extras,
        "meshes": json.loads((folder / "meshes" / "about.json").read_text()),
    }


@pytest.fixture(scope="module")
def in_camera(capture: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The formats whose frame is a setting, in the camera's."""
    out = tmp_path_factory.mktemp("camera") / "out"
    formats = ("amass", "glb", "meshes", "intercap", "bop", "coco")
    return exported.run(capture, out, formats=formats, frame="camera")


def test_exports_state_their_frame(everything: Path, zup_from_master: np.ndarray) -> None:
    up_in_master = np.linalg.inv(zup_from_master)[:3, 2]
    manifest = json.loads((everything / "export.json").read_text())
    for name, stated in _coordinates(everything).items():
        fixed = name.split("/")[0] in ("intercap", "bop", "coco")
        up = up_in_master if fixed else [0, 1, 0] if name == "glb" else [0, 0, 1]
        assert stated["up"] == pytest.approx(up, abs=1e-6), name
        assert stated["up_axis"] == ("-y" if fixed else "y" if name == "glb" else "z"), name
        assert ("x right, y down" in stated["frame"]) == fixed and stated["units"], name
        for what in ("frame", "up", "up_axis", "units"):
            expected = manifest[what][name.split("/")[0]]
            same = pytest.approx(expected) if what == "up" else expected
            assert stated[what] == same, (name, what)
    assert _coordinates(everything)["bop"]["units"].startswith("millimetres")
    assert _coordinates(everything)["coco"]["units"].startswith("pixels")


def test_exports_in_a_camera_frame_say_so(in_camera: Path) -> None:
    for name, stated in _coordinates(in_camera).items():
        assert "x right, y down" in stated["frame"], name
        assert stated["up_axis"] == ("y" if name == "glb" else "-y")
    text = (in_camera / "README.txt").read_text()
    assert "z-up" not in text and "up: -y (" in text


def test_heads_are_above_feet_along_up(
    everything: Path, in_camera: Path, capture: fitted.Capture
) -> None:
    """Heads are above feet along it, in files of parameters and of vertices."""
    head = capture.model.skinning_weights[:, 15].numpy() > 0.9
    for folder in (everything, in_camera):
        stated = _coordinates(folder)["meshes"]
        for path in sorted((folder / "meshes" / "Mesh").glob("*_second.ply")):
            import trimesh

            height = trimesh.load(path, process=False).vertices @ np.array(stated["up"])
            assert height[head].min() > height.max() - 0.45
            assert height.max() - height.min() > 1.4


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
    for words in ("metres", "millimetres", "radians", "within 4.5 mm", "verdict.json"):
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
