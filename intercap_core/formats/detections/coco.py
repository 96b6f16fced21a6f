"""Instance segmentations as JSON: COCO's result format and the variants that detectors write.

A file is a list of results or a data set (``images``, ``annotations``, ``categories``). A result
states:

- its image, unless the file holds one image: ``image_id``, a number or a name, or ``file_name``;
- its class by number or by name, and a score;
- a segmentation in any form that :func:`intercap_core.formats.detections.instance.to_rle` reads.

Keys are those of detectron2, torchvision, ultralytics, Segment Anything and Grounded SAM.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from intercap_core.formats.detections.class_names import check_label, parse_class_names
from intercap_core.formats.detections.instance import (
    Instance,
    are_polygons_shares,
    make_instance,
    reaches_beyond,
    to_rle,
)
from intercap_core.inputs.documents import json_decoder, parse_json
from intercap_core.inputs.files import UnreadableFile, quoted, read_bytes

Result = TypeVar("Result")

HEAD_BYTES = 1 << 18  # of a long file, parsed for a preview
MAX_SCORE = 1.2  # the overlaps that Segment Anything predicts slightly exceed 1
LARGEST_ID = 2**31 - 1


class UnreadableDetections(Exception):
    """A file of detections cannot be used; the message follows the file's name."""


class ImageKey(NamedTuple):
    """How a file refers to an image: by number, by name, or by both."""

    number: int | None
    """Position or id of the image."""
    name: str | None
    size: tuple[int, int] | None = None
    """Width and height that the file states for the image."""


@dataclass
class DetectionFile(Generic[Result]):
    """The results of one file."""

    results: list[tuple[ImageKey, Result]] = field(default_factory=list)
    """Image and result of each entry, in the file's order."""
    images: list[ImageKey] | None = None
    """Images that the file lists; None = it lists none, so it is about all images."""
    faults: list[str] = field(default_factory=list)
    """Entries that are left out because they cannot be used, with the reason."""
    faulty: list[ImageKey] = field(default_factory=list)
    """Image of each of these entries."""
    entries: int = 0
    """Number of entries, without those whose score is too low."""
    scaled: int = 0
    """Number of results of another resolution than the images."""
    shares: int = 0
    """Number of masks whose corners are shares of the image's width and height."""
    beyond: int = 0
    """Number of masks that reach beyond the image."""
    extent: float = 0.0
    """Largest coordinate of masks that state no image size, as a share of width or height."""

    @property
    def is_useless(self) -> bool:
        """Whether there are entries, none of which can be used."""
        return bool(self.entries) and len(self.faults) == self.entries

    def add_fault(self, where: str, image: ImageKey, error: ValueError) -> None:
        """Report an entry that is left out."""
        name = image.name if image.name is not None else image.number
        self.faults.append(f"{where}{f' (image {name})' if name is not None else ''}: {error}")
        self.faulty.append(image)


@dataclass
class DetectionPreview:
    """The first keypoints or candidates of one camera."""

    notes: list[str] = field(default_factory=list)
    """Messages for the user about entries that are left out or changed."""
    faults: list[str] = field(default_factory=list)
    """Messages about files that the detections stage refuses."""
    labels: set[str] = field(default_factory=set)
    """Labels of the instances; empty for keypoints."""
    layouts: set[str] = field(default_factory=set)
    """Names of the keypoints' layouts; empty for candidates."""
    recognised: list[str] = field(default_factory=list)
    """Properties recognised by content: layout, numbering, unit."""
    usable: bool = True
    """Whether any of the keypoints can be used; True for candidates."""


@dataclass
class DetectionsByImage(Generic[Result]):
    """Detections of one camera."""

    by_image: dict[int, Result] = field(default_factory=dict)
    """Detections by image number; empty if the detector found none in the image."""
    notes: list[str] = field(default_factory=list)
    """Messages for the user about entries and files that were left out."""
    recognised: list[str] = field(default_factory=list)
    """Properties recognised by content: layout, numbering, unit."""


CandidateFile = DetectionFile[Instance]


@dataclass(frozen=True)
class _FileHead:
    """Facts that hold for all entries of a file."""

    names: Mapping[int, str]
    """Classes by number."""
    listed: Mapping[int | str, ImageKey]
    """Images by id and by name."""
    size: tuple[int, int] | None
    """Size of all images."""
    corners: bool
    """Whether boxes are x, y of two opposite corners; otherwise x, y, width, height."""
    shares: bool = False
    """Whether corners of polygons are shares of the image's width and height."""


