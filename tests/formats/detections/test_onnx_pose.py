"""Pose models from the image to the people, on a model that finds coloured dots."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("onnxruntime")
tiny_pose = pytest.importorskip("tests.helpers.tiny_pose", exc_type=ImportError)

from intercap_core.body.keypoints import KEYPOINT_NAMES  # noqa: E402
from intercap_core.config import DetectionsSettings  # noqa: E402
from intercap_core.errors import UserError  # noqa: E402
from intercap_core.formats.detections.instance import Instance  # noqa: E402
from intercap_core.formats.detections.keypoints import KeypointLayout, layouts  # noqa: E402
from intercap_core.formats.detections.keypoints.coco import BODY  # noqa: E402
from intercap_core.formats.detections.onnx_pose import Crop, PoseModel, choose_person_boxes, tiles  # noqa: E402
from tests.helpers import tiny_onnx  # noqa: E402

SIZE = (640, 360)
SEEN = [KEYPOINT_NAMES.index(name) for name in tiny_pose.NAMES]
LEFT, RIGHT = tiny_pose.person((170.25, 40), 250), tiny_pose.person((450, 60.5), 260)


def around(places: np.ndarray, label: str = "person", score: float = 0.9) -> Instance:
    low, high = places.min(0) - 8, places.max(0) + 8
    return Instance(label, score, (*low, *(high - low)), b"")


def model(tmp_path, kind: str = "simcc", **options) -> PoseModel:
    settings = {"keypoint_full_confidence": options.get("gain", 1.0),
                "keypoint_heatmap_grid": options.get("grid", "msra")}  # fmt: skip
    path = getattr(tiny_pose, kind)(tmp_path / "pose.onnx", **options)
    return PoseModel.load(DetectionsSettings(keypoint_model=path, **settings))


def apart(people: np.ndarray, places: np.ndarray) -> float:
    """Largest distance, px, of the one person's dots."""
    (found,) = people
    assert (np.delete(found, SEEN, 0)[:, 2] == 0).all()
    return float(np.linalg.norm(found[SEEN, :2] - places, axis=1).max())


@pytest.mark.parametrize(
    ("kind", "options"),
    [("simcc", {}), ("simcc", {"size": (288, 384), "batch": 3}),
     ("simcc", {"names": ("simcc_y", "simcc_x"), "gain": 5.0}),
     ("simcc", {"names": ("x", "y"), "split": (1, 1), "batch": 1}),
     ("heatmaps", {}), ("heatmaps", {"size": (288, 384), "batch": 3}),
     ("heatmaps", {"grid": "udp", "gain": 5.0, "batch": 1}), ("heatmaps", {"stride": (2, 2)})],
)  # fmt: skip
def test_people_in_their_boxes(tmp_path, kind, options):
    image = tiny_pose.picture(SIZE, [LEFT, RIGHT])
    boxes = [around(LEFT, score=0.5), around(RIGHT), around(LEFT, "chair"), around(LEFT, score=0.2)]
    people = model(tmp_path, kind, **options).find(image, boxes)
    assert people.shape == (2, 135, 3)
    # SimCC: a pixel of the input, 1.3 of the image. Heatmaps: a fifth of a cell of 5.4 px.
    limit = 1.6 if kind == "simcc" else 1.0
    for person, places in zip(people, (RIGHT, LEFT), strict=True):
        assert apart(person[None], places) < limit
        assert (person[SEEN, 2] > 0.5 * options.get("gain", 1)).all()


def test_the_wrong_heatmap_grid_shifts_points_by_half_a_cell(tmp_path):
    """What the setting is for: up to 0.75 of a cell at the far edge."""
    image = tiny_pose.picture(SIZE, [LEFT])
    for grid, other in (("msra", "udp"), ("udp", "msra")):
        path = tiny_pose.heatmaps(tmp_path / f"{grid}.onnx", grid=grid)
        settings = DetectionsSettings(keypoint_model=path, keypoint_heatmap_grid=other)
        assert 2.0 < apart(PoseModel.load(settings).find(image, [around(LEFT)]), LEFT) < 4.5


@pytest.mark.parametrize(
    ("kind", "places"),
    [("simcc", LEFT), ("heatmaps", RIGHT), ("simcc", tiny_pose.person((115, 20), 330))],
)
def test_without_boxes_the_whole_image_is_searched(tmp_path, kind, places):
    image = tiny_pose.picture(SIZE, [places])
    people = model(tmp_path, kind).find(image, [around(places, "chair")])
    assert apart(people, places) < 1.6


def test_two_people_without_boxes_are_found_once_each(tmp_path):
    image = tiny_pose.picture(SIZE, [LEFT, RIGHT])
    people = model(tmp_path).find(image, [])
    assert len(people) == 2
    order = np.argsort(people[:, SEEN[0], 0])
    for index, places in zip(order, (LEFT, RIGHT), strict=True):
        assert apart(people[index][None], places) < 1.6


@pytest.mark.parametrize("kind", ["simcc", "heatmaps"])
def test_nobody_is_found_in_an_empty_image(tmp_path, kind):
    pose = model(tmp_path, kind)
    assert pose.find(tiny_pose.picture(SIZE, []), []).shape == (0, 135, 3)
    (ghost,) = pose.find(tiny_pose.picture(SIZE, []), [around(LEFT)])
    assert (ghost[:, 2] == 0).all(), "a detected box without a visible person"


