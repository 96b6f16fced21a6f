"""Segmentation models from the image to the instance, on models that find red and blue things."""

from __future__ import annotations

import builtins
import json
import os

import cv2
import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
tiny_onnx = pytest.importorskip("tests.helpers.tiny_onnx", exc_type=ImportError)

from intercap_core.config import DetectionsSettings  # noqa: E402
from intercap_core.errors import UserError  # noqa: E402
from intercap_core.formats.detections.class_names import read_label_map  # noqa: E402
from intercap_core.formats.detections.onnx_model import OnnxModel, parse_names, place_picture  # noqa: E402
from intercap_core.formats.detections.onnx_segmentation import Segmenter, suppress_overlaps  # noqa: E402
from intercap_core.geometry.camera import masks  # noqa: E402

WIDTH, HEIGHT = 320, 180
NAMES = {"names": "{0: 'suitcase', 1: 'cup'}", "task": "segment", "imgsz": "[160, 160]"}
GREY, RED, BLUE = (120, 120, 120), (20, 20, 230), (230, 20, 20)  # BGR


def picture(red=(60, 90), blue=(230, 60)):
    image = np.full((HEIGHT, WIDTH, 3), GREY, np.uint8)
    shapes = {}
    for name, centre, colour in (("suitcase", red, RED), ("cup", blue, BLUE)):
        if centre is None:
            continue
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.ellipse(mask, centre, (34, 22), 30, 0, 360, 1, -1)
        image[mask > 0] = colour
        shapes[name] = mask > 0
    return image, shapes


def found(settings, images):
    segmenter = Segmenter.load(settings)
    return dict(segmenter.segment(enumerate(images)))


def overlap(instance, mask):
    found = masks.decode(instance.rle, HEIGHT, WIDTH)
    return (found & mask).sum() / (found | mask).sum()


@pytest.mark.parametrize(
    "make",
    [
        lambda path: tiny_onnx.yolo(path, (160, 160), NAMES),
        lambda path: tiny_onnx.yolo(path, (192, 128), NAMES),
        lambda path: tiny_onnx.yolo(path, (160, 160), NAMES, ends_itself=True),
        lambda path: tiny_onnx.mask_rcnn(path, "torchvision"),
        lambda path: tiny_onnx.mask_rcnn(path, "detectron2"),
        lambda path: tiny_onnx.mask_rcnn(path, "benchmark"),
    ],
    ids=["yolo", "yolo wide", "yolo end to end", "torchvision", "detectron2", "benchmark"],
)
def test_every_kind_of_export_finds_masks_labels_and_scores(tmp_path, make):
    settings = DetectionsSettings(segmentation_model=make(tmp_path / "model.onnx"))
    (image, shapes), (lonely, _) = picture(), picture(red=None)
    results = found(settings, [image, lonely])
    assert [i.label for i in results[0]] == ["suitcase", "cup"]
    assert [i.label for i in results[1]] == ["cup"]
    for instance, score in zip(results[0], (0.9, 0.8), strict=True):
        mask = shapes[instance.label]
        assert instance.score == pytest.approx(score)
        assert overlap(instance, mask) > 0.9, instance.label
        y, x = np.nonzero(mask)
        expected = [x.min(), y.min(), np.ptp(x) + 1, np.ptp(y) + 1]
        assert np.abs(np.array(instance.box) - expected).max() <= 3


def test_masks_over_the_whole_image_are_exact(tmp_path):
    model = tiny_onnx.mask_rcnn(tmp_path / "model.onnx", "torchvision")
    image, shapes = picture()
    for instance in found(DetectionsSettings(segmentation_model=model), [image])[0]:
        np.testing.assert_array_equal(
            masks.decode(instance.rle, HEIGHT, WIDTH), shapes[instance.label]
        )


def test_class_names_from_a_file_and_the_least_score(tmp_path):
    labels = tmp_path / "names.txt"
    labels.write_text("red thing\nblue thing\n")
    settings = DetectionsSettings(
        segmentation_model=tiny_onnx.yolo(tmp_path / "model.onnx", (160, 160), NAMES),
        segmentation_labels=labels,
        min_score=0.85,
    )
    assert [i.label for i in found(settings, [picture()[0]])[0]] == ["red thing"]


