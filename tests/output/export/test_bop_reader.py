"""A BOP scene, read by its own files alone: models by trimesh, projection and masks by OpenCV."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from tests.helpers import exported
from tests.helpers import fitted_capture as fitted

POINTS = 4000  # spread over the object's surface
BORDER_PX = 3  # a mask's border and a point on the silhouette differ by rounding


@dataclass
class Image:
    """Of one image: ``pixels`` (N, 2) of points of the surface, ``facing`` (N,) whether each faces
    the camera, both masks, and its entry of scene_gt_info."""

    pixels: np.ndarray
    facing: np.ndarray
    mask: np.ndarray
    visible: np.ndarray
    info: dict[str, Any]


def _load(path: Path) -> Any:
    return json.loads(path.read_text())


def _images(folder: Path) -> Iterator[Image]:
    lenses = _load(folder / "lenses.json")
    models: dict[int, trimesh.Trimesh] = {}
    for scene in sorted((folder / "test").iterdir()):
        cameras, gt, info = (
            _load(scene / f"scene_{name}.json") for name in ("camera", "gt", "gt_info")
        )
        lens = np.array(lenses[scene.name]["distortion_k1_k2_p1_p2_k3_k4_k5_k6"])
        for image, instances in gt.items():
            for place, entry in enumerate(instances):
                number = entry["obj_id"]
                if number not in models:
                    models[number] = trimesh.load(folder / "models" / f"obj_{number:06d}.ply")
                model = models[number]
                points, faces = trimesh.sample.sample_surface(model, POINTS, seed=1)
                turn = np.reshape(entry["cam_R_m2c"], (3, 3))
                at = np.array(entry["cam_t_m2c"])
                seen = points @ turn.T + at
                normals = model.face_normals[faces] @ turn.T
                matrix = np.reshape(cameras[image]["cam_K"], (3, 3))
                pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], at, matrix, lens)
                name = f"{int(image):06d}_{place:06d}.png"
                mask, visible = (
                    cv2.imread(str(scene / kind / name), cv2.IMREAD_GRAYSCALE) > 0
                    for kind in ("mask", "mask_visib")
                )
                yield Image(
                    pixels[:, 0], (seen * normals).sum(1) < 0, mask, visible, info[image][place]
                )


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A suitcase that turns from frame to frame: large enough for its outline to show how."""
    folder = tmp_path_factory.mktemp("suitcase")
    capture = fitted.make_capture(folder, object_name="suitcase")
    capture.measure(hold_out=False)
    lively = exported.lively(capture, folder / "joint")
    return exported.run(lively, folder / "out", formats=("bop",)) / "bop"


@pytest.fixture(scope="module")
def images(turning: Path) -> list[Image]:
    return list(_images(turning))


@pytest.fixture(scope="module")
def occluded(everything: Path) -> list[Image]:
    """With a hand before the object, in some views."""
    return list(_images(everything / "bop"))


def _grown(mask: np.ndarray) -> np.ndarray:
    size = 2 * BORDER_PX + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((size, size))) > 0


def test_the_projected_object_is_its_mask(images: list[Image]) -> None:
    assert len(images) == 15
    for image in images:
        height, width = image.mask.shape
        column, row = np.rint(image.pixels).astype(int).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        assert inside.mean() > 0.9
        assert _grown(image.mask)[row[inside], column[inside]].all()
        drawn = np.zeros_like(image.mask)
        drawn[row[inside], column[inside]] = True
        assert _grown(drawn)[image.mask].all(), "part of the mask where nothing of the object is"


def test_visible_masks_agree_with_facing_points(occluded: list[Image]) -> None:
    """Of the points that face it, as many fall into mask_visib as the visible share says."""
    shares = []
    for image in occluded:
        column, row = np.rint(image.pixels[image.facing]).astype(int).T
        near = np.zeros_like(image.visible)
        near[row, column] = True
        assert _grown(near)[image.visible].all()
        within = image.visible[row, column].mean()
        share = image.info["visib_fract"]
        assert within == pytest.approx(share, abs=0.2)
        shares.append(share)
    assert min(shares) < 0.8 and max(shares) > 0.9, "nothing hides the cup anywhere"


def test_info_is_that_of_the_masks(everything: Path, occluded: list[Image]) -> None:
    for image in occluded:
        assert not (image.visible & ~image.mask).any()
        counts = (image.info["px_count_all"], image.info["px_count_visib"])
        assert counts == (image.mask.sum(), image.visible.sum())
        assert image.info["visib_fract"] == pytest.approx(counts[1] / counts[0])
        box = cv2.boundingRect(image.mask.astype(np.uint8))
        assert box == tuple(image.info["bbox_obj"])
    first = _load(everything / "bop" / "test" / "000000" / "scene_camera.json")["0"]
    assert _load(everything / "bop" / "camera.json")["fx"] == first["cam_K"][0]


def test_boxes_hold_the_projected_points(images: list[Image]) -> None:
    for image in images:
        x, y, width, height = image.info["bbox_obj"]
        low, high = image.pixels.min(0), image.pixels.max(0)
        assert np.abs(low - [x, y]).max() < BORDER_PX
        assert np.abs(high - [x + width, y + height]).max() < BORDER_PX


def test_targets_are_images_in_which_it_is_seen(turning: Path, images: list[Image]) -> None:
    targets = _load(turning / "test_targets_bop19.json")
    assert len(targets) == sum(image.info["visib_fract"] >= 0.1 for image in images)
    for target in targets:
        scene = turning / "test" / f"{target['scene_id']:06d}"
        entries = _load(scene / "scene_gt.json")[str(target["im_id"])]
        ours = [entry for entry in entries if entry["obj_id"] == target["obj_id"]]
        assert len(ours) == target["inst_count"]


def test_all_scenes_share_the_world_frame(turning: Path) -> None:
    """The object's pose in the world, by the cameras of any scene, is the same in one frame."""
    places: dict[str, list[np.ndarray]] = {}
    for scene in sorted((turning / "test").iterdir()):
        cameras, gt = (_load(scene / f"scene_{name}.json") for name in ("camera", "gt"))
        for image, (entry,) in gt.items():
            camera = cameras[image]
            turn = np.reshape(camera["cam_R_w2c"], (3, 3))
            at = np.array(entry["cam_t_m2c"]) - camera["cam_t_w2c"]
            places.setdefault(image, []).append(turn.T @ at)
    assert len(places) == 5
    for positions in places.values():
        assert len(positions) == 3 and np.ptp(positions, axis=0).max() < 1e-2  # mm
