"""Instance segmentations in COCO's result format, one JSON file a camera.

The file is a list of results or a whole COCO data set (``images``, ``annotations``,
``categories``). ``image_id`` is the number of the colour image in the camera's own recording. A
segmentation is a compressed or an uncompressed RLE, or polygons.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.detection import masks
from intercap_core.errors import UserError

# COCO's 80 classes, and their published ids, which have gaps.
_CLASSES = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat",
    "traffic light", "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog",
    "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe", "backpack", "umbrella",
    "handbag", "tie", "suitcase", "frisbee", "skis", "snowboard", "sports ball", "kite",
    "baseball bat", "baseball glove", "skateboard", "surfboard", "tennis racket", "bottle",
    "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple", "sandwich", "orange",
    "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch", "potted plant",
    "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard", "cell phone",
    "microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors",
    "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip
_LARGEST_ID = 2**31 - 1
_UNUSED_IDS = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
COCO_NAMES: dict[int, str] = dict(
    zip([i for i in range(1, 91) if i not in _UNUSED_IDS], _CLASSES, strict=True)
)


@dataclass(frozen=True)
class Instance:
    """One result: label, score, box (x, y, width, height, px), compressed RLE."""

    label: str
    score: float
    box: tuple[float, float, float, float]
    rle: bytes


@dataclass
class CandidateFile:
    """The results of one camera, by image number.

    ``images`` are the images that the file speaks about, or None where it does not say: then an
    image without results has none.
    """

    instances: dict[int, list[Instance]] = field(default_factory=dict)
    images: frozenset[int] | None = None


def read_candidates(path: Path, *, width: int, height: int, min_score: float) -> CandidateFile:
    """Read one camera's results for images of ``width`` x ``height``, in the file's order.

    Results under ``min_score`` are left out. Raises UserError naming file, image and entry where
    one has no segmentation that fits the image.
    """
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{path}: not valid JSON ({error}); write the candidates of this camera again"
        ) from None
    names = dict(COCO_NAMES)
    images: frozenset[int] | None = None
    entries = content
    if isinstance(content, dict):
        entries = content.get("annotations")
        names.update(_categories(content.get("categories", []), path))
        if "images" in content:
            images = _image_ids(content["images"], path)
    if not isinstance(entries, list):
        raise UserError(f"{path}: expected a list of COCO results, or 'annotations' with one")
    result = CandidateFile(images=images)
    for index, entry in enumerate(entries):
        where = f"{path}, entry {index}"
        if not isinstance(entry, dict) or type(entry.get("image_id")) is not int:
            found = entry.get("image_id") if isinstance(entry, dict) else entry
            raise UserError(
                f"{where}: image_id must be the whole number of a colour image, found "
                f"{_short(found)}"
            )
        image = entry["image_id"]
        if not 0 <= image <= _LARGEST_ID:
            raise UserError(
                f"{where}: image_id must be the number of a colour image from 0, found "
                f"{_short(image)}; write the candidates of this camera again"
            )
        score = _score(entry, where)
        if score < min_score:
            continue
        instance = _instance(entry, score, names, f"{where} (image {image})", width, height)
        result.instances.setdefault(image, []).append(instance)
    return result


def _instance(
    entry: dict[str, Any], score: float, names: dict[int, str], where: str, width: int, height: int
) -> Instance:
    rle = _segmentation(entry.get("segmentation"), where, width, height)
    try:
        runs = masks.Runs(rle, height, width)
    except ValueError as error:
        raise UserError(f"{where}: {error}; write the candidates of this camera again") from None
    box = entry.get("bbox")
    if box is None:
        box = runs.box
    try:
        x, y, w, h = (float(v) for v in box)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"{where}: bbox is {_short(box)}, expected x, y, width, height") from None
    if not all(math.isfinite(v) for v in (x, y, w, h)):
        raise UserError(f"{where}: bbox is {_short(box)}, expected finite numbers")
    return Instance(_label(entry, names, where), score, (x, y, w, h), rle)


def _segmentation(value: Any, where: str, width: int, height: int) -> bytes:
    """The compressed RLE of any of COCO's forms; whether it fills the image is checked later."""
    if isinstance(value, dict):
        size = value.get("size")
        if size != [height, width]:
            raise UserError(
                f"{where}: the mask's size is {size}, expected [{height}, {width}] (height, "
                "width of the colour image); segment the images as recorded"
            )
        counts = value.get("counts")
        if isinstance(counts, str):
            try:
                return counts.encode("utf-8")
            except UnicodeEncodeError:
                raise UserError(
                    f"{where}: its RLE holds characters that COCO's alphabet does not have; write "
                    "the candidates of this camera again"
                ) from None
        value = counts
        if isinstance(counts, list):
            return _checked(masks.from_counts, counts, where, width, height)
    if isinstance(value, list) and all(isinstance(p, list) for p in value):
        return _checked(masks.from_polygons, value, where, width, height)
    raise UserError(
        f"{where}: has no segmentation; expected an RLE with size and counts, or polygons"
    )


def _checked(make: Any, value: list[Any], where: str, width: int, height: int) -> bytes:
    try:
        return bytes(make(value, height, width))
    except (ValueError, TypeError, OverflowError) as error:
        raise UserError(f"{where}: {error}; write the candidates of this camera again") from None


def _score(entry: dict[str, Any], where: str) -> float:
    score = entry.get("score", 1.0)
    try:
        value = float(score) if type(score) in (int, float) else math.nan
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise UserError(f"{where}: score is {_short(score)}, expected a number")
    return value


def _label(entry: dict[str, Any], names: dict[int, str], where: str) -> str:
    for key in ("category_name", "category", "label"):
        if isinstance(entry.get(key), str):
            return _text(entry[key], where)
    number = entry.get("category_id")
    if type(number) is not int:
        raise UserError(f"{where}: has neither category_id nor category_name")
    return names.get(number, f"category {_short(number)}")


def _text(value: str, where: str) -> str:
    try:
        value.encode("utf-8")
    except UnicodeEncodeError:
        raise UserError(
            f"{where}: the category's name {value!r:.80} is not valid text; write the candidates "
            "of this camera again"
        ) from None
    return value


def _short(value: Any) -> str:
    """A found value in words of bounded length."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:60]}... ({len(text)} characters)"


def _categories(values: Any, path: Path) -> dict[int, str]:
    try:
        return {int(v["id"]): _text(str(v["name"]), str(path)) for v in values}
    except (TypeError, KeyError, ValueError, OverflowError):
        raise UserError(f"{path}: 'categories' must list objects with id and name") from None


def _image_ids(values: Any, path: Path) -> frozenset[int]:
    try:
        return frozenset(int(v["id"]) for v in values)
    except (TypeError, KeyError, ValueError, OverflowError):
        raise UserError(f"{path}: 'images' must list objects with id") from None


def boxes_of(instances: list[Instance]) -> np.ndarray:
    """(N, 4) float32."""
    return np.array([i.box for i in instances], np.float32).reshape(-1, 4)