def test_the_pixel_values_of_the_input_can_be_set(tmp_path):
    model = tiny_onnx.mask_rcnn(tmp_path / "model.onnx", "torchvision")
    settings = DetectionsSettings(segmentation_model=model, segmentation_input="bgr255")
    image, shapes = picture()
    best, _ = found(settings, [image])[0]
    assert overlap(best, shapes["cup"]) > 0.95, "blue is where the model looks for red"


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("{0: 'person', 1: 'sports ball'}", {0: "person", 1: "sports ball"}),
        ('{"0": "person", "7": "it\'s, {a} cup"}', {0: "person", 7: "it's, {a} cup"}),
        ("{0: 'it\\'s'}", {0: "it's"}),
        ("['a', \"b\",]", {0: "a", 1: "b"}),
        ("{}", {}),
        ("", {}),
        ("{0: __import__('os').system('true')}", {}),
        ("{0: 'a', 1: }", {}),
        ("{" * 10000, {}),
        ("{0: 'a" + "\\" * 5000, {}),
    ],
)
def test_names_in_the_model_are_read_and_never_run(text, names):
    assert parse_names(text) == names


@pytest.mark.parametrize("size", [(640, 640), (320, 192), (57, 91)])
@pytest.mark.parametrize("centred", [True, False])
def test_pictures_keep_their_shape_and_boxes_come_back(size, centred):
    fit = place_picture((1920, 1080), size, centred=centred)
    box = np.array([[100.0, 200.0, 900.0, 1000.0]], np.float32)
    inside = box * np.array(fit.scale * 2) + np.array([fit.left, fit.top] * 2)
    np.testing.assert_allclose(fit.to_image(inside), box, atol=1e-3)
    assert abs(fit.scale[0] / fit.scale[1] - 1) < 0.05
    assert fit.left >= 0 and fit.left + round(1920 * fit.scale[0]) <= size[0]


def test_overlapping_boxes_of_one_class_leave_the_best():
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [0, 0, 10, 10], [30, 30, 40, 40]], float)
    kept = suppress_overlaps(boxes, np.array([0.5, 0.9, 0.8, 0.7]), np.array([0, 0, 1, 0]))
    assert kept.tolist() == [1, 2, 3]


def _cut(path):
    tiny_onnx.yolo(path, (160, 160), NAMES)
    path.write_bytes(path.read_bytes()[:300])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: path.write_bytes(b"not a model"), "no ONNX model"),
        (_cut, "no ONNX model"),
        (tiny_onnx.thresholder, "no kind that is known"),
        (lambda path: tiny_onnx.yolo(path, (160, 160), {"task": "detect"}), "model for 'detect'"),
    ],
)
def test_unusable_models_are_refused(tmp_path, make, words):
    path = tmp_path / "model.onnx"
    make(path)
    with pytest.raises(UserError, match=words) as caught:
        Segmenter.load(DetectionsSettings(segmentation_model=path))
    assert str(path) in str(caught.value)


def constant_rcnn(path, boxes=(10, 10, 90, 90), score=0.9, mask=(HEIGHT, WIDTH)):
    """A Mask R-CNN that says the same of every image."""
    graph = tiny_onnx.Graph()
    outputs = []
    for name, value, kind in (
        ("boxes", np.reshape(boxes, (-1, 4)), np.float32),
        ("labels", np.ones(1), np.int64),
        ("scores", [score], np.float32),
        ("masks", np.ones((1, 1, *mask)), np.float32),
    ):
        graph.add("Identity", graph.constant(value, kind), name=name)
        element = onnx.TensorProto.INT64 if kind is np.int64 else onnx.TensorProto.FLOAT
        outputs.append((name, element, [None] * np.ndim(value)))
    return graph.save(path, [("image", onnx.TensorProto.FLOAT, [3, "height", "width"])], outputs)


