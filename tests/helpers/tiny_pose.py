"""Tiny ONNX models with the outputs of RTMPose or HRNet that detect people of coloured dots.

The responses are computed in the graph from the input image, so that errors of pre- and
postprocessing show in the result.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path

import cv2
import numpy as np
from onnx import TensorProto

from intercap_core.formats.detections.keypoints.coco import WHOLE_BODY
from tests.helpers.tiny_onnx import Graph

MEAN = np.array([123.675, 116.28, 103.53])
DEVIATION = np.array([58.395, 57.12, 57.375])
LEVELS = (60, 155, 250)
COLOURS = np.array([c for c in product(LEVELS, repeat=3) if len(set(c)) > 1], float)  # RGB
REACH = 45.0  # in colour; colours are 95 apart
BLUR = 11  # pixels of the input, twice: the response peaks in a dot's middle
STRENGTH = 2.0  # of a dot's response, which blur lowers
# Where a person of height 1 has its dots: right, down, from the middle of its top.
PLACES = {
    "nose": (0, 0.12), "left_eye": (0.09, 0.05), "right_eye": (-0.09, 0.05),
    "left_shoulder": (0.14, 0.22), "right_shoulder": (-0.14, 0.22), "left_elbow": (0.20, 0.33),
    "right_elbow": (-0.20, 0.33), "left_wrist": (0.19, 0.45), "right_wrist": (-0.22, 0.46),
    "left_hip": (0.06, 0.54), "right_hip": (-0.06, 0.54), "left_knee": (0.09, 0.74),
    "right_knee": (-0.09, 0.74), "left_ankle": (0.10, 0.91), "right_ankle": (-0.10, 0.91),
    "left_big_toe": (0.18, 0.98), "right_heel": (-0.02, 0.99), "face_8": (0, 0.22),
    "face_27": (0, 0.02), "left_index_tip": (0.29, 0.56), "left_thumb_tip": (0.19, 0.55),
    "right_pinky_tip": (-0.29, 0.55), "right_thumb_tip": (-0.19, 0.56),
    "left_hand_wrist": (0.29, 0.46),
}  # fmt: skip
NAMES = tuple(PLACES)


def person(top: tuple[float, float], height: float) -> np.ndarray:
    """Dots (24, 2) of a person whose head's top is at ``top``."""
    return np.array(top) + height * np.array([PLACES[name] for name in NAMES])


def picture(size: tuple[int, int], people: list[np.ndarray], radius: int = 8) -> np.ndarray:
    """An image (H, W, 3) BGR with each person's dots."""
    image = np.zeros((size[1], size[0], 3), np.uint8)
    for places in people:
        for place, colour in zip(places, COLOURS, strict=True):
            centre = tuple(int(v) for v in np.rint(place * 16))
            cv2.circle(image, centre, radius * 16, colour[::-1].tolist(), -1, cv2.LINE_AA, 4)
    return image


def _responses(graph: Graph) -> str:
    """(B, 24, H, W): how near each pixel's surroundings are to each dot's colour."""
    deviation, mean = (graph.constant(v.reshape(1, 3, 1, 1) / 255) for v in (DEVIATION, MEAN))
    pixels = graph.add("Add", graph.add("Mul", "input", deviation), mean)
    square = graph.add("ReduceSumSquare", pixels, axes=[1], keepdims=1)
    both = graph.add("Concat", pixels, square, axis=1)
    colours = COLOURS / 255
    weights = np.column_stack([2 * colours, -np.ones(len(colours))]) / (REACH / 255) ** 2
    offset = 1 - (colours**2).sum(1) / (REACH / 255) ** 2
    near = graph.add("Conv", both, graph.constant(weights[..., None, None]), graph.constant(offset))
    smooth = graph.add("Relu", near)
    for _ in range(2):
        smooth = graph.add(
            "AveragePool", smooth, kernel_shape=[BLUR, BLUR], strides=[1, 1],
            pads=[BLUR // 2] * 4, count_include_pad=1,
        )  # fmt: skip
    return smooth


def _choice(layout: tuple[str, ...], gain: float) -> np.ndarray:
    """(K, 24): which dot is which point of the layout."""
    choice = np.zeros((len(layout), len(NAMES)))
    for i, name in enumerate(NAMES):
        if name in layout:
            choice[layout.index(name), i] = STRENGTH * gain
    return choice


def simcc(
    path: Path,
    size: tuple[int, int] = (192, 256),
    *,
    batch: int | None = None,
    gain: float = 1.0,
    names: tuple[str, str] = ("simcc_x", "simcc_y"),
    layout: tuple[str, ...] = WHOLE_BODY,
    split: tuple[int, int] = (2, 2),
) -> Path:
    """Points of ``layout``, those in NAMES by their colour, in ``split`` bins a pixel (x, y).

    Outputs come in the order of ``names``; the one with an x is of columns.
    """
    graph = Graph()
    smooth = _responses(graph)
    choice = _choice(layout, gain)
    count = len(layout)
    declared = {}
    for kind, axis, bins, length in (
        ("x", 2, split[0], size[0]), ("y", 3, split[1], size[1]),
    ):  # fmt: skip
        line = graph.add("ReduceMax", smooth, axes=[axis], keepdims=0)
        finer = graph.add(
            "Resize", line, "", graph.constant([1, 1, bins]), mode="nearest",
            coordinate_transformation_mode="asymmetric", nearest_mode="floor",
        )  # fmt: skip
        name = next(n for n in names if kind in n.removeprefix("simcc"))
        graph.add("MatMul", graph.constant(choice), finer, name=name)
        declared[name] = (TensorProto.FLOAT, [batch or "batch", count, bins * length])
    width, height = size
    return graph.save(
        path,
        [("input", TensorProto.FLOAT, [batch or "batch", 3, height, width])],
        [(name, *declared[name]) for name in names],
    )


def heatmaps(
    path: Path,
    size: tuple[int, int] = (192, 256),
    *,
    batch: int | None = None,
    gain: float = 1.0,
    layout: tuple[str, ...] = WHOLE_BODY,
    stride: tuple[int, int] = (4, 4),
    grid: str = "msra",
) -> Path:
    """The same in maps of cells ``stride`` (x, y) pixels wide: with "msra" cell i is pixel
    i stride's response, with "udp" cells lie from the first to the last pixel."""
    graph = Graph()
    smooth = _responses(graph)
    cells = (size[0] // stride[0], size[1] // stride[1])
    if grid == "msra":
        ints = ([0, 0], [size[1], size[0]], [2, 3], stride[::-1])
        coarse = graph.add("Slice", smooth, *(graph.constant(v, np.int64) for v in ints))
    else:
        coarse = graph.add(
            "Resize", smooth, "", graph.constant([1, 1, cells[1] / size[1], cells[0] / size[0]]),
            mode="linear", coordinate_transformation_mode="align_corners",
        )  # fmt: skip
    choice = _choice(layout, gain)[..., None, None]
    graph.add("Conv", coarse, graph.constant(choice), name="output")
    shape = [batch or "batch", len(layout), *cells[::-1]]
    return graph.save(
        path,
        [("input", TensorProto.FLOAT, [batch or "batch", 3, size[1], size[0]])],
        [("output", TensorProto.FLOAT, shape)],
    )
