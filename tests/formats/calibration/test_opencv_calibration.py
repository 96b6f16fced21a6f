"""Calibration files in OpenCV's terms: the documented one, FileStorage's, broken ones, lenses."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from intercap_core.errors import UserError
from intercap_core.formats.calibration.lens_checks import turning_radius
from intercap_core.formats.calibration.opencv import (
    opencv_lens,
    read_opencv_calibration,
)

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "recordings.md"


def example() -> str:
    return DOCUMENT.read_text().split("```yaml\n")[1].split("```")[0]


@pytest.fixture
def content() -> dict:
    return yaml.safe_load(example())


def read(folder: Path, content: object):
    path = folder / "rig.json"
    path.write_text(json.dumps(content))
    return read_opencv_calibration(path)


def check_example(calibration) -> None:
    left, right, top = calibration.cameras.values()
    assert calibration.extrinsics.master == "left"
    assert (left.colour.width, left.colour.height) == (1920, 1080)
    assert left.colour.distortion.tolist() == [0.081, -0.142, 0.0003, -0.0005, 0.047, 0, 0, 0]
    assert left.depth is left.colour and np.array_equal(left.colour_from_depth, np.eye(4))
    assert right.colour.distortion.tolist() == [0.084, -0.151, 0.0001, 0.0002, 0, 0, 0, 0]
    assert right.depth.fx == 504.1 and right.colour_from_depth[0, 3] == 0.032
    assert (right.time_offset, right.fps, top.fps, top.depth) == (0.004, 30, 60, None)
    poses = calibration.extrinsics.master_from_colour
    assert np.array_equal(poses["left"], np.eye(4))
    world = np.array([0.1, 0.2, 3.0, 1.0])
    turn = cv2.Rodrigues(np.array([1.2, 0, 0]))[0]
    assert np.allclose(
        np.linalg.inv(poses["top"]) @ world, [*(turn @ world[:3] + [0, 0.4, 2.5]), 1]
    )


def test_the_documented_example(tmp_path, content):
    path = tmp_path / "rig.yaml"
    path.write_text(example())
    check_example(read_opencv_calibration(path))
    check_example(read(tmp_path, content))


def write_node(storage: cv2.FileStorage, name: str, value: object) -> None:
    if isinstance(value, dict):
        storage.startWriteStruct(name, cv2.FILE_NODE_MAP)
        for key, entry in value.items():
            write_node(storage, key, entry)
        storage.endWriteStruct()
    else:
        storage.write(name, np.array(value, float) if isinstance(value, list) else value)


@pytest.mark.parametrize("suffix", ["yml", "yaml", "json"])
def test_files_that_opencv_writes(tmp_path, content, suffix):
    path = tmp_path / f"rig.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in content.items():
        write_node(storage, name, value)
    storage.release()
    assert "opencv-matrix" in path.read_text()
    check_example(read_opencv_calibration(path))


def test_a_folder_with_a_file_for_each_camera(tmp_path, content):
    for name, entry in content["cameras"].items():
        storage = cv2.FileStorage(str(tmp_path / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        width, height = entry.pop("image_size")
        for key, value in {**entry, "image_width": width, "image_height": height}.items():
            write_node(storage, key, value)
        storage.write("calibration_time", "today")
        storage.release()
    calibration = read_opencv_calibration(tmp_path)
    assert list(calibration.cameras) == ["left", "right", "top"]
    assert calibration.extrinsics.master == "left" and calibration.cameras["left"].fps is None
    assert calibration.cameras["top"].colour.height == 720


def random_lens(rng: np.random.Generator, count: int):
    """A lens of 40 to 110 degrees across, bent as real ones are: less by the higher terms."""
    width, height = rng.choice([(640, 480), (1280, 720), (1920, 1080), (2048, 1536)])
    focal = width / 2 / np.tan(np.radians(rng.uniform(40, 110)) / 2)
    across = width / 2 / focal
    k1, k2, k3 = rng.normal(0, [0.1, 0.03, 0.01]) / across ** np.array([2, 4, 6])
    p1, p2 = rng.normal(0, 0.001, 2)
    coefficients = [k1, k2, p1, p2, k3]
    if count == 8:
        k4, k5, k6 = rng.normal(0, [0.05, 0.02, 0.005]) / across ** np.array([2, 4, 6])
        coefficients += [k4, k5, k6]
    centre = np.array([width, height]) / 2 + rng.normal(0, 0.01, 2) * width
    matrix = np.array(
        [[focal, 0, centre[0]], [0, focal * rng.normal(1, 0.002), centre[1]], [0, 0, 1]]
    )
    return (int(width), int(height)), matrix, np.array(coefficients[:count])


def folds(size, matrix, coefficients) -> bool:
    """Whether the model turns back within the image: no lens, and nothing can invert it."""
    padded = np.concatenate([coefficients, np.zeros(8 - len(coefficients))])
    corner = np.linalg.norm(np.array(size) / 2 / matrix[[0, 1], [0, 1]])
    turn = turning_radius(padded)
    x = np.array([[turn, 0, 1.0]])
    edge = cv2.projectPoints(x, np.zeros(3), np.zeros(3), np.eye(3), coefficients)[0][0, 0, 0]
    return edge < 1.15 * corner


@pytest.mark.parametrize("count", [4, 5, 8])
def test_lenses_agree_with_opencv_over_the_whole_image(count):
    rng = np.random.default_rng(count)
    tried = 0
    while tried < 20:
        size, matrix, coefficients = random_lens(rng, count)
        if folds(size, matrix, coefficients):
            continue
        tried += 1
        lens = opencv_lens(size, matrix, coefficients, "lens")
        u, v = np.meshgrid(np.linspace(0, size[0] - 1, 25), np.linspace(0, size[1] - 1, 25))
        pixels = np.stack([u, v], -1).reshape(-1, 2)
        rays = lens.unproject(pixels)
        zero = np.zeros(3)
        projected = cv2.projectPoints(rays * 1.7, zero, zero, matrix, coefficients)[0][:, 0]
        assert np.abs(projected - pixels).max() < 1e-3  # OpenCV agrees with our inverse
        assert np.abs(lens.project(rays * 1.7) - pixels).max() < 1e-6
        assert lens.sees(rays * 1.7).all()


def test_a_lens_ends_where_its_distortion_turns_back():
    size, matrix = (1280, 720), [[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]
    lens = opencv_lens(size, matrix, [-0.3, 0.0, 0, 0], "lens")
    turn = np.sqrt(1 / 0.9)  # 1 - 3 * 0.3 r^2 = 0
    assert lens.metric_radius == pytest.approx(turn, abs=1e-3)
    beyond = np.array([[1.6, 0.0, 1.0]])  # OpenCV would show it inside the image
    folded = cv2.projectPoints(
        beyond, np.zeros(3), np.zeros(3), np.array(matrix), np.array([-0.3, 0, 0, 0])
    )
    assert folded[0][0, 0, 0] < 1280
    assert not lens.sees(beyond).any()


def test_a_wide_lens_is_not_cut_at_the_default_radius():
    matrix = [[300.0, 0, 640], [0, 300, 360], [0, 0, 1]]  # 130 degrees across
    lens = opencv_lens((1280, 720), matrix, [0, 0, 0, 0], "lens")
    assert lens.sees(lens.unproject(np.array([[0.0, 0.0], [1279, 719]]))).all()
    assert np.isfinite(lens.rays).all()


MILLIMETRES = [[1, 0, 0, 32.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def change(path: str, value: object):
    """Set (or with ... remove) the entry at a dotted path."""

    def apply(content: dict) -> None:
        *folders, last = path.split(".")
        for folder in folders:
            content = content[folder]
        if value is ...:
            del content[last]
        else:
            content[last] = value

    return apply


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (change("cameras", ...), "expected 'cameras'"),
        (change("master", "front"), "master 'front' is none of the cameras"),
        (change("fps", -3), "fps is -3, expected 0.05 to 10000"),
        (change("cameras.left.camera_matrix", ...), "camera 'left': has no camera_matrix"),
        (change("cameras.left.distortion_coefficients", ...), "has no distortion_coefficients"),
        (change("cameras.left.camera_matrix", [[1, 2], [3, 4]]), "camera_matrix is no"),
        (change("cameras.left.distortion_coefficients", [0] * 14), "has 14 numbers.*thin prism"),
        (change("cameras.left.distortion_coefficients", [0] * 3), "has 3 numbers, expected 4, 5"),
        (change("cameras.left.distortion_coefficients", ["x"] * 4), "expected finite numbers"),
        (change("cameras.left.image_size", [640, 480]), "principal point 958, 542 is that of"),
        (change("cameras.left.image_size", [1920.5, 1080]), "expected width and height"),
        (change("cameras.right.T", ...), "camera 'right': has no pose"),
        (change("cameras.right.T", [2100.0, 0, 0]), "likely in millimetres"),
        (change("cameras.right.R", [[2, 0, 0], [0, 1, 0], [0, 0, 1]]), "R is no rotation"),
        (change("cameras.right.R", [0, -60, 0]), "'right': rotation vector R has length 60"),
        (change("cameras.right.depth", "yes"), "depth is 'yes', expected 'aligned'"),
        (change("cameras.right.depth.colour_from_depth", ...), "colour_from_depth is"),
        (change("cameras.right.depth.colour_from_depth", MILLIMETRES), "moves by 32 m"),
        (change("cameras.right.time_offset", "late"), "time_offset is 'late'"),
        (change("cameras.right", 3), "camera 'right': expected a name of"),
        (change("cameras.left.camera_matrix", [[1e-9, 0, 958], [0, 900, 542], [0, 0, 1]]),
         "fx is 1e-09 px"),
        (change("cameras.left.distortion_coefficients", [50, 0, 0, 0]), "camera 'left'.*scales"),
        (change("cameras.left.distortion_coefficients", [-1e9, 0, 0, 0]), "turns back"),
        (change("fps", 1e-9), "fps is 1e-09"),
    ],
)  # fmt: skip
def test_broken_files_are_refused(tmp_path, content, fault, words):
    fault(content)
    with pytest.raises(UserError, match=words):
        read(tmp_path, content)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("rig.yaml", "cameras: [", "not valid JSON or YAML"),
        ("rig.yaml", "a list", "found str"),
        ("rig.yaml", "cameras: !!python/object:os.system {}", "not valid JSON or YAML"),
    ],
)
def test_files_without_a_calibration_are_refused(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=words):
        read_opencv_calibration(tmp_path / name)