@pytest.mark.parametrize(
    ("outputs", "words"),
    [
        ({}, None),
        ({"score": 50.0}, "scores up to 50"),
        ({"boxes": [10, np.nan, 90, 90]}, "no numbers"),
        ({"mask": (0, 0)}, "outputs"),
        ({"mask": (1, 40_000)}, "outputs"),
    ],
)
def test_impossible_outputs_are_refused(tmp_path, outputs, words):
    model = constant_rcnn(tmp_path / "model.onnx", **outputs)
    settings = DetectionsSettings(segmentation_model=model)
    if words is None:
        assert len(found(settings, [picture()[0]])[0]) == 1
        return
    with pytest.raises(UserError, match=rf"model\.onnx: .*{words}"):
        found(settings, [picture()[0]])


def huge_input(*shape):
    def change(model):
        for axis, length in zip(
            model.graph.input[0].type.tensor_type.shape.dim, shape, strict=True
        ):
            axis.dim_value = length

    return change


def external_data(model, location="/dev/zero"):
    constant = model.graph.initializer[0]
    constant.data_location = onnx.TensorProto.EXTERNAL
    length = len(constant.raw_data)
    constant.ClearField("raw_data")
    for key, value in (("location", location), ("offset", "0"), ("length", str(length))):
        constant.external_data.add(key=key, value=value)


@pytest.mark.parametrize(
    "change",
    [
        huge_input(1, 3, 40_000, 40_000), huge_input(1, 3, 10**9, 10**9),
        huge_input(10**9, 3, 64, 64), external_data,
    ],
)  # fmt: skip
def test_models_that_would_fill_the_memory_are_refused(tmp_path, change):
    path = tiny_onnx.yolo(tmp_path / "model.onnx", (160, 160), NAMES)
    model = onnx.load(path)
    change(model)
    path.write_bytes(model.SerializeToString())
    with pytest.raises(UserError, match=r"model\.onnx"):
        found(DetectionsSettings(segmentation_model=path), [picture()[0]])


@pytest.mark.parametrize("target", ["/dev/zero", "pipe"])
def test_weights_outside_the_file_are_files(tmp_path, target):
    path = tiny_onnx.yolo(tmp_path / "model.onnx", (160, 160), NAMES)
    model = onnx.load(path)
    external_data(model, "weights.bin")
    path.write_bytes(model.SerializeToString())
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "weights.bin").symlink_to(target)
    with pytest.raises(
        UserError, match=r"weights\.bin: cannot be read .it is a .*export model.onnx"
    ):
        OnnxModel.load(path)


def test_a_missing_device_is_refused(tmp_path):
    import onnxruntime

    if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
        pytest.skip("this machine has CUDA")
    path = tiny_onnx.yolo(tmp_path / "model.onnx", (160, 160), NAMES)
    with pytest.raises(UserError, match=r"finds no cuda here.*onnxruntime-gpu"):
        OnnxModel.load(path, "cuda")


def test_without_the_runtime_the_extra_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "onnxruntime":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(UserError, match=r"intercap-core\[onnx\]"):
        OnnxModel.load(tmp_path / "model.onnx")


@pytest.mark.parametrize(
    ("name", "text", "names"),
    [
        ("a.txt", "person\nsports ball\n", {0: "person", 1: "sports ball"}),
        ("a.json", '["person", "cup"]', {0: "person", 1: "cup"}),
        ("a.json", '{"1": "person", "47": "cup"}', {1: "person", 47: "cup"}),
        ("a.json", '{"categories": [{"id": 3, "name": "cup", "synonyms": ["mug"]}]}', {3: "cup"}),
        ("a.yaml", "names:\n  0: person\n  1: cup\n", {0: "person", 1: "cup"}),
        ("a.yaml", "names: [person, cup]\n", {0: "person", 1: "cup"}),
    ],
)
def test_label_maps(tmp_path, name, text, names):
    (tmp_path / name).write_text(text)
    assert read_label_map(tmp_path / name) == names


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.json", "["),
        ("a.json", "3"),
        ("a.json", '{"a": "b"}'),
        ("a.json", "[]"),
        ("a.json", json.dumps([{"id": 1, "name": "a"}, {"id": 1, "name": "b"}])),
        ("a.yaml", "a: [1"),
        ("a.yaml", "!!python/object/apply:os.system ['true']"),
        ("a.txt", ""),
        ("a.txt", "c" * 500),
    ],
)
def test_wrong_label_maps_are_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match="is no list of classes"):
        read_label_map(tmp_path / name)
