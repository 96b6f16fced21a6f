"""Instance segmentations as JSON: COCO's result format and what other detectors make of it.

A file is a list of results or a data set (``images``, ``annotations``, ``categories``). A result
says which image it belongs to (``image_id``, a number or a name, or ``file_name``) unless the file
holds one image alone, its class by number or by name, a score, and a segmentation in any form that
:func:`intercap_core.formats.detections.instance.to_rle` knows. Keys are those of detectron2,
torchvision users, ultralytics, Segment Anything and Grounded SAM.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from intercap_core.formats.detections.class_names import label_text, names_of
from intercap_core.formats.detections.instance import Instance, to_rle
from intercap_core.geometry.camera import masks
from intercap_core.inputs.documents import json_decoder, parse_json
from intercap_core.inputs.files import Unreadable, quoted, read_bytes

MAX_JSON_BYTES = 1 << 29  # parsed JSON takes about six times its file size in memory
HEAD_BYTES = 1 << 18  # of a long file, parsed for a preview
# Scores are probabilities. The overlaps that Segment Anything predicts slightly exceed 1.
MIN_SCORE, MAX_SCORE = -0.01, 1.2
_LARGEST_ID = 2**31 - 1
_NAME_KEYS = ("category_name", "category", "class_name", "class", "label", "name")
_NUMBER_KEYS = ("category_id", "class", "class_id", "label")
_SCORE_KEYS = ("score", "confidence", "predicted_iou")


class UnreadableCandidates(Exception):
    """The file as a whole is of no use; says why, in words that fit after its name."""


class ImageKey(NamedTuple):
    """How a file calls an image: by number, by name, or both."""

    number: int | None
    name: str | None


@dataclass
class CandidateFile:
    """The results of one file.

    ``results`` are pairs of image and instance in the file's order. ``images`` are the images that
    the file speaks about, or None where it does not say: then an image without results has none.
    ``faults`` say which entries are left out and why, ``faulty`` their images; ``entries`` counts
    all that have at least the wanted score. ``scaled`` counts masks of another resolution.
    """

    results: list[tuple[ImageKey, Instance]] = field(default_factory=list)
    images: list[ImageKey] | None = None
    faults: list[str] = field(default_factory=list)
    faulty: list[ImageKey] = field(default_factory=list)
    entries: int = 0
    scaled: int = 0


@dataclass(frozen=True)
class _Stated:
    """What a file says about all of its entries."""

    names: Mapping[int, str]  # of classes, by number
    files: Mapping[int, str]  # of images, by id
    sizes: Mapping[int, tuple[int, int]]  # of images, by id
    size: tuple[int, int] | None  # of all images
    corners: bool  # boxes are x, y of two corners


def candidates_of(
    content: Any,
    *,
    width: int,
    height: int,
    min_score: float,
    names: Mapping[int, str],
    one_image: bool = False,
) -> CandidateFile:
    """The results in parsed JSON (:func:`read_json`), in order: images of ``width`` x ``height``.

    ``names`` are the classes by number, where the file does not list them. ``one_image``: entries
    need not say their image. Results under ``min_score`` are left out; so are those that cannot be
    used, which the result tells. Raises :class:`UnreadableCandidates` where nothing can be used.
    """
    entries = content
    images: list[ImageKey] | None = None
    stated = _Stated(names, {}, {}, None, False)
    if isinstance(content, dict):
        entries = content.get("annotations")
        stated, images = _stated(content, names)
    if not isinstance(entries, list):
        raise UnreadableCandidates(
            f"holds {quoted(content)}, expected a list of results, or 'annotations' with one"
        )
    found = CandidateFile(images=images)
    for index, entry in enumerate(entries):
        image = ImageKey(None, None)
        try:
            if not isinstance(entry, dict):
                raise ValueError(f"expected a result, found {quoted(entry)}")
            image = image_of(entry, stated.files, one_image)
            score = _score(entry)
            if score < min_score:
                continue
            instance, scaled = _instance(entry, score, image, stated, (width, height))
        except ValueError as error:
            told = image.name if image.name is not None else image.number
            found.faults.append(
                f"entry {index}{f' (image {told})' if told is not None else ''}: {error}"
            )
            found.faulty.append(image)
        else:
            found.results.append((image, instance))
            found.scaled += scaled
        found.entries += 1
    return found


def read_head(path: Path) -> Any:
    """Parse a small file, or the first results of a long list of them.

    A look before a run: None where a large file does not begin with results. Raises
    :class:`UnreadableCandidates` as :func:`read_json` does.
    """
    content = _bytes(path, HEAD_BYTES)
    if len(content) < HEAD_BYTES:
        return read_json(path)
    text = content.decode("utf-8", errors="ignore").lstrip()
    if not text.startswith("["):
        return None
    reader, at = json_decoder(text), 1
    entries: list[Any] = []
    while True:
        while text[at : at + 1] in (",", " ", "\t", "\r", "\n"):
            at += 1
        try:
            entry, at = reader.raw_decode(text, at)
        except (ValueError, RecursionError):
            return entries or None
        entries.append(entry)


def read_json(path: Path) -> Any:
    """Parse a file; raises :class:`UnreadableCandidates` where it is no JSON or too large."""
    content = _bytes(path)
    try:
        return parse_json(content.decode("utf-8-sig"))
    except ValueError as error:
        raise UnreadableCandidates(f"is not valid JSON ({error}); write it again") from None


def _bytes(path: Path, head: int | None = None) -> bytes:
    try:
        return read_bytes(path, MAX_JSON_BYTES, head=head)
    except Unreadable as error:
        smaller = "; write masks as compressed RLE, or one file an image"
        large = " MB, at most" in error.reason
        raise UnreadableCandidates(error.reason + (smaller if large else "")) from None


def _stated(
    content: dict[str, Any], names: Mapping[int, str]
) -> tuple[_Stated, list[ImageKey] | None]:
    own: dict[int, str] = {}
    if content.get("categories"):
        try:
            own = names_of(content["categories"])
        except ValueError as error:
            raise UnreadableCandidates(
                f"'categories' must list objects with id and name ({error})"
            ) from None
    size = _size(content.get("img_width"), content.get("img_height"))
    corners = content.get("box_format") == "xyxy"
    listed = listed_images(content)
    if listed is None:
        return _Stated({**names, **own}, {}, {}, size, corners), None
    sizes = {
        value["id"]: own_size
        for value in content["images"]
        if (own_size := _size(value.get("width"), value.get("height"))) is not None
    }
    return _Stated({**names, **own}, files_of(listed), sizes, size, corners), listed


def listed_images(content: dict[str, Any]) -> list[ImageKey] | None:
    """The images that a data set lists, None = it lists none.

    Raises :class:`UnreadableCandidates` where they are no objects with an id.
    """
    if "images" not in content:
        return None
    values, images = content["images"], []
    if not isinstance(values, list):
        raise UnreadableCandidates("'images' must be a list of objects with id")
    for value in values:
        number = value.get("id") if isinstance(value, dict) else None
        if type(number) is not int or not 0 <= number <= _LARGEST_ID:
            raise UnreadableCandidates(f"'images' must list objects with id, found {quoted(value)}")
        name = value.get("file_name")
        images.append(ImageKey(number, name if isinstance(name, str) else None))
    return images


def files_of(images: list[ImageKey]) -> dict[int, str]:
    """Names of images by id, where they have one."""
    return {i.number: i.name for i in images if i.number is not None and i.name is not None}


def _size(width: Any, height: Any) -> tuple[int, int] | None:
    if type(width) is int and type(height) is int and min(width, height) > 0:
        return width, height
    return None


def image_of(entry: dict[str, Any], files: Mapping[int, str], one_image: bool) -> ImageKey:
    """What an entry calls its image; ``files`` are the names of images by id.

    ``one_image``: it need not. Raises ValueError where it must and does not.
    """
    value, name = entry.get("image_id"), entry.get("file_name", entry.get("image_path"))
    if isinstance(value, str):
        value, name = None, value
    if not isinstance(name, str):
        name = None
    if value is None and (one_image or name is not None):
        return ImageKey(None, name)
    if type(value) is not int or not 0 <= value <= _LARGEST_ID:
        raise ValueError(
            "image_id must be the whole number of a colour image from 0, or its file's name, "
            f"found {quoted(value)}"
        )
    return ImageKey(value, files.get(value) if name is None else name)


def _instance(
    entry: dict[str, Any], score: float, image: ImageKey, stated: _Stated, size: tuple[int, int]
) -> tuple[Instance, bool]:
    label = _label(entry, stated.names)
    own_size = stated.sizes.get(-1 if image.number is None else image.number, stated.size)
    segmentation = entry.get("segmentation", entry.get("segments"))
    rle, (x_scale, y_scale) = to_rle(segmentation, size, own_size)
    scaled = (x_scale, y_scale) != (1.0, 1.0)
    box = entry.get("bbox", entry.get("box"))
    if box is None or scaled:
        box = masks.Runs(rle, size[1], size[0]).box
        return Instance(label, score, (*map(float, box),), rle), scaled  # type: ignore[arg-type]
    corners = stated.corners
    if isinstance(box, dict):
        box, corners = [box.get(key) for key in ("x1", "y1", "x2", "y2")], True
    try:
        x, y, w, h = (float(v) for v in box)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"bbox is {quoted(box)}, expected x, y, width, height") from None
    if not all(math.isfinite(v) for v in (x, y, w, h)):
        raise ValueError(f"bbox is {quoted(box)}, expected finite numbers")
    if corners:
        w, h = w - x, h - y
    if not (w >= 0 and h >= 0 and _near(x, x + w, size[0]) and _near(y, y + h, size[1])):
        raise ValueError(
            f"bbox is {quoted(box)}, expected pixels of the image of {size[0]}x{size[1]}"
        )
    masks.Runs(rle, size[1], size[0])  # raises where the string is no mask of the image
    return Instance(label, score, (x, y, w, h), rle), scaled


def _near(low: float, high: float, side: int) -> bool:
    """Whether an extent lies within a side of the image, or as much beyond it."""
    return low >= -side and high <= 2 * side


def _score(entry: dict[str, Any]) -> float:
    value = next((entry[key] for key in _SCORE_KEYS if key in entry), 1.0)
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    try:
        score = float(value) if type(value) in (int, float) else math.nan
    except OverflowError:
        score = math.inf
    if not MIN_SCORE <= score <= MAX_SCORE:
        raise ValueError(f"score is {quoted(value)}, expected a number from 0 to 1")
    return score


def _label(entry: dict[str, Any], names: Mapping[int, str]) -> str:
    """The class's name; "" where the detector knows no classes."""
    for key in _NAME_KEYS:
        if isinstance(entry.get(key), str):
            return label_text(entry[key])
    present = [key for key in _NUMBER_KEYS if key in entry]
    if not present:
        return ""
    for key in present:
        if type(entry[key]) is int:
            return names.get(entry[key], f"category {quoted(entry[key])}")
    raise ValueError(
        f"{present[0]} is {quoted(entry[present[0]])}, expected a class's number or name; "
        "category_id or category_name says it"
    )
