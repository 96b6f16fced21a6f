"""Instance segmentation by a user's ONNX model: what kind of model it is, and images through it.

Two kinds are told apart by their outputs. YOLO-seg (ultralytics) has two: rows of boxes, class
scores and coefficients (B, 4 + classes + M, N), and M prototypes of masks (B, M, h, w). Mask R-CNN
and PointRend have boxes (N, 4), classes (N,), scores (N,) and masks, over the box (N, 1, 28, 28) or
over the image (N, 1, H, W); detectron2's also have the image's size.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from intercap_core.config import DetectionsSettings
from intercap_core.errors import UserError
from intercap_core.formats.detections.class_names import (
    COCO_NAMES,
    COCO_NAMES_FROM_0,
    COCO_NAMES_FROM_1,
    MAX_LABEL,
    read_label_map,
)
from intercap_core.formats.detections.coco import MAX_SCORE
from intercap_core.formats.detections.instance import Instance
from intercap_core.formats.detections.models.onnx_model import (
    Fit,
    OnnxModel,
    PixelValues,
    fit_within,
    parse_names,
)
from intercap_core.formats.detections.models.onnx_outputs import rcnn_instances, yolo_instances
from intercap_core.inputs.quotes import quoted

Key = TypeVar("Key", bound=Hashable)

SEGMENTATION_BATCH = 4  # images in one run of a model with a free batch size
MAX_GRID_SIDE = 32_767  # cells of a mask: limit of OpenCV's warps
# Input of ultralytics' training.
YOLO_SIDE = 640  # px
YOLO_STRIDE = 32  # px
YOLO_GREY = 114  # grey level of the padding
# Input of the test configurations of detectron2 and maskrcnn-benchmark, px.
RCNN_SHORT = 800
RCNN_LONG = 1333
RCNN_STRIDE = 32
_FLOATS = ("tensor(float)", "tensor(float16)")


@dataclass(frozen=True)
class _Kind:
    """How a model is to be fed and understood."""

    values: PixelValues
    names: Mapping[int, str]
    outputs: dict[str, int]  # which output is what
    yolo: bool


class Segmenter:
    """A model with its class names. Obtained from :meth:`load`."""

    def __init__(self, model: OnnxModel, kind: _Kind, min_score: float) -> None:
        self._model, self._kind, self._min_score = model, kind, min_score
        self._read: Callable[..., list[Instance]] = self._yolo if kind.yolo else self._rcnn

    @classmethod
    def load(cls, settings: DetectionsSettings) -> Segmenter:
        """Open the model that the settings name.

        Raises UserError where it cannot be run or is of no kind that is known.
        """
        assert settings.segmentation_model is not None
        model = OnnxModel.load(settings.segmentation_model, settings.segmentation_device)
        task = model.metadata.get("task", "segment")
        if task != "segment":
            raise UserError(
                f"{model.path}: is a model for {quoted(task, 40)}, expected 'segment'; export a "
                "segmentation model (its name ends in -seg)"
            )
        found = _yolo_outputs(model) or _rcnn_outputs(model)
        if found is None:
            raise _unknown(model, [f"{n} {list(shape)}" for n, shape, _ in model.outputs])
        yolo = "prototypes" in found
        values = _auto_values(model, found) if not yolo else "rgb"
        if settings.segmentation_input != "auto":
            values = settings.segmentation_input
        names: Mapping[int, str]
        if settings.segmentation_labels is not None:
            names = read_label_map(settings.segmentation_labels)
        else:
            names = _own_names(model) or _coco_names(yolo, values)
        return cls(model, _Kind(values, names, found, yolo), settings.min_score)

    @property
    def classes(self) -> list[str]:
        """What the model can find, in the order of its numbers."""
        return [self._kind.names[number] for number in sorted(self._kind.names)]

    def segment(
        self, pictures: Iterable[tuple[Key, np.ndarray]]
    ) -> Iterator[tuple[Key, list[Instance]]]:
        """Instances of each picture (H, W, 3) uint8 BGR, best first, in the pictures' order."""
        most = self._model.batch or (SEGMENTATION_BATCH if self._kind.yolo else 1)
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
        own = (picture.shape[1], picture.shape[0])
        size = self._model.size
        if size is None and self._kind.yolo:
            side = _longest_side(self._model.metadata)
            size = _multiple(own, side / max(own), YOLO_STRIDE)
        elif size is None and self._kind.values == "rgb":
            size = own  # torchvision's models scale by themselves
        elif size is None:
            ratio = min(RCNN_SHORT / min(own), RCNN_LONG / max(own))
            size = _multiple(own, ratio, RCNN_STRIDE)
        fit = fit_within(own, size, centred=self._kind.yolo)
        grey = YOLO_GREY if self._kind.yolo else 0
        return fit, self._model.fitted(picture, fit, size, self._kind.values, grey)

    def _run(
        self, waiting: list[tuple[Key, Fit, np.ndarray]]
    ) -> Iterator[tuple[Key, list[Instance]]]:
        images = np.stack([values for _, _, values in waiting])
        missing = (self._model.batch or 0) - len(images)
        if missing > 0:  # the model insists on its number
            images = np.concatenate([images, np.repeat(images[-1:], missing, 0)])
        outputs = self._model.run(images)
        size = (images.shape[3], images.shape[2])
        for index, (key, fit, _) in enumerate(waiting):
            yield key, self._read(outputs, index, fit, size)

    def _yolo(
        self, outputs: list[np.ndarray], index: int, fit: Fit, size: tuple[int, int]
    ) -> list[Instance]:
        rows, prototypes = (outputs[self._kind.outputs[k]] for k in ("rows", "prototypes"))
        shaped = rows.ndim == 3 and prototypes.ndim == 4 and min(len(rows), len(prototypes)) > index
        if not shaped or not _is_grid(prototypes.shape[2:]) or not prototypes.shape[1]:
            raise _unknown(self._model, [str(list(v.shape)) for v in outputs])
        self._check_numbers(rows[index], prototypes[index])
        try:
            found = yolo_instances(
                rows[index],
                prototypes[index],
                fit,
                size,
                min_score=self._min_score,
                names=self._kind.names,
            )
        except ValueError:
            raise _unknown(self._model, [str(list(v.shape)) for v in outputs]) from None
        return self._plausible(found)

    def _rcnn(
        self, outputs: list[np.ndarray], index: int, fit: Fit, size: tuple[int, int]
    ) -> list[Instance]:
        boxes, classes, scores, soft = (
            outputs[self._kind.outputs[k]] for k in ("boxes", "classes", "scores", "masks")
        )
        if boxes.ndim == 3 and min(len(v) if v.ndim else 0 for v in outputs[:4]) > index:
            boxes, classes, scores, soft = (v[index] for v in (boxes, classes, scores, soft))
        soft = soft[:, 0] if soft.ndim == 4 and soft.shape[1] == 1 else soft
        counts = {len(v) if v.ndim else -1 for v in (boxes, classes, scores, soft)}
        shaped = len(counts) == 1 and boxes.shape[1:] == (4,) and scores.ndim == classes.ndim == 1
        if not shaped or soft.ndim != 3 or (len(soft) and not _is_grid(soft.shape[1:])):
            raise _unknown(self._model, [str(list(v.shape)) for v in outputs])
        self._check_numbers(boxes, classes, scores)
        found = rcnn_instances(
            boxes,
            classes,
            scores,
            soft,
            fit,
            size,
            min_score=self._min_score,
            names=self._kind.names,
        )
        return self._plausible(found)

    def _check_numbers(self, *outputs: np.ndarray) -> None:
        for values in outputs:
            if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
                raise UserError(
                    f"{self._model.path}: its outputs hold values that are no numbers; export it "
                    "again, with float32 where it was float16"
                )

    def _plausible(self, found: list[Instance]) -> list[Instance]:
        """The instances; raises UserError where their scores are none."""
        most = max((instance.score for instance in found), default=0.0)
        if most > MAX_SCORE:
            raise UserError(
                f"{self._model.path}: gives scores up to {most:.4g}, expected 0 to 1; export it "
                "with its last activation"
            )
        return found


