"""Instance segmentation by a user's ONNX model: YOLO-seg, Mask R-CNN or PointRend.

The kind of a model is recognised by its outputs, for B images and N boxes:

- YOLO-seg (ultralytics) has two: rows (B, 4 + classes + M, N) of box, class scores and M
  coefficients, and M mask prototypes (B, M, h, w). A mask is the prototypes' weighted sum.
- Mask R-CNN and PointRend have boxes (N, 4), classes (N,), scores (N,) and masks, over the box (N,
  1, 28, 28) or over the image (N, 1, H, W). Exports of detectron2 also have the image's size.

Boxes of R-CNN are two corners in the model's input. Masks are interpolated at the pixels of the
image that lie within the box.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from intercap_core.config import DetectionsSettings
from intercap_core.errors import UserError
from intercap_core.formats.detections.class_names import (
    COCO_NAMES,
    COCO_NAMES_FROM_0,
    COCO_NAMES_FROM_1,
    read_label_map,
)
from intercap_core.formats.detections.coco import MAX_SCORE
from intercap_core.formats.detections.instance import Instance, make_instance
from intercap_core.formats.detections.onnx_model import (
    FLOATS,
    Fit,
    OnnxModel,
    PixelValues,
    parse_names,
    place_picture,
)
from intercap_core.geometry.camera import masks
from intercap_core.inputs.files import quoted

MAX_INSTANCES = 100  # of one image, as in COCO's evaluation


class _Region(NamedTuple):
    """A detected box with the grid that holds its mask."""

    number: int
    """The model's number of the class."""
    score: float
    """From 0 to 1."""
    box: np.ndarray
    """(4,) two corners in the image, px."""
    grid: np.ndarray
    """(h, w) mask as logits (YOLO) or probabilities (R-CNN)."""
    across: tuple[float, float]
    """Scale and shift of x from the image's to the grid's pixel edges."""
    down: tuple[float, float]
    """The same of y."""


