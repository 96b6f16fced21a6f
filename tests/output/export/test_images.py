"""Undistorted images, against OpenCV's lens model and depth known in closed form."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from intercap_core.config import ExportSettings
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.output.export import images
from intercap_core.output.export.format import Content
from intercap_core.output.export.silhouettes import Scenes
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted
from tests.helpers.synthetic_capture import write_frames

# distortion of a camera of an Azure Kinect, and stronger tangential distortion
RATIONAL = np.array([0.61, -2.72, 2e-3, -3e-3, 1.6, 0.48, -2.53, 1.52])
COLOUR = Intrinsics(320, 240, 205.0, 200.0, 161.0, 117.5, RATIONAL)
DEPTH = Intrinsics(200, 190, 150.0, 150.0, 99.0, 96.0, np.array([0.1, -0.05, 0, 1e-3, 0, 0, 0, 0]))
NORMAL, FAR_M = np.array([0.35, -0.2, 1.0]), 2.6  # plane NORMAL . X = FAR_M, colour camera's frame
NEAR_M, HALF_M = 1.3, 0.2  # a square in front of it, parallel to the colour image


def _depth_mm(rays: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Depth (H, W) along the colour camera's axis of rays (H, W, 3) from a point ``eye`` (3,)."""
    near = eye + rays * ((NEAR_M - eye[2]) / rays[..., 2])[..., None]
    far = eye + rays * ((FAR_M - NORMAL @ eye) / (rays @ NORMAL))[..., None]
    on_square = (np.abs(near[..., :2]) < HALF_M).all(-1)
    return 1e3 * np.where(on_square[..., None], near, far)


def _rays(lens: Intrinsics, distortion: np.ndarray) -> np.ndarray:
    """Rays (H, W, 3), z = 1, of all pixels by OpenCV."""
    grid = np.indices((lens.height, lens.width), float)[::-1].reshape(2, -1).T
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    xy = cv2.undistortPoints(grid[:, None], lens.matrix, distortion, criteria=criteria)
    return np.concatenate([xy[:, 0], np.ones((len(grid), 1))], 1).reshape(
        lens.height, lens.width, 3
    )


@pytest.fixture(scope="module")
def rig() -> Rig:
    """A camera with depth on the colour image's grid, and one with a separate depth camera."""
    between = rigid(cv2.Rodrigues(np.array([0.05, -0.03, 0.02]))[0], np.array([0.04, -0.01, 0.005]))
    return Rig(
        (
            Camera("grid", COLOUR, COLOUR, np.eye(4), np.eye(4)),
            Camera("separate", COLOUR, DEPTH, between, np.eye(4)),
        )
    )


@pytest.fixture(scope="module")
def written(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """Folders of the images as recorded (False) and undistorted (True), and of the recording."""
    folder = tmp_path_factory.mktemp("images")
    v, u = np.indices((COLOUR.height, COLOUR.width))
    picture = np.dstack([u / 2, v, 127 + 100 * np.sin(u / 17) * np.cos(v / 13)]).astype(np.uint8)
    kinds = [cv2.imencode(kind, picture)[1].tobytes() for kind in (".png", ".jpg")]
    depths = []
    for camera in rig:
        rays = _rays(camera.depth, camera.depth.distortion) @ camera.colour_from_depth[:3, :3].T
        eye = camera.colour_from_depth[:3, 3]
        points = _depth_mm(rays, eye) - 1e3 * eye
        along = points @ camera.colour_from_depth[:3, 2]  # axis of the depth camera
        depths.append(np.rint(along).astype(np.uint16)[None])
    path = write_frames(
        folder / "frames.h5", rig, num_sets=1, depths=depths, colours=[[kind] for kind in kinds]
    )
    nothing: Any = None
    settings = ExportSettings()
    image_of, times = np.zeros((1, 2), int), np.zeros(1)
    for undistort in (False, True):
        shown = images.undistorted(rig) if undistort else rig
        scenes = Scenes(nothing, shown, None, image_of, times, np.zeros(2), np.zeros((0, 0, 3)))
        with Frames.open(path) as frames:
            names = images.name_images(frames, scenes)
            assert names == [{0: "000000.png"}, {0: "000000.jpg"}]
            content = Content(
                nothing, np.eye(4), nothing, settings, nothing, scenes, rig, None, frames, names
            )
            images.write(folder / str(undistort), content, {"bop", "coco"})
    for name, kind in zip(("grid/000000.png", "separate/000000.jpg"), kinds, strict=True):
        assert (folder / "False" / "coco" / name).read_bytes() == kind
    return {undistort: folder / str(undistort) for undistort in (False, True)}


def _rgb(folder: Path, number: int) -> np.ndarray:
    (path,) = (folder / "bop" / "test" / f"{number:06d}" / "rgb").iterdir()
    assert path.stem == "000000"
    return cv2.imread(str(path))


def _sample(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    return cv2.remap(image, pixels.astype(np.float32)[None], None, cv2.INTER_LINEAR)[0].astype(
        float
    )


@pytest.mark.parametrize(("number", "levels"), [(0, 3), (1, 12)])  # JPEG is lossy
def test_a_point_has_the_same_content_through_the_pinhole(
    written: dict[bool, Path], number: int, levels: float
) -> None:
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-0.6, 0.6, 400), rng.uniform(-0.45, 0.45, 400), np.ones(400)]
    zero = np.zeros(3)
    recorded = cv2.projectPoints(points, zero, zero, COLOUR.matrix, COLOUR.distortion)[0][:, 0]
    pinhole = cv2.projectPoints(points, zero, zero, COLOUR.matrix, None)[0][:, 0]
    assert np.abs(recorded - pinhole).max() > 4, "the lens does not distort"
    before = _sample(_rgb(written[False], number), recorded)
    after = _sample(_rgb(written[True], number), pinhole)
    assert np.abs(before - after).max() < levels