def _is_grid(shape: tuple[int, ...]) -> bool:
    """Whether masks of this height and width can be laid over an image."""
    return min(shape) >= 1 and max(shape) <= MAX_GRID_SIDE


def _yolo_outputs(model: OnnxModel) -> dict[str, int] | None:
    if len(model.outputs) != 2 or any(kind not in _FLOATS for _, _, kind in model.outputs):
        return None
    ranks = [len(shape) for _, shape, _ in model.outputs]
    if sorted(ranks) != [3, 4]:
        return None
    return {"rows": ranks.index(3), "prototypes": ranks.index(4)}


def _rcnn_outputs(model: OnnxModel) -> dict[str, int] | None:
    """Which output is what, by name where all four are named, else by rank and type."""
    found: dict[str, int] = {}
    for what, words in (
        ("boxes", "box"), ("classes", "label|class"), ("scores", "score"), ("masks", "mask"),
    ):  # fmt: skip
        named = [i for i, o in enumerate(model.outputs) if re.search(words, o[0].lower())]
        if len(named) == 1:
            found[what] = named[0]
    if len(found) == 4 and len(set(found.values())) == 4:
        return found
    found = {}
    for i, (_, shape, kind) in enumerate(model.outputs):
        if len(shape) == 2 and kind in _FLOATS:
            found.setdefault("boxes", i)
        elif len(shape) == 1:  # the image's size, of whole numbers too, comes last
            found.setdefault("scores" if kind in _FLOATS else "classes", i)
        elif len(shape) in (3, 4):
            found.setdefault("masks", i)
    return found if len(found) == 4 else None


