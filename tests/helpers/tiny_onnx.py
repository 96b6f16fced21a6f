"""Tiny ONNX models that detect red and blue areas, with the outputs of well-known exports.

Each colour's mask, box and score are computed in the graph from the input image, so that errors of
pre- and postprocessing show in the result.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

CONTRAST = 0.4  # of one channel against the other two, of 1
OPSET = 17


class Graph:
    """Nodes that are added one after another."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._count = 0

    def add(self, op: str, *inputs: str, name: str | None = None, **attributes) -> str:
        self._count += 1
        output = name or f"v{self._count}"
        self.nodes.append(helper.make_node(op, list(inputs), [output], **attributes))
        return output

    def constant(self, values, dtype=np.float32) -> str:
        self._count += 1
        array = np.asarray(values, dtype)
        self.constants.append(numpy_helper.from_array(array, f"c{self._count}"))
        return f"c{self._count}"

    def save(self, path: Path, inputs, outputs, metadata: dict[str, str] | None = None) -> Path:
        graph = helper.make_graph(
            self.nodes,
            "tiny",
            [helper.make_tensor_value_info(*i) for i in inputs],
            [helper.make_tensor_value_info(*o) for o in outputs],
            self.constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
        model.ir_version = 9
        for key, value in (metadata or {}).items():
            model.metadata_props.append(onnx.StringStringEntryProto(key=key, value=value))
        onnx.checker.check_model(model)
        onnx.save(model, path)
        return path


def _colour_masks(graph: Graph, image: str, red_channel: int, unit: float) -> list[str]:
    """Masks (1, 1, H, W) float 0 or 1 of red and of blue in an image (1, 3, H, W)."""
    channels = [
        graph.add("Slice", image, *(graph.constant([n], np.int64) for n in (c, c + 1, 1)))
        for c in range(3)
    ]
    found = []
    for own in (red_channel, 2 - red_channel):
        others = graph.add("Max", *(channels[c] for c in range(3) if c != own))
        difference = graph.add("Sub", channels[own], others)
        bright = graph.add("Greater", difference, graph.constant(CONTRAST * unit))
        found.append(graph.add("Cast", bright, to=TensorProto.FLOAT))
    return found


def _corners(graph: Graph, mask: str) -> list[str]:
    """x0, y0, x1, y1 of a mask, each (1, 1), in pixel edges."""
    found = {}
    for axis, name in ((3, "x"), (2, "y")):
        other = 5 - axis
        line = graph.add("ReduceMax", mask, axes=[other], keepdims=1)
        line = graph.add("Reshape", line, graph.constant([1, -1], np.int64))
        length = graph.add("Gather", graph.add("Shape", mask), graph.constant(axis, np.int64))
        upto = graph.add("Range", graph.constant(0, np.int64), length, graph.constant(1, np.int64))
        place = graph.add("Cast", upto, to=TensorProto.FLOAT)
        number = graph.add("Cast", length, to=TensorProto.FLOAT)
        after = graph.add("Add", place, graph.constant(1.0))
        high = graph.add("ReduceMax", graph.add("Mul", line, after), axes=[1], keepdims=1)
        back = graph.add("Mul", line, graph.add("Sub", number, place))
        low = graph.add("Sub", number, graph.add("ReduceMax", back, axes=[1], keepdims=1))
        found[name] = (low, high)
    return [found["x"][0], found["y"][0], found["x"][1], found["y"][1]]


def _score(graph: Graph, mask: str, value: float) -> str:
    """``value`` where anything is set, else 0: (1, 1)."""
    any_set = graph.add("ReduceMax", mask, axes=[1, 2, 3], keepdims=1)
    flat = graph.add("Reshape", any_set, graph.constant([1, 1], np.int64))
    return graph.add("Mul", flat, graph.constant(value))


def yolo(
    path: Path, size: tuple[int, int], metadata: dict[str, str], *, ends_itself: bool = False
) -> Path:
    """Red is class 0 (0.9, and a worse box 0.6), blue class 1 (0.8); one prototype a colour.

    ``size`` (width, height) of the input. ``ends_itself``: overlaps are suppressed in the model.
    """
    graph = Graph()
    masks = _colour_masks(graph, "images", 0, 1.0)
    both = graph.add("Concat", *masks, axis=1)
    pooled = graph.add("AveragePool", both, kernel_shape=[4, 4], strides=[4, 4])
    centred = graph.add("Sub", pooled, graph.constant(0.5))
    graph.add("Mul", centred, graph.constant(10.0), name="output1")
    zero = graph.constant([[0.0]])
    one = graph.constant([[1.0]])
    rows = []
    for k, (mask, score) in enumerate(zip(masks, (0.9, 0.8), strict=True)):
        x0, y0, x1, y1 = _corners(graph, mask)
        own, weights = _score(graph, mask, score), [one, zero] if k == 0 else [zero, one]
        if ends_itself:
            number = graph.constant([[float(k)]])
            rows.append(graph.add("Concat", x0, y0, x1, y1, own, number, *weights, axis=1))
            continue
        half = graph.constant(0.5)
        middle = [graph.add("Mul", graph.add("Add", a, b), half) for a, b in ((x0, x1), (y0, y1))]
        extent = [graph.add("Sub", b, a) for a, b in ((x0, x1), (y0, y1))]
        classes = [own, zero] if k == 0 else [zero, own]
        rows.append(graph.add("Concat", *middle, *extent, *classes, *weights, axis=1))
        if k == 0:
            worse = _score(graph, mask, 0.6)
            wider = graph.add("Mul", extent[0], graph.constant(1.1))
            rows.append(
                graph.add("Concat", *middle, wider, extent[1], worse, zero, *weights, axis=1)
            )
    table = graph.add("Concat", *rows, axis=0)
    if not ends_itself:
        table = graph.add("Transpose", table, perm=[1, 0])
    graph.add("Unsqueeze", table, graph.constant([0], np.int64), name="output0")
    shape = [1, 2, 8] if ends_itself else [1, 8, 3]
    width, height = size
    return graph.save(
        path,
        [("images", TensorProto.FLOAT, [1, 3, height, width])],
        [
            ("output0", TensorProto.FLOAT, shape),
            ("output1", TensorProto.FLOAT, [1, 2, height // 4, width // 4]),
        ],
        metadata,
    )


def mask_rcnn(path: Path, family: str) -> Path:
    """Red is a suitcase (0.9), blue a cup (0.8), as ``family`` numbers COCO's classes.

    ``torchvision``: RGB of 0 to 1, masks over the image. ``detectron2``: BGR of 0 to 255, masks
    over the box, the image's size last, in its order and without names. ``benchmark``: as the
    model zoo's, BGR less the mean, classes from 1.
    """
    graph = Graph()
    image = graph.add("Unsqueeze", "image", graph.constant([0], np.int64))
    if family == "benchmark":
        mean = np.array([102.9801, 115.9465, 122.7717]).reshape(1, 3, 1, 1)
        image = graph.add("Add", image, graph.constant(mean))
    rgb = family == "torchvision"
    masks = _colour_masks(graph, image, 0 if rgb else 2, 1.0 if rgb else 255.0)
    corners = [graph.add("Concat", *_corners(graph, mask), axis=1) for mask in masks]
    boxes = graph.add("Concat", *corners, axis=0, name="boxes")
    red_score, blue_score = _score(graph, masks[0], 0.9), _score(graph, masks[1], 0.8)
    scores = graph.add("Concat", red_score, blue_score, axis=1)
    scores = graph.add("Reshape", scores, graph.constant([2], np.int64), name="s")
    numbers = {"torchvision": [33, 47], "detectron2": [28, 41], "benchmark": [29, 42]}[family]
    labels = graph.add("Identity", graph.constant(numbers, np.int64), name="l")
    both = graph.add("Concat", *masks, axis=0)
    if rgb:
        soft, lengths = graph.add("Identity", both, name="m"), ["height", "width"]
    else:
        which = graph.constant([0, 1], np.int64)
        soft = graph.add(
            "RoiAlign", both, boxes, which, name="m", output_height=28, output_width=28,
            sampling_ratio=2,
        )  # fmt: skip
        lengths = [28, 28]
    declared = {
        boxes: (TensorProto.FLOAT, [2, 4]),
        labels: (TensorProto.INT64, [2]),
        scores: (TensorProto.FLOAT, [2]),
        soft: (TensorProto.FLOAT, [2, 1, *lengths]),
    }
    order = [boxes, labels, scores, soft]
    if family == "detectron2":
        shape = graph.add("Shape", "image", start=1, name="size")
        declared[shape] = (TensorProto.INT64, [2])
        order = [boxes, labels, soft, scores, shape]
    outputs = []
    for number, key in enumerate(order):
        name = graph.add("Identity", key, name=f"{100 + number}")
        outputs.append((name, *declared[key]))
    return graph.save(path, [("image", TensorProto.FLOAT, [3, "height", "width"])], outputs)


def thresholder(path: Path) -> Path:
    """A model with an output that no export has."""
    graph = Graph()
    graph.add("ReduceMax", "image", axes=[1], keepdims=1, name="out")
    return graph.save(
        path,
        [("image", TensorProto.FLOAT, [1, 3, 32, 32])],
        [("out", TensorProto.FLOAT, [1, 1, 32, 32])],
    )
