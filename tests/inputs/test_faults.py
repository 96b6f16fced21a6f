"""Single faults of files are refused by file and place."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from intercap_core.annotation import Annotation
from intercap_core.commands.check_recordings import faults_of_truth
from intercap_core.errors import UserError
from intercap_core.formats.recordings.image_files import encoded_size
from intercap_core.formats.recordings.k4a import KinectFile
from intercap_core.geometry.camera import masks
from intercap_core.geometry.rigid.mesh_files import get_colours, load_mesh
from intercap_core.studio.calibration import write_calibration
from intercap_core.studio.mkv import MkvWriter
from tests.fuzz.kinds import KINDS
from tests.fuzz.plausible import check_plausible
from tests.helpers.kinect_files import MODES, jpeg_at, make_camera
from tests.helpers.tiny_onnx import Graph

Edit = Callable[[Path], object]


def values(name: str, place: str, raw: str) -> Edit:
    """Set the value at a place of a JSON file, such as ``a.0.b``, to raw text."""

    def edit(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        *path, last = [int(p) if p.isdigit() else p for p in place.split(".")]
        holder = content
        for part in path:
            holder = holder[part]
        holder[last] = "the place"
        (folder / name).write_text(json.dumps(content).replace('"the place"', raw))

    return edit


def text(name: str, old: str, new: str) -> Edit:
    """Replace text of a file, once."""

    def edit(folder: Path) -> None:
        content = (folder / name).read_text()
        assert old in content
        (folder / name).write_text(content.replace(old, new, 1))

    return edit


def whole(name: str, content: bytes) -> Edit:
    return lambda folder: (folder / name).write_bytes(content)


HUGE = "1" + "0" * 400
CAMERA = "CalibrationInformation.Cameras.{}"
_PARAMETERS = CAMERA + ".Intrinsics.ModelParameters.{}"


def kinect(place: str, raw: str) -> tuple[str, Edit]:
    return "kinect-calibration", values("calibration.json", place, raw)


def parameter(camera: int, number: int, raw: str) -> tuple[str, Edit]:
    return kinect(_PARAMETERS.format(camera, number), raw)


def rig(edit: Edit) -> tuple[str, Edit]:
    return "rig", edit


def opencv(place: str, raw: str) -> tuple[str, Edit]:
    return "opencv-json", values("rig.json", place, raw)


def _one_place(folder: Path) -> None:
    content = json.loads((folder / "rig.json").read_text())
    content["cameras"]["k3"] = content["cameras"]["k2"]
    (folder / "rig.json").write_text(json.dumps(content))


def _centimetres(folder: Path) -> None:
    content = json.loads((folder / "rig.json").read_text())
    for camera in content["cameras"].values():
        for row in camera["master_from_camera"][:3]:
            row[3] *= 90
    (folder / "rig.json").write_text(json.dumps(content))


REFUSED = {
    "no information": (kinect("CalibrationInformation", "null"), "expected an object"),
    "a lens of 401 digits": (parameter(1, 2, HUGE), "finite numbers"),
    "a radius of 401 digits": (kinect(CAMERA.format(1) + ".MetricRadius", HUGE), "radius|finite"),
    "a shift of 401 digits": (kinect(CAMERA.format(1) + ".Rt.Translation.0", HUGE), "rigid"),
    "a shift of 1e300": (kinect(CAMERA.format(1) + ".Rt.Translation.0", "1e300"), "rigid|moves"),
    "a shift that is a number": (kinect(CAMERA.format(1) + ".Rt.Translation", "0.1"), "rigid"),
    "colour fx 1e308": (parameter(1, 2, "1e308"), "fx|finite"),
    "depth fx 1e9": (parameter(0, 2, "1e9"), "fx is 5.12e.11 px"),
    "colour fx 1e-9": (parameter(1, 2, "1e-9"), "fx is 1.28e-06 px"),
    "cx 50 widths away": (parameter(1, 0, "50"), "cx is"),
    "k1 of 1e9": (parameter(1, 4, "1e9"), "distortion"),
    "tangential distortion of 5": (parameter(1, 12, "5"), "tangential distortion"),
    "centimetres": (rig(_centimetres), "likely in centimetres"),
    "two cameras in one place": (rig(_one_place), "'k2' and 'k3' are in one place"),
    "a key twice": (rig(text("rig.json", '"k2"', '"k1"')), "'k1' is given twice"),
    "f of 1e-9": (opencv("cameras.left.camera_matrix.0.0", "1e-9"), "fx is 1e-09 px"),
    "k1 of 50": (opencv("cameras.left.distortion_coefficients.0", "50"), "camera 'left'.*scales"),
    "k1 of -1e9": (opencv("cameras.left.distortion_coefficients.0", "-1e9"), "turns back"),
    "fps of 1e-9": (opencv("fps", "1e-9"), "fps is 1e-09"),
    "matrix of 401 digits": (
        ("opencv-storage", text("left.yml", "data: [ 901.5", f"data: [ {HUGE}")), "camera_matrix",
    ),
    "a field of a megabyte": (
        ("sequences", text("sequences.tsv", "rec/one", "y" * (1 << 20))),
        "line 2.*255 bytes a name",
    ),
    "a path part of 300 characters": (
        ("sequences", text("sequences.tsv", "rec/one", "x" * 300)), "line 2.*recordings",
    ),
    "such a path of settings": (
        ("settings", text("config.yaml", "objects.yaml", "x" * 300)), "setting objects",
    ),
    "weights of zeros": (
        ("vposer", lambda folder: _reweighted(folder, lambda w: w * 0)), "is zero, so that every",
    ),
    "weights of 1e30": (
        ("vposer", lambda folder: _reweighted(folder, lambda w: w * 1e30)), "expected at most 1000",
    ),
    "weights without numbers": (
        ("vposer", lambda folder: _reweighted(folder, lambda w: w.to("meta"))), "meta",
    ),
    "10^9 faces and 12": (
        ("mesh-ply-text", text("box.ply", "element face 12", "element face 1000000000")),
        "states 1000000008 elements",
    ),
    "one face too many": (
        ("mesh-ply-text", text("box.ply", "element face 12", "element face 13")), "box.ply",
    ),
    "a list of 10^9": (
        ("mesh-ply-text", text("box.ply", "\n3 ", "\n1000000000 ")), "box.ply: a face states 10",
    ),
    "1 km away": (
        ("mesh-ply-text", lambda folder: _moved(folder, 1000.0)), "1000 m from its origin",
    ),
}  # fmt: skip


def _reweighted(folder: Path, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    state = torch.load(folder / "vposer.pt")
    changed = {n: change(v) if n.endswith("weight") else v for n, v in state.items()}
    torch.save(changed, folder / "vposer.pt")


def _moved(folder: Path, metres: float) -> None:
    import trimesh

    mesh = trimesh.load(folder / "box.ply", process=False)
    mesh.apply_translation([metres, 0, 0])
    mesh.export(folder / "box.ply", encoding="ascii")


@pytest.mark.parametrize("name", REFUSED)
def test_a_fault_is_refused_by_file_and_place(name: str, tmp_path: Path) -> None:
    (kind, edit), words = REFUSED[name]
    KINDS[kind].make(tmp_path)
    KINDS[kind].read(tmp_path)
    edit(tmp_path)
    with pytest.raises(UserError) as caught:
        KINDS[kind].read(tmp_path)
    message = str(caught.value)
    assert re.search(words, message), message
    assert any(file in message for file in (*KINDS[kind].damaged, str(tmp_path)))


@pytest.mark.parametrize(
    ("place", "raw", "words"),
    [
        ("0.bbox.0", "1e300", "entry 0 .*pixels of the image of 320x240"),
        ("1.bbox.2", "-40", "entry 1 .*pixels of the image"),
        ("1.score", "99", "entry 1 .*score is 99, expected a number from 0 to 1"),
        ("3.segmentation.size", "[1, 1]", "entry 3 .*has 1x1 pixels"),
        (
            "2.segmentation", str([[99999, 99999, -99999, 5, 7, -99999] * 2000]),
            "entry 2 .*polygons are more than",
        ),
    ],
)  # fmt: skip
def test_impossible_candidates_are_left_out(
    place: str, raw: str, words: str, tmp_path: Path
) -> None:
    kind = KINDS["coco-results"]
    kind.make(tmp_path)
    assert not check_plausible(kind.read(tmp_path))
    values("k1.json", place, raw)(tmp_path)
    notes = check_plausible(kind.read(tmp_path))
    assert notes and re.search(words, "; ".join(notes)), notes


def test_outlines_of_real_shapes_are_filled() -> None:
    angle = np.linspace(0, 2 * np.pi, 5000, endpoint=False)
    outline = np.column_stack([500 + 400 * np.cos(angle), 300 + 250 * np.sin(angle)])
    filled = masks.decode(masks.from_polygons([outline.ravel().tolist()], 600, 1000), 600, 1000)
    assert abs(filled.sum() - np.pi * 400 * 250) < 2000


def test_labels_of_undecodable_mask_names_are_text(tmp_path: Path) -> None:
    kind = KINDS["mask-images"]
    kind.make(tmp_path)
    (tmp_path / "k1/a__cup.png").rename(tmp_path / "k1/a__c\udcffup.png")
    assert not check_plausible(kind.read(tmp_path))  # encodes every label


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"start_offset_ns": 10**398}, "K4A_START_OFFSET_NS"),
        ({"start_offset_ns": (1 << 63) * 1000}, "K4A_START_OFFSET_NS"),
        ({"depth_delay_ns": 10**29}, "K4A_DEPTH_DELAY_NS"),
        (
            {"subordinate_delay_ns": 10**12, "wired_sync_mode": "SUBORDINATE"},
            "K4A_SUBORDINATE_DELAY_NS",
        ),
    ],
)
def test_impossible_times_of_recordings_are_refused(
    options: dict[str, Any], words: str, tmp_path: Path
) -> None:
    path = tmp_path / "k1.mkv"
    calibration = write_calibration(make_camera(0), serial="1", **MODES)
    with MkvWriter(
        path, calibration_json=calibration, fps=15, serial="1", **MODES, **options
    ) as writer:
        writer.write_colour(jpeg_at(0, 0), options.get("start_offset_ns", 0) // 1000 + 1000)
    with pytest.raises(UserError, match=rf"k1\.mkv: tag {words} is .*expected nanoseconds"):
        KinectFile(path)


def test_a_jpeg_without_image_data_is_refused(tmp_path: Path) -> None:
    KINDS["images"].make(tmp_path)
    good = (tmp_path / "a.jpg").read_bytes()
    assert encoded_size(good) == (64, 48)
    scan = good.index(b"\xff\xda")
    assert encoded_size(good[:scan] + b"\xff\xd9") is None
    assert encoded_size(good[: scan + 14] + b"\xff\xd9") is None


def _constant_rcnn(path: Path, boxes: object, scores: object, mask: tuple[int, int]) -> None:
    """A Mask R-CNN that says the same of every image."""
    graph = Graph()
    outputs = []
    for name, value, kind in (
        ("boxes", np.reshape(boxes, (-1, 4)), np.float32),
        ("labels", np.ones(np.size(scores)), np.int64),
        ("scores", np.ravel(scores), np.float32),
        ("masks", np.ones((np.size(scores), 1, *mask)), np.float32),
    ):
        graph.add("Identity", graph.constant(value, kind), name=name)
        element = onnx.TensorProto.INT64 if kind is np.int64 else onnx.TensorProto.FLOAT
        outputs.append((name, element, [None] * np.ndim(value)))
    graph.save(path, [("image", onnx.TensorProto.FLOAT, [3, "height", "width"])], outputs)


@pytest.mark.parametrize(
    ("boxes", "score", "mask", "words"),
    [
        ([10, 10, 90, 90], 50.0, (240, 320), "scores up to 50"),
        ([10, np.nan, 90, 90], 0.9, (240, 320), "no numbers"),
        ([10, 10, 90, 90], 0.9, (0, 0), "outputs"),
        ([10, 10, 90, 90], 0.9, (1, 40_000), "outputs"),
    ],
)
def test_impossible_outputs_of_models_are_refused(
    boxes: list[float], score: float, mask: tuple[int, int], words: str, tmp_path: Path
) -> None:
    _constant_rcnn(tmp_path / "model.onnx", boxes, score, mask)
    with pytest.raises(UserError, match=rf"model\.onnx: .*{words}"):
        KINDS["onnx-rcnn"].read(tmp_path)
    _constant_rcnn(tmp_path / "model.onnx", [10, 10, 90, 90], 0.9, (240, 320))
    KINDS["onnx-rcnn"].read(tmp_path)


@pytest.mark.parametrize(
    "shape", [[1, 3, 40_000, 40_000], [1, 3, 10**9, 10**9], [10**9, 3, 64, 64]]
)
def test_models_with_huge_inputs_are_refused(shape: list[int], tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    KINDS["onnx-yolo"].make(tmp_path)
    model = onnx.load(path)
    for axis, length in zip(model.graph.input[0].type.tensor_type.shape.dim, shape, strict=True):
        axis.dim_value = length
    onnx.save(model, path)
    with pytest.raises(UserError, match=r"model\.onnx"):
        KINDS["onnx-yolo"].read(tmp_path)


def test_dropping_every_frame_is_refused(tmp_path: Path) -> None:
    assert "all 3 frames" in str(Annotation(drop_frames=(0, 1, 2)).check_frames(3))
    assert Annotation(drop_frames=(0, 1)).check_frames(3) is None


def test_textures_outside_the_folder_of_the_mesh_are_ignored(tmp_path: Path) -> None:
    import cv2

    folder = tmp_path / "object"
    folder.mkdir()
    KINDS["mesh-textured"].make(folder)
    (folder / "box.png").rename(tmp_path / "outside.png")
    cv2.imwrite(str(tmp_path / "outside.png"), np.full((4, 4, 3), (0, 0, 255), np.uint8))
    for name in ("../outside.png", str(tmp_path / "outside.png"), "/dev/zero"):
        (folder / "box.mtl").write_text(f"newmtl a\nKd 0.8 0.8 0.8\nmap_Kd {name}\n")
        colours = get_colours(load_mesh(folder / "box.obj"))
        assert not (colours[:, :3] == (255, 0, 0)).all(1).any()


def test_models_with_external_data_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    KINDS["onnx-yolo"].make(tmp_path)
    model = onnx.load(path)
    constant = model.graph.initializer[0]
    constant.data_location = onnx.TensorProto.EXTERNAL
    length = len(constant.raw_data)
    constant.ClearField("raw_data")
    for key, value in (("location", "/dev/zero"), ("offset", "0"), ("length", str(length))):
        constant.external_data.add(key=key, value=value)
    path.write_bytes(model.SerializeToString())
    with pytest.raises(UserError, match=r"model\.onnx"):
        KINDS["onnx-yolo"].read(tmp_path)


def test_damaged_truth_is_refused(tmp_path: Path) -> None:
    (tmp_path / "truth.h5").write_text("no truth")
    (fault,) = faults_of_truth(tmp_path / "truth.h5")
    assert str(tmp_path / "truth.h5") in fault