def _auto_values(model: OnnxModel, found: dict[str, int]) -> PixelValues:
    """Whose export it is: torchvision's masks cover the image, detectron2 also gives its size."""
    if len(model.outputs) > 4:
        return "bgr255"
    lengths = model.outputs[found["masks"]][1][-2:]
    fixed = all(isinstance(n, int) for n in lengths)
    over_image = not fixed or (model.size is not None and tuple(lengths) == model.size[::-1])
    return "rgb" if over_image else "bgr_mean"


def _coco_names(yolo: bool, values: str) -> Mapping[int, str]:
    """COCO's numbering of the family that is fed this way."""
    if yolo or values == "bgr255":
        return COCO_NAMES_FROM_0
    return COCO_NAMES if values == "rgb" else COCO_NAMES_FROM_1


def _own_names(model: OnnxModel) -> dict[int, str]:
    names = parse_names(model.metadata.get("names", ""))
    return {number: name[:MAX_LABEL] for number, name in names.items()}


def _longest_side(metadata: Mapping[str, str]) -> int:
    """The longest side at which a YOLO of free size was trained."""
    sides = [int(n) for n in re.findall(r"\d{1,5}", metadata.get("imgsz", ""))]
    return max(sides) if sides and min(sides) > 0 else YOLO_SIDE


def _multiple(size: tuple[int, int], ratio: float, stride: int) -> tuple[int, int]:
    """The size times ``ratio``, each side rounded up to a multiple of ``stride``."""
    width, height = (-(-round(n * ratio) // stride) * stride for n in size)
    return width, height


def _unknown(model: OnnxModel, found: list[str]) -> UserError:
    return UserError(
        f"{Path(model.path)}: its outputs ({'; '.join(found)}) are of no kind that is known; "
        "expected boxes, classes, scores and masks of Mask R-CNN or PointRend, or rows and "
        "prototypes of YOLO-seg; export it as docs/detectors.md shows"
    )
