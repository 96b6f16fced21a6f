"""Whole-body keypoints by a user's ONNX model: RTMPose, DWPose, HRNet or ViTPose exports, top down.

The input of such a model is one person, cut out around a box. The output is the likelihood of every
point, in one of two forms. SimCC has one value for each column and one for each row, in bins finer
than pixels. A heatmap has one value for each cell of a map that is coarser than the input.

Cropping and decoding follow mmpose: the box is enlarged by a quarter and widened to the input's
aspect ratio; pixels are RGB, normalised by ImageNet's mean and standard deviation.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from intercap_core.body.keypoints import BODY
from intercap_core.config import DetectionsSettings
from intercap_core.errors import UserError
from intercap_core.formats.detections.instance import PERSON_LABEL, Instance
from intercap_core.formats.detections.keypoints import LAYOUT_KEY, find_layout, to_shared
from intercap_core.formats.detections.onnx_model import FLOATS, OnnxModel

HeatmapGrid = Literal["msra", "udp"]

_EDGE = 2  # cells at the border, where there is no second difference
BOX_PADDING = 1.25  # factor on a person's box, as in mmpose's training and tests
MAX_PEOPLE = 10  # in one image


@dataclass(frozen=True)
class Crop:
    """Part of an image that is the model's input: input = (image - corner) * scale, pixels."""

    corner: tuple[float, float]
    """x, y of the input's upper left corner in the image, px."""
    scale: float
    """Pixels of the input for one of the image."""

    @classmethod
    def around(cls, box: np.ndarray, size: tuple[int, int], padding: float) -> Crop:
        """Make the crop around a box (x, y, width, height) for an input of ``size``."""
        x, y, width, height = (float(v) for v in box)
        scale = min(size[0] / max(width, 1), size[1] / max(height, 1)) / padding
        middle = (x + width / 2, y + height / 2)
        return cls((middle[0] - size[0] / (2 * scale), middle[1] - size[1] / (2 * scale)), scale)

    def cut(self, picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Cut the crop out of a picture (H, W, 3); it is black beyond the picture's edge."""
        shift = -self.scale * np.array(self.corner)
        matrix = np.array([[self.scale, 0, shift[0]], [0, self.scale, shift[1]]])
        return cv2.warpAffine(picture, matrix, size, flags=cv2.INTER_LINEAR)

    def to_image(self, points: np.ndarray) -> np.ndarray:
        """Map points (..., 2) from the input to the image."""
        return points / self.scale + np.array(self.corner)


class PoseModel:
    """A model of people's keypoints; obtained from :meth:`load`."""

    def __init__(
        self,
        model: OnnxModel,
        outputs: tuple[int, ...],
        full_confidence: float,
        grid: HeatmapGrid,
    ) -> None:
        """``outputs``: positions of the model's columns and rows, or of its heatmaps.
        ``full_confidence``: the model's response to a point that is certain."""
        assert model.size is not None
        self._model, self._outputs, self._size = model, outputs, model.size
        self._full_confidence, self._grid = full_confidence, grid

    @classmethod
    def load(cls, settings: DetectionsSettings) -> PoseModel:
        """Open the model that the settings name; raises UserError if it is no pose model."""
        assert settings.keypoint_model is not None
        model = OnnxModel.load(settings.keypoint_model, settings.keypoint_device)
        outputs = _simcc_outputs(model) or _heatmap_output(model)
        if outputs is None or not model.batched:
            raise _unknown(model, [f"{n} {list(shape)}" for n, shape, _ in model.outputs])
        if model.size is None:
            raise UserError(
                f"{model.path}: its input has no fixed width and height; export it with a fixed "
                "size, such as 288x384, and any number of people"
            )
        count = model.outputs[outputs[0]][1][1]
        if isinstance(count, int):
            _point_names(model, count)
        return cls(
            model, outputs, settings.keypoint_full_confidence, settings.keypoint_heatmap_grid
        )

    def find(self, picture: np.ndarray, instances: list[Instance]) -> np.ndarray:
        """Find the keypoints (P, 135, 3) of P people in a picture (H, W, 3) uint8 BGR.

        They are x, y and the model's own confidence, ordered as in ``body.keypoints``.

        The model looks at the people among ``instances``, best first. Without any, it looks at
        tiles of the whole image and then at the people found in them.
        """
        size = (picture.shape[1], picture.shape[0])
        boxes = choose_person_boxes(instances)
        if len(boxes):
            return self._people_in(picture, boxes, BOX_PADDING)
        people, boxes = self._distinct(self._people_in(picture, tiles(size, self._size), 1.0))
        if len(boxes):
            people, _ = self._distinct(self._people_in(picture, boxes, BOX_PADDING))
        return people

    def _distinct(self, people: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Confident people among (P, 135, 3), each once, best first, and their boxes (N, 4).

        A point is confident from 0.3 of the full confidence. A person needs six confident points of
        the body. A detection is a duplicate if half of its confident points lie near the same
        points of better detections: closer than 5 % of the diagonal of its box. Tuned on the
        studio.
        """
        sure = people[..., 2] >= 0.3 * self._full_confidence
        accepted = sure[:, BODY].sum(1) >= 6
        people, sure = people[accepted], sure[accepted]
        if not len(people):
            return people, np.zeros((0, 4))
        low = np.where(sure[..., None], people[..., :2], np.inf).min(1)
        high = np.where(sure[..., None], people[..., :2], -np.inf).max(1)
        best_first = np.argsort(-people[:, BODY, 2].mean(1), kind="stable")
        kept: list[int] = []
        for i in best_first.tolist():
            near = 0.05 * np.linalg.norm(high[i] - low[i])
            distance = np.linalg.norm(people[kept, :, :2] - people[i, :, :2], axis=-1)
            shared = ((distance < near) & sure[kept]).any(0)
            if shared[sure[i]].mean() < 0.5:
                kept.append(i)
        return people[kept][:MAX_PEOPLE], np.concatenate([low, high - low], 1)[kept][:MAX_PEOPLE]

    def _people_in(self, picture: np.ndarray, boxes: np.ndarray, padding: float) -> np.ndarray:
        """One person (N, 135, 3) in each of the boxes (N, 4) of x, y, width, height."""
        crops = [Crop.around(box, self._size, padding) for box in boxes]
        people = [points for batch in self._batches(picture, crops) for points in batch]
        for crop, points in zip(crops, people, strict=True):
            points[:, :2] = crop.to_image(points[:, :2])
        return to_shared(np.stack(people), _point_names(self._model, len(people[0])))

    def _batches(self, picture: np.ndarray, crops: list[Crop]) -> Iterator[np.ndarray]:
        """Points (B, K, 3) in the input's pixels."""
        most = self._model.batch or 8
        for start in range(0, len(crops), most):
            part = crops[start : start + most]
            images = np.stack(
                [
                    self._model.to_input_values(crop.cut(picture, self._size), "imagenet")
                    for crop in part
                ]
            )
            outputs = self._model.run(images)
            yield self._points([outputs[i] for i in self._outputs], len(part))[: len(part)]

    def _points(self, responses: list[np.ndarray], people: int) -> np.ndarray:
        """Points (B, K, 3) of columns (B, K, X) and rows (B, K, Y), or of heatmaps (B, K, h, w)."""
        shapes = [r.shape for r in responses]
        if any(len(shape) < 3 or shape[0] < people for shape in shapes):
            raise _unknown(self._model, [str(list(shape)) for shape in shapes])
        if len(responses) == 2 and _same_bins(shapes, self._size):
            return decode_simcc(responses[0], responses[1], self._size)
        if len(responses) == 1 and _coarser(shapes[0][2:], self._size):
            return decode_heatmaps(responses[0], self._size, self._grid)
        raise _unknown(self._model, [str(list(shape)) for shape in shapes])


def choose_person_boxes(instances: list[Instance]) -> np.ndarray:
    """Boxes (N, 4) of x, y, width, height of the people among instances, best first."""
    # 0.3 is mmpose's default.
    people = [i for i in instances if i.label == PERSON_LABEL and i.score >= 0.3]
    people.sort(key=lambda instance: -instance.score)
    return np.array([person.box for person in people[:MAX_PEOPLE]]).reshape(-1, 4)


def tiles(size: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
    """Boxes (N, 4) with the aspect ratio of an input's ``shape`` that cover an image of ``size``.

    The boxes are as high or as wide as the image. Each overlaps the next by at least half, so that
    a person who is less than half as wide as a box lies entirely within one box.
    """
    scale = min(size[0] / shape[0], size[1] / shape[1])
    tile = (shape[0] * scale, shape[1] * scale)
    axis = 0 if size[0] - tile[0] > size[1] - tile[1] else 1
    count = 1 + int(np.ceil((size[axis] - tile[axis]) / (tile[axis] / 2) - 1e-9))
    starts = np.linspace(0, size[axis] - tile[axis], count)
    boxes = np.zeros((count, 4))
    boxes[:, axis] = starts
    boxes[:, 2:] = tile
    return boxes


def _simcc_outputs(model: OnnxModel) -> tuple[int, int] | None:
    """Positions of columns and rows among the outputs, by their names or else by their order."""
    if len(model.outputs) != 2:
        return None
    if any(len(shape) != 3 or kind not in FLOATS for _, shape, kind in model.outputs):
        return None
    names = [re.split(r"[^a-z0-9]+", name.lower()) for name, _, _ in model.outputs]
    return (1, 0) if "y" in names[0] or "x" in names[1] else (0, 1)


def _heatmap_output(model: OnnxModel) -> tuple[int] | None:
    """Position of the heatmaps: the only output, coarser than the input."""
    if len(model.outputs) != 1:
        return None
    _, shape, kind = model.outputs[0]
    if len(shape) != 4 or kind not in FLOATS:
        return None
    cells = tuple(n for n in shape[2:] if isinstance(n, int))
    if len(cells) == 2 and model.size is not None and not _coarser(cells, model.size):
        return None
    return (0,)


def _same_bins(shapes: list[tuple[int, ...]], size: tuple[int, int]) -> bool:
    """Whether columns and rows have the same people, points and width of bins."""
    columns, rows = shapes
    if len(columns) != 3 or columns[:2] != rows[:2]:
        return False
    return abs(columns[2] / size[0] - rows[2] / size[1]) < 1e-6


def _coarser(cells: tuple[int, ...], size: tuple[int, int]) -> bool:
    """Whether the cells of a map (height, width) are squares of several pixels of an input of
    ``size`` (width, height)."""
    if len(cells) != 2 or min(cells) < 1:
        return False
    stride = size[0] / cells[1]
    return stride > 1 and abs(size[1] / cells[0] - stride) < 1e-6


def _unknown(model: OnnxModel, outputs: list[str]) -> UserError:
    return UserError(
        f"{Path(model.path)}: its outputs ({'; '.join(outputs)}) are not those of a pose model; "
        "expected simcc_x and simcc_y (people, points, bins) of RTMPose, RTMW or DWPose, or "
        "heatmaps (people, points, height, width) of HRNet or ViTPose; export it as "
        "docs/detectors.md shows"
    )


def _point_names(model: OnnxModel, count: int) -> tuple[str, ...]:
    """Names of the points of a model with ``count`` points."""
    try:
        return find_layout(count, model.metadata.get(LAYOUT_KEY)).points
    except ValueError as error:
        raise UserError(f"{Path(model.path)}: {error}") from None


def decode_simcc(columns: np.ndarray, rows: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Decode SimCC responses: (B, K, 3) of x, y (px of the input) and confidence.

    Args:
        columns: (B, K, X) responses of the bins along x.
        rows: (B, K, Y) responses of the bins along y. The confidence is the smaller maximum.
        size: width and height of the input.
    """
    x = columns.argmax(-1) * size[0] / columns.shape[-1]
    y = rows.argmax(-1) * size[1] / rows.shape[-1]
    response = np.minimum(columns.max(-1), rows.max(-1))
    return np.stack([x, y, np.maximum(response, 0)], -1)


def decode_heatmaps(maps: np.ndarray, size: tuple[int, int], grid: HeatmapGrid) -> np.ndarray:
    """Decode heatmaps: (B, K, 3) of x, y (px of the input) and confidence.

    Args:
        maps: (B, K, h, w). The confidence is the highest response.
        size: width and height of the input, W and H.
        grid: "msra": cell i is at pixel i W/w (mmpose's MSRAHeatmap). "udp": at i (W-1)/(w-1)
            (Huang et al. 2020, "The Devil is in the Details: Delving into Unbiased Data Processing
            for Human Pose Estimation").
    """
    batch, count, height, width = maps.shape
    flat = maps.reshape(batch * count, height, width).astype(np.float64)
    places = find_peaks(flat)
    cells, pixels = np.array([width, height]), np.array(size)
    scale = pixels / cells if grid == "msra" else (pixels - 1) / np.maximum(cells - 1, 1)
    response = np.maximum(flat.max((1, 2)), 0)
    return np.column_stack([places * scale, response]).reshape(batch, count, 3)


def find_peaks(maps: np.ndarray) -> np.ndarray:
    """Peaks (N, 2) of maps (N, h, w) with a resolution below one cell (DARK, Zhang et al. 2020).

    A peak, x and y in cells, is the maximum of the second-order expansion of the blurred map's
    logarithm about the highest cell. It is the highest cell itself if that lies at the border, or
    if the expansion has no maximum within one cell.
    """
    number, height, width = maps.shape
    row, column = np.divmod(maps.reshape(number, -1).argmax(1), width)
    places = np.column_stack([column, row]).astype(np.float64)
    inside = np.minimum(column, row) >= _EDGE
    inside &= (column < width - _EDGE) & (row < height - _EDGE)
    fine = np.flatnonzero(inside & (maps.max((1, 2)) > 0))
    if not len(fine):
        return places
    log = np.log(np.maximum(_smooth_around(maps[fine], row[fine], column[fine]), 1e-10))
    slope = np.stack([log[:, 2, 3] - log[:, 2, 1], log[:, 3, 2] - log[:, 1, 2]], -1) / 2
    dxx = (log[:, 2, 4] - 2 * log[:, 2, 2] + log[:, 2, 0]) / 4
    dyy = (log[:, 4, 2] - 2 * log[:, 2, 2] + log[:, 0, 2]) / 4
    dxy = (log[:, 3, 3] - log[:, 1, 3] - log[:, 3, 1] + log[:, 1, 1]) / 4
    determinant = dxx * dyy - dxy**2
    peak = (dxx < 0) & (determinant > 0)
    inverse = np.stack([dyy, -dxy, -dxy, dxx], -1).reshape(-1, 2, 2)
    inverse /= np.where(peak, determinant, 1)[:, None, None]
    offset = -(inverse @ slope[..., None])[..., 0]
    peak &= np.abs(offset).max(1) <= 1
    places[fine[peak]] += offset[peak]
    return places


def _smooth_around(maps: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Blur maps (N, h, w) and return the (N, 5, 5) cells around the given cell of each map.

    The blur merges separate maxima that noise causes. Maps are zero beyond the border, as in
    mmpose.
    """
    # mmpose blurs over 11 cells of a map of 48, over 17 of 72.
    reach = max(1, round(11 / 48 * min(maps.shape[1:]) / 2 - 0.5))
    kernel = cv2.getGaussianKernel(2 * reach + 1, 0)[:, 0]  # OpenCV's own deviation for the width
    side = np.arange(2 * (reach + _EDGE) + 1)
    padded = np.pad(maps, ((0, 0), (reach + _EDGE,) * 2, (reach + _EDGE,) * 2))
    each = np.arange(len(maps))[:, None, None]
    patches = padded[each, (row[:, None] + side)[:, :, None], (column[:, None] + side)[:, None]]
    blur = np.zeros((2 * _EDGE + 1, len(side)))
    for i in range(len(blur)):
        blur[i, i : i + len(kernel)] = kernel
    return blur @ patches @ blur.T