def parse_candidates(
    content: Any,
    size: tuple[int, int],
    names: Mapping[int, str],
    *,
    min_score: float = 0.0,
    one_image: bool = False,
) -> CandidateFile:
    """The results in parsed JSON (:func:`read_json`), in order.

    Results that cannot be used are left out and reported as faults. Raises
    :class:`UnreadableDetections` if nothing can be used.

    Args:
        size: width and height of the camera's images.
        names: classes by number, for files that do not list them.
        min_score: results with a lower score are left out.
        one_image: entries need not state their image.
    """
    entries = content
    images: list[ImageKey] | None = None
    head = _FileHead(names, {}, None, False)
    if isinstance(content, dict):
        entries = content.get("annotations")
        head, images = _read_file_head(content, names)
    if not isinstance(entries, list):
        raise UnreadableDetections(
            f"holds {quoted(content)}, expected a list of results, or 'annotations' with one"
        )
    segmentations = (_segmentation(entry) for entry in entries if isinstance(entry, dict))
    head = replace(head, shares=are_polygons_shares(segmentations))
    result = CandidateFile(images=images)
    for index, entry in enumerate(entries):
        image = ImageKey(None, None)
        try:
            if not isinstance(entry, dict):
                raise ValueError(f"expected a result, found {quoted(entry)}")
            image = image_of(entry, head.listed, one_image)
            score = _score(entry)
            if score < min_score:
                continue
            segmentation = _segmentation(entry)
            if not head.shares and are_polygons_shares([segmentation]):
                raise ValueError(
                    "its corners are shares of the image's size, those of other results pixels; "
                    "write pixels"
                )
            instance, factors = _instance(entry, score, image, head, size)
        except ValueError as error:
            result.add_fault(f"entry {index}", image, error)
        else:
            result.results.append((image, instance))
            result.scaled += factors not in ((1.0, 1.0), size)
            result.shares += factors == size
            result.beyond += reaches_beyond(segmentation, factors, size)
            if not (isinstance(segmentation, dict) and "counts" in segmentation):
                ends = np.add(instance.box[:2], instance.box[2:]) / size
                result.extent = max(result.extent, float(ends.max()))
        result.entries += 1
    return result