def _sample_instance(
    region: _Region, label: str, size: tuple[int, int], threshold: float
) -> Instance | None:
    """The instance of the pixels in the region's box whose grid exceeds the threshold.

    The box of the result is that of its mask. None if no pixel is set. ``size``: width and height
    of the image.
    """
    _, score, box, grid, across, down = region
    if not np.isfinite(box).all():
        return None
    x0, y0 = int(np.floor(box[0])), int(np.floor(box[1]))
    x1, y1 = min(int(np.ceil(box[2])), size[0]), min(int(np.ceil(box[3])), size[1])
    if x1 <= x0 or y1 <= y0:
        return None
    # The middle of pixel u of the window is at x0 + u + 0.5, that of the grid's pixel v at v + 0.5.
    inverse = np.array(
        [
            [across[0], 0, across[0] * (x0 + 0.5) + across[1] - 0.5],
            [0, down[0], down[0] * (y0 + 0.5) + down[1] - 0.5],
        ]
    )
    sampled = cv2.warpAffine(
        np.ascontiguousarray(grid, np.float32),
        inverse,
        (x1 - x0, y1 - y0),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    rle = masks.encode_window(sampled > threshold, x0, y0, size[1], size[0])
    return make_instance(label, score, rle, size)


def suppress_overlaps(corners: np.ndarray, scores: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Indices (K,) of the boxes (N, 4) that greedy non-maximum suppression keeps, best first.

    Boxes are two corners. A box is removed if a better box of its class has an intersection over
    union of more than 0.7 with it, the default of ultralytics' predictors. Only the 3,000 best
    boxes are considered.
    """
    if not len(corners):
        return np.zeros(0, int)
    boxes = np.concatenate([corners[:, :2], np.maximum(corners[:, 2:] - corners[:, :2], 0)], 1)
    kept = cv2.dnn.NMSBoxesBatched(
        boxes.tolist(), scores.tolist(), classes.tolist(), -np.inf, 0.7, top_k=30 * MAX_INSTANCES
    )
    return np.asarray(kept, int).ravel()


Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class _Kind:
    """Kind of a model."""

    values: PixelValues
    """Pixel values of its input."""
    names: Mapping[int, str]
    """Classes by number."""
    outputs: dict[str, int]
    """Position of each output by its meaning."""
    yolo: bool
    """Whether it is a YOLO-seg."""


class Segmenter:
    """A model with its class names; obtained from :meth:`load`."""

    def __init__(self, model: OnnxModel, kind: _Kind, min_score: float) -> None:
        self._model, self._kind, self._min_score = model, kind, min_score

    @classmethod
    def load(cls, settings: DetectionsSettings) -> Segmenter:
        """Open the model that the settings name; raises UserError if its kind is unknown."""
        assert settings.segmentation_model is not None
        model = OnnxModel.load(settings.segmentation_model, settings.segmentation_device)
        task = model.metadata.get("task", "segment")
        if task != "segment":
            raise UserError(
                f"{model.path}: is a model for {quoted(task, 40)}, expected 'segment'; export a "
                "segmentation model (its name ends in -seg)"
            )
        outputs = _yolo_outputs(model) or _rcnn_outputs(model)
        if outputs is None:
            raise _unknown(model, [f"{n} {list(shape)}" for n, shape, _ in model.outputs])
        yolo = "prototypes" in outputs
        values = _auto_values(model, outputs) if not yolo else "rgb"
        if settings.segmentation_input != "auto":
            values = settings.segmentation_input
        names: Mapping[int, str]
        if settings.segmentation_labels is not None:
            names = read_label_map(settings.segmentation_labels)
        else:
            names = parse_names(model.metadata.get("names", "")) or _coco_names(yolo, values)
        return cls(model, _Kind(values, names, outputs, yolo), settings.min_score)

    @property
    def classes(self) -> list[str]:
        """Classes of the model, in the order of their numbers."""
        return [self._kind.names[number] for number in sorted(self._kind.names)]

    def segment(
        self, pictures: Iterable[tuple[Key, np.ndarray]]
    ) -> Iterator[tuple[Key, list[Instance]]]:
        """Instances of each picture (H, W, 3) uint8 BGR, best first, in the pictures' order."""
        most = self._model.batch or (4 if self._kind.yolo else 1)
        waiting: list[tuple[Key, Fit, np.ndarray]] = []
        for key, picture in pictures:
            fit, values = self._prepared(picture)
            if waiting and (len(waiting) == most or waiting[0][2].shape != values.shape):
                yield from self._run(waiting)
                waiting = []
            waiting.append((key, fit, values))
        if waiting:
            yield from self._run(waiting)

    def _prepared(self, picture: np.ndarray) -> tuple[Fit, np.ndarray]:
        """Fit a picture into the input: its place there, and the input's values (3, h, w)."""
        picture_size = (picture.shape[1], picture.shape[0])
        size = self._model.size
        if size is None and self._kind.yolo:
            side = _longest_side(self._model.metadata)
            size = _multiple_of_32(picture_size, side / max(picture_size))
        elif size is None and self._kind.values == "rgb":
            size = picture_size  # torchvision's models scale by themselves
        elif size is None:
            # As the test configurations of detectron2 and maskrcnn-benchmark.
            size = _multiple_of_32(
                picture_size, min(800 / min(picture_size), 1333 / max(picture_size))
            )
        fit = place_picture(picture_size, size, centred=self._kind.yolo)
        grey = 114 if self._kind.yolo else 0  # as in ultralytics' training
        return fit, self._model.fit_picture(picture, fit, size, self._kind.values, grey)

    def _run(
        self, waiting: list[tuple[Key, Fit, np.ndarray]]
    ) -> Iterator[tuple[Key, list[Instance]]]:
        """Run the model on the waiting pictures and yield the instances of each."""
        images = np.stack([values for _, _, values in waiting])
        outputs = self._model.run(images)
        size = (images.shape[3], images.shape[2])
        decode = self._decode_yolo if self._kind.yolo else self._decode_rcnn
        for index, (key, fit, _) in enumerate(waiting):
            instances = []
            for region in decode(outputs, index, fit, size):
                if region.score > MAX_SCORE:
                    raise UserError(
                        f"{self._model.path}: gives scores up to {region.score:.4g}, expected 0 "
                        "to 1; export it with its last activation"
                    )
                label = self._kind.names.get(region.number, f"category {region.number}")
                threshold = 0.0 if self._kind.yolo else 0.5  # logits or probabilities
                instances.append(_sample_instance(region, label, fit.size, threshold))
            yield key, [instance for instance in instances if instance is not None]

    def _decode_yolo(
        self, outputs: list[np.ndarray], index: int, fit: Fit, size: tuple[int, int]
    ) -> Iterator[_Region]:
        """Regions of image ``index`` in the outputs of a YOLO-seg, best first.

        Rows are (4 + classes + M, N) of box (middle, width, height), class scores and M
        coefficients; or (N, 6 + M) of corners, score, class and coefficients, if the model itself
        suppresses overlaps. Prototypes (M, h, w) cover the whole input.
        """
        rows, prototypes = (outputs[self._kind.outputs[k]] for k in ("rows", "prototypes"))
        shaped = rows.ndim == 3 and prototypes.ndim == 4 and min(len(rows), len(prototypes)) > index
        if not shaped or not _is_grid(prototypes.shape[2:]) or not prototypes.shape[1]:
            raise _unknown(self._model, [str(list(v.shape)) for v in outputs])
        rows, prototypes = rows[index], prototypes[index]
        self._check_numbers(rows, prototypes)
        count = len(prototypes)
        ends_itself = rows.shape[1] == 6 + count
        rows = rows if ends_itself else rows.T
        coefficients = rows[:, -count:]
        if ends_itself:
            corners, scores, classes = rows[:, :4], rows[:, 4], rows[:, 5].astype(int)
            kept = np.flatnonzero(scores >= self._min_score)
            kept = kept[np.argsort(-scores[kept], kind="stable")]
        elif rows.shape[1] < 5 + count:
            raise _unknown(self._model, [str(list(v.shape)) for v in outputs])
        else:
            by_class = rows[:, 4:-count]
            classes = by_class.argmax(1)
            scores = by_class[np.arange(len(rows)), classes]
            half = rows[:, 2:4] / 2
            corners = np.concatenate([rows[:, :2] - half, rows[:, :2] + half], 1)
            kept = np.flatnonzero(scores >= self._min_score)
            kept = kept[suppress_overlaps(corners[kept], scores[kept], classes[kept])]
        kept = kept[:MAX_INSTANCES]
        boxes = fit.to_image(corners[kept])
        logits = np.tensordot(coefficients[kept], prototypes, 1)
        steps = size[0] / prototypes.shape[2], size[1] / prototypes.shape[1]
        # Image to grid, in pixel edges: (image * scale + shift) / step
        across = (fit.scale[0] / steps[0], fit.left / steps[0])
        down = (fit.scale[1] / steps[1], fit.top / steps[1])
        for k, box, logit in zip(kept.tolist(), boxes, logits, strict=True):
            yield _Region(int(classes[k]), float(scores[k]), box, logit, across, down)

    def _decode_rcnn(
        self, outputs: list[np.ndarray], index: int, fit: Fit, size: tuple[int, int]
    ) -> Iterator[_Region]:
        """Regions of image ``index`` in the outputs of a Mask R-CNN or PointRend, best first.

        Masks cover the whole input if they have its size, else the box.
        """
        corners, classes, scores, soft = (
            outputs[self._kind.outputs[k]] for k in ("boxes", "classes", "scores", "masks")
        )
        if corners.ndim == 3 and min(len(v) if v.ndim else 0 for v in outputs[:4]) > index:
            corners, classes, scores, soft = (v[index] for v in (corners, classes, scores, soft))
        soft = soft[:, 0] if soft.ndim == 4 and soft.shape[1] == 1 else soft
        counts = {len(v) if v.ndim else -1 for v in (corners, classes, scores, soft)}
        shaped = len(counts) == 1 and corners.shape[1:] == (4,) and scores.ndim == classes.ndim == 1
        if not shaped or soft.ndim != 3 or (len(soft) and not _is_grid(soft.shape[1:])):
            raise _unknown(self._model, [str(list(v.shape)) for v in outputs])
        self._check_numbers(corners, classes, scores)
        kept = np.flatnonzero(scores >= self._min_score)
        kept = kept[np.argsort(-scores[kept], kind="stable")][:MAX_INSTANCES]
        across, down = (fit.scale[0], float(fit.left)), (fit.scale[1], float(fit.top))
        for k, box in zip(kept.tolist(), fit.to_image(corners[kept]), strict=True):
            if soft.shape[1:] != size[::-1]:
                shifts, scales = (fit.left, fit.top) * 2, fit.scale * 2
                edges = zip(corners[k], shifts, scales, strict=True)
                x0, y0, x1, y1 = ((float(v) - shift) / scale for v, shift, scale in edges)
                if not (x1 - x0 > 0 and y1 - y0 > 0):
                    continue
                height, width = soft.shape[1:]
                across = (width / (x1 - x0), -x0 * width / (x1 - x0))
                down = (height / (y1 - y0), -y0 * height / (y1 - y0))
            mask = soft[k].astype(np.float32)
            yield _Region(int(classes[k]), float(scores[k]), box, mask, across, down)

    def _check_numbers(self, *outputs: np.ndarray) -> None:
        for values in outputs:
            if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
                raise UserError(
                    f"{self._model.path}: its outputs hold values that are no numbers; export it "
                    "again, with float32 where it was float16"
                )


def _is_grid(shape: tuple[int, ...]) -> bool:
    """Whether masks of this height and width can be sampled."""
    return min(shape) >= 1 and max(shape) <= 32_767  # limit of OpenCV's warps


def _yolo_outputs(model: OnnxModel) -> dict[str, int] | None:
    if len(model.outputs) != 2 or any(kind not in FLOATS for _, _, kind in model.outputs):
        return None
    ranks = [len(shape) for _, shape, _ in model.outputs]
    if sorted(ranks) != [3, 4]:
        return None
    return {"rows": ranks.index(3), "prototypes": ranks.index(4)}


def _rcnn_outputs(model: OnnxModel) -> dict[str, int] | None:
    """Position of each output, by the names if they name all four, else by rank and type."""
    positions: dict[str, int] = {}
    for what, words in (
        ("boxes", "box"), ("classes", "label|class"), ("scores", "score"), ("masks", "mask"),
    ):  # fmt: skip
        named = [i for i, o in enumerate(model.outputs) if re.search(words, o[0].lower())]
        if len(named) == 1:
            positions[what] = named[0]
    if len(positions) == 4 and len(set(positions.values())) == 4:
        return positions
    positions = {}
    for i, (_, shape, kind) in enumerate(model.outputs):
        if len(shape) == 2 and kind in FLOATS:
            positions.setdefault("boxes", i)
        elif len(shape) == 1:  # the image's size, also of whole numbers, comes last
            positions.setdefault("scores" if kind in FLOATS else "classes", i)
        elif len(shape) in (3, 4):
            positions.setdefault("masks", i)
    return positions if len(positions) == 4 else None


def _auto_values(model: OnnxModel, outputs: dict[str, int]) -> PixelValues:
    """Pixel values by exporter.

    Detectron2 adds the image's size as a fifth output. Masks of torchvision cover the image, those
    of maskrcnn-benchmark the box.
    """
    if len(model.outputs) > 4:
        return "bgr255"
    lengths = model.outputs[outputs["masks"]][1][-2:]
    fixed = all(isinstance(n, int) for n in lengths)
    over_image = not fixed or (model.size is not None and tuple(lengths) == model.size[::-1])
    return "rgb" if over_image else "bgr_mean"


def _coco_names(yolo: bool, values: str) -> Mapping[int, str]:
    """COCO's numbering in models with these pixel values."""
    if yolo or values == "bgr255":
        return COCO_NAMES_FROM_0
    return COCO_NAMES if values == "rgb" else COCO_NAMES_FROM_1


def _longest_side(metadata: Mapping[str, str]) -> int:
    """The longest side at which a YOLO without a fixed input size was trained."""
    sides = [int(n) for n in re.findall(r"\d{1,5}", metadata.get("imgsz", ""))]
    return max(sides) if sides and min(sides) > 0 else 640  # ultralytics' default


def _multiple_of_32(size: tuple[int, int], ratio: float) -> tuple[int, int]:
    """The size times ``ratio``, each side rounded up to a multiple of the networks' stride."""
    width, height = (-(-round(n * ratio) // 32) * 32 for n in size)
    return width, height


def _unknown(model: OnnxModel, outputs: list[str]) -> UserError:
    return UserError(
        f"{Path(model.path)}: its outputs ({'; '.join(outputs)}) are of no kind that is known; "
        "expected boxes, classes, scores and masks of Mask R-CNN or PointRend, or rows and "
        "prototypes of YOLO-seg; export it as docs/detectors.md shows"
    )