def test_a_person_cut_by_the_edge_keeps_visible_points(tmp_path):
    places = tiny_pose.person((20.0, 40.0), 250)
    image = tiny_pose.picture(SIZE, [places])
    (found,) = model(tmp_path).find(image, [around(places)])
    inside = places[:, 0] > 8
    assert np.linalg.norm(found[SEEN, :2] - places, axis=1)[inside].max() < 1.6
    assert found[SEEN, 2][places[:, 0] < -20].max() < 0.3


@pytest.mark.parametrize("size", [(192, 256), (288, 384), (256, 256)])
def test_crops_are_those_of_mmpose(size):
    """Its own words: centre and size of the box, a quarter larger, widened to the input's shape; a
    point is at ``place / input size * size + centre - size / 2``."""
    rng = np.random.default_rng(0)
    for box in rng.uniform((0, 0, 20, 20), (900, 500, 500, 700), (20, 4)):
        centre, extent = box[:2] + box[2:] / 2, 1.25 * box[2:]
        aspect = size[0] / size[1]
        if extent[0] > extent[1] * aspect:
            extent = np.array([extent[0], extent[0] / aspect])
        else:
            extent = np.array([extent[1] * aspect, extent[1]])
        places = rng.uniform(0, size, (30, 2))
        expected = places / size * extent + centre - extent / 2
        crop = Crop.around(box, size, 1.25)
        np.testing.assert_allclose(crop.to_image(places), expected, atol=1e-9)


@pytest.mark.parametrize("size", [(1920, 1080), (640, 360), (1080, 1920), (300, 400), (100, 900)])
def test_tiles_cover_the_image(size):
    boxes = tiles(size, (192, 256))
    np.testing.assert_allclose(boxes[:, 2] / boxes[:, 3], 0.75)
    assert (boxes[:, :2] >= -1e-9).all() and (
        boxes[:, :2] + boxes[:, 2:] <= np.add(size, 1e-9)
    ).all()
    corners = (boxes[:, :2] + boxes[:, 2:]).max(0)
    np.testing.assert_allclose(boxes[:, :2].min(0), 0, atol=1e-9)
    np.testing.assert_allclose(corners, size)
    steps = np.diff(boxes[:, :2], axis=0).max(1)
    assert (steps <= boxes[0, 2:][int(size[0] < 0.75 * size[1])] / 2 + 1e-9).all()


def test_the_best_boxes_of_a_crowd_are_used():
    crowd = [around(LEFT + 5 * n, score=0.3 + n / 50) for n in range(20)]
    boxes = choose_person_boxes(crowd)
    assert len(boxes) == 10 and boxes[0, 0] == crowd[-1].box[0]
    assert choose_person_boxes([around(LEFT, score=0.29), around(LEFT, "cup")]).shape == (0, 4)


@pytest.mark.parametrize("kind", ["simcc", "heatmaps"])
def test_body_models_are_used_and_other_layouts_refused(tmp_path, kind):
    image = tiny_pose.picture(SIZE, [LEFT])
    (body,) = model(tmp_path, kind, layout=BODY).find(image, [around(LEFT)])
    assert body[KEYPOINT_NAMES.index("left_knee"), 2] > 0.5 and (body[25:, 2] == 0).all()
    with pytest.raises(
        UserError, match="has 21 keypoints, expected one of 17, 23, 25, 26, 133, 134"
    ):
        model(tmp_path, kind, layout=tuple(tiny_pose.NAMES[:21]))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: tiny_onnx.thresholder(p), r"outputs \(out \[1, 1, 32, 32\]\) are not those"),
        (lambda p: tiny_onnx.yolo(p, (160, 160), {}), "are not those of a pose model"),
        (lambda p: p.write_text("no model"), "is no ONNX model that can be run"),
        (lambda p: None, "cannot be read .No such file"),
        (lambda p: tiny_pose.heatmaps(p, stride=(4, 8)), r"133, 32, 48\].* not those of a pose"),
    ],
)
def test_models_of_another_kind_are_refused(tmp_path, make, words):
    path = tmp_path / "pose.onnx"
    make(path)
    with pytest.raises(UserError, match=words):
        PoseModel.load(DetectionsSettings(keypoint_model=path))


def test_unequal_bins_are_refused(tmp_path):
    pose = model(tmp_path, split=(2, 3))
    with pytest.raises(UserError, match=r"\[1, 133, 384\]; \[1, 133, 768\].* not those of a pose"):
        pose.find(tiny_pose.picture(SIZE, []), [around(LEFT)])


def test_a_layout_in_the_models_metadata_is_used(tmp_path, monkeypatch):
    monkeypatch.setitem(layouts(), "mirrored", KeypointLayout("mirrored", BODY[::-1]))
    image, mirrored = tiny_pose.picture(SIZE, [LEFT]), model(tmp_path, layout=BODY)
    (body,) = mirrored.find(image, [around(LEFT)])
    mirrored._model.metadata["keypoint_layout"] = "mirrored"
    (other,) = mirrored.find(image, [around(LEFT)])
    at = [KEYPOINT_NAMES.index(name) for name in BODY]
    np.testing.assert_array_equal(other[at], body[at[::-1]])