@pytest.mark.parametrize("undistort", [False, True])
@pytest.mark.parametrize(("number", "covered"), [(0, 0.9), (1, 0.6)])
def test_depth_is_that_of_the_surface_on_the_pixels_ray(
    written: dict[bool, Path], undistort: bool, number: int, covered: float
) -> None:
    """Back-projected by the image's own lens, a depth pixel is on the surface that it shows."""
    scene = written[undistort] / "bop" / "test" / f"{number:06d}"
    depth = cv2.imread(str(scene / "depth" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16 and depth.shape == (COLOUR.height, COLOUR.width)
    rays = _rays(COLOUR, np.zeros(8) if undistort else COLOUR.distortion)
    expected = _depth_mm(rays, np.zeros(3))[..., 2]
    known = depth > 0
    assert known.mean() > covered
    near = (expected < 1e3 * NEAR_M + 1).astype(np.uint8)
    edge = cv2.morphologyEx(near, cv2.MORPH_GRADIENT, np.ones((7, 7))) > 0
    # a recorded depth pixel is up to half its diagonal from the ray; depth is rounded twice
    coarse = max(1.0, COLOUR.fx / DEPTH.fx) if number else 1.0
    slope = coarse * np.hypot(*np.gradient(expected))
    compared = known & ~edge
    assert (np.abs(depth - expected) <= 0.75 * slope + 1)[compared].all()
    assert near[compared].any() and not near[compared].all()


def test_annotations_are_those_of_the_undistorted_images(
    capture: fitted.Capture, everything: Path, tmp_path: Path
) -> None:
    """Keypoints and masks are those of the recorded images, moved by OpenCV's undistortion."""
    assert not list(everything.rglob("*.jpg")) and not list(everything.rglob("depth/*"))
    out = exported.run(capture, tmp_path / "out", formats=("bop", "coco"), undistort=True)
    before, after = (COCO(str(f / "coco" / "annotations.json")) for f in (everything, out))
    recorded = capture.rig[0].colour
    matrix, distortion = recorded.matrix, recorded.distortion
    maps = cv2.initUndistortRectifyMap(
        matrix, distortion, None, matrix, (recorded.width, recorded.height), cv2.CV_32FC1
    )
    for lens in after.dataset["info"]["lenses"].values():
        assert lens["cam_K"] == pytest.approx(matrix.ravel())
        assert not any(lens["distortion_k1_k2_p1_p2_k3_k4_k5_k6"])
    assert "undistorted" in after.dataset["info"]["units"]
    moved = 0.0
    for image in after.imgs.values():
        people, objects = (
            [
                coco.loadAnns(coco.getAnnIds(imgIds=image["id"], catIds=[n]))
                for coco in (before, after)
            ]
            for n in (1, 2)
        )
        for (old,), (new,) in (people, objects):
            expected = cv2.remap(before.annToMask(old), *maps, cv2.INTER_NEAREST)
            mask = after.annToMask(new)
            border = cv2.morphologyEx(expected, cv2.MORPH_GRADIENT, np.ones((5, 5)))
            assert (border[expected != mask] > 0).all()
            assert cv2.boundingRect(mask) == tuple(new["bbox"])
        picture = cv2.imread(str(out / "coco" / image["file_name"]))
        inner = cv2.erode(after.annToMask(people[1][0]), np.ones((7, 7))) > 0
        assert np.abs(np.median(picture[inner], axis=0) - [60, 90, 180]).max() < 8
        points = [np.reshape(entry["keypoints"], (17, 3)) for (entry,) in people]
        shown = (points[0][:, 2] > 0) & (points[1][:, 2] > 0)
        pixels = cv2.undistortPoints(points[0][shown, None, :2], matrix, distortion, None, matrix)
        assert points[1][shown, :2] == pytest.approx(pixels[:, 0], abs=0.03)
        moved = max(moved, np.abs(points[1] - points[0])[shown, :2].max())
    assert moved > 0.5, "the lens does not distort"
    for scene in sorted((out / "bop" / "test").iterdir()):
        for number, (info,) in json.loads((scene / "scene_gt_info.json").read_text()).items():
            name = f"{int(number):06d}"
            mask, depth = (
                cv2.imread(str(scene / path), cv2.IMREAD_UNCHANGED)
                for path in (f"mask/{name}_000000.png", f"depth/{name}.png")
            )
            assert info["px_count_valid"] == ((mask > 0) & (depth > 0)).sum() > 0