def read_head(path: Path) -> Any:
    """Parse a small file, or the first results of a long list of them.

    Returns None if a large file does not begin with results. Raises :class:`UnreadableDetections`
    as :func:`read_json` does.
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


def read_first(path: Path) -> Any:
    """Parse a file; of a long list of results, only the first ones.

    Raises :class:`UnreadableDetections` as :func:`read_json` does.
    """
    content = read_head(path)
    return read_json(path) if content is None else content


def read_json(path: Path) -> Any:
    """Parse a file; raises :class:`UnreadableDetections` if it is no JSON or too large."""
    content = _bytes(path)
    try:
        return parse_json(content.decode("utf-8-sig"))
    except ValueError as error:
        raise UnreadableDetections(f"is not valid JSON ({error}); write it again") from None


def _bytes(path: Path, head: int | None = None) -> bytes:
    try:
        return read_bytes(path, head=head)
    except UnreadableFile as error:
        smaller = "; write masks as compressed RLE, or one file an image"
        is_large = " MB, at most" in error.reason
        raise UnreadableDetections(error.reason + (smaller if is_large else "")) from None


def _read_file_head(
    content: dict[str, Any], names: Mapping[int, str]
) -> tuple[_FileHead, list[ImageKey] | None]:
    """Return what a data set states for all entries, and the images that it lists."""
    own: dict[int, str] = {}
    if content.get("categories"):
        try:
            own = parse_class_names(content["categories"])
        except ValueError as error:
            raise UnreadableDetections(
                f"'categories' must list objects with id and name ({error})"
            ) from None
    size = _size(content.get("img_width"), content.get("img_height"))
    corners = content.get("box_format") == "xyxy"
    listed = read_listed_images(content)
    return _FileHead({**names, **own}, listed_images(listed), size, corners), listed


def read_listed_images(content: dict[str, Any]) -> list[ImageKey] | None:
    """The images that a data set lists; None if it lists none.

    Raises :class:`UnreadableDetections` if they are not objects with an id.
    """
    if "images" not in content:
        return None
    values, images = content["images"], []
    if not isinstance(values, list):
        raise UnreadableDetections("'images' must be a list of objects with id")
    for value in values:
        number = value.get("id") if isinstance(value, dict) else None
        if type(number) is not int or not 0 <= number <= LARGEST_ID:
            raise UnreadableDetections(f"'images' must list objects with id, found {quoted(value)}")
        name = value.get("file_name")
        size = _size(value.get("width"), value.get("height"))
        images.append(ImageKey(number, name if isinstance(name, str) else None, size))
    return images


def listed_images(images: list[ImageKey] | None) -> dict[int | str, ImageKey]:
    """Images that a file lists, by id and by name."""
    return {key: image for image in images or () for key in image[:2] if key is not None}


def _size(width: Any, height: Any) -> tuple[int, int] | None:
    if type(width) is int and type(height) is int and min(width, height) > 0:
        return width, height
    return None


def image_of(
    entry: dict[str, Any], listed: Mapping[int | str, ImageKey], one_image: bool
) -> ImageKey:
    """The image of an entry; ``listed``: images by id and by name.

    Raises ValueError if the entry does not state its image, unless the file is of ``one_image``.
    """
    value, name = entry.get("image_id"), entry.get("file_name", entry.get("image_path"))
    if isinstance(value, str):
        value, name = None, value
    if not isinstance(name, str):
        name = None
    if value is None and (one_image or name is not None):
        known = listed.get(name) if name is not None else None
        return ImageKey(None, name, None if known is None else known.size)
    if type(value) is not int or not 0 <= value <= LARGEST_ID:
        raise ValueError(
            "image_id must be the whole number of a colour image from 0, or its file's name, "
            f"found {quoted(value)}"
        )
    known = listed.get(value) or ImageKey(value, None)
    return known if name is None else known._replace(name=name)


def _instance(
    entry: dict[str, Any], score: float, image: ImageKey, head: _FileHead, size: tuple[int, int]
) -> tuple[Instance, tuple[float, float]]:
    """The instance of an entry, and the factors by which its mask was scaled."""
    label = _label(entry, head.names)
    stated = image.size or head.size
    rle, factors = to_rle(_segmentation(entry), size, stated, shares=head.shares)
    instance = make_instance(label, score, rle, size)
    if instance is None:
        raise ValueError("its mask is empty")
    box = entry.get("bbox", entry.get("box"))
    if box is None or factors != (1.0, 1.0):
        return instance, factors
    corners = head.corners
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
    # A box may exceed the image by the image's size.
    near = x >= -size[0] and x + w <= 2 * size[0] and y >= -size[1] and y + h <= 2 * size[1]
    if not (w >= 0 and h >= 0 and near):
        raise ValueError(
            f"bbox is {quoted(box)}, expected pixels of the image of {size[0]}x{size[1]}"
        )
    return (replace(instance, box=(x, y, w, h)) if w and h else instance), factors


def _segmentation(entry: dict[str, Any]) -> Any:
    return entry.get("segmentation", entry.get("segments"))


def _score(entry: dict[str, Any]) -> float:
    """Score of an entry; 1 if the entry states none."""
    keys = ("score", "confidence", "predicted_iou")
    value = next((entry[key] for key in keys if key in entry), 1.0)
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    try:
        score = float(value) if type(value) in (int, float) else math.nan
    except OverflowError:
        score = math.inf
    if not -0.01 <= score <= MAX_SCORE:
        raise ValueError(f"score is {quoted(value)}, expected a number from 0 to 1")
    return score


def _label(entry: dict[str, Any], names: Mapping[int, str]) -> str:
    """The class's name; "" if the detector knows no classes."""
    for key in ("category_name", "category", "class_name", "class", "label", "name"):
        if isinstance(entry.get(key), str):
            return check_label(entry[key])
    present = [key for key in ("category_id", "class", "class_id", "label") if key in entry]
    if not present:
        return ""
    for key in present:
        if type(entry[key]) is int:
            return names.get(entry[key], f"category {quoted(entry[key])}")
    raise ValueError(
        f"{present[0]} is {quoted(entry[present[0]])}, expected a class's number or name; "
        "state category_id or category_name"
    )
