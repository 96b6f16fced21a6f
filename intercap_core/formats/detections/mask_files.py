"""Masks as image files: one instance a file, or several that are numbered in one file."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image

from intercap_core.formats.calibration.opencv import MAX_SIDE
from intercap_core.formats.detections.class_names import MAX_LABEL
from intercap_core.formats.detections.instance import (
    MASK_THRESHOLD,
    PERSON_LABEL,
    Instance,
    make_instance,
    resize_mask,
    scale_to,
)
from intercap_core.formats.recordings.behave import frame_folders
from intercap_core.formats.recordings.image_files import DamagedImage, encoded_size, read_content
from intercap_core.geometry.camera import masks
from intercap_core.inputs.files import printable

BEHAVE_PERSON = ("person_mask",)
BEHAVE_OBJECT = ("obj_rend_mask", "obj_mask")  # the second is used if the first is missing

SMOOTH_WIDTH = 5  # px, largest width of the smooth outline of a mask
MAX_INSTANCES = 1000  # in one image; an image with more values is not a mask


class MaskFile(NamedTuple):
    """One file of masks of one image."""

    path: Path
    """The file."""
    label: str
    """Label of its instances; "" = unknown."""
    inverted: bool = False
    """Dark pixels are the instance."""
    numbered: bool = False
    """If no pixel is white, each value except 0 is an instance."""


def read_masks(file: MaskFile, size: tuple[int, int]) -> list[Instance]:
    """Read the masks of an image of ``size`` (width, height) as instances of score 1.

    Empty masks are left out. A mask of the whole picture at another resolution is scaled. Raises
    :class:`DamagedImage`.
    """
    content = read_content(file.path)
    stored = encoded_size(content)
    if stored is None or max(stored) > MAX_SIDE:
        raise DamagedImage("is no image" if stored is None else "is too large an image")
    image = _decode(content, file.numbered)
    try:
        scale_to((image.shape[1], image.shape[0]), size)
    except ValueError:
        raise DamagedImage(
            f"has {image.shape[1]}x{image.shape[0]} pixels, the image {size[0]}x{size[1]}"
        ) from None
    instances = []
    found = list(_split(image, file))
    if len(found) == 1 and found[0][[0, -1]].all() and found[0][:, [0, -1]].all():
        raise DamagedImage("covers the whole border of the image, as an inverted mask does")
    for mask in found:
        fitting = mask if mask.shape == size[::-1] else resize_mask(mask, size)
        instance = make_instance(file.label, 1.0, masks.encode(fitting), size)
        if instance is not None:
            instances.append(instance)
    return instances


def is_mask(path: Path) -> bool:
    """Whether an image file is a mask: it has few values, two of which most of its pixels have.

    Neither photographs nor depth are like that.
    """
    try:
        sampled = _decode(read_content(path), numbered=True)[::4, ::4]
    except DamagedImage:
        return False
    _, counts = np.unique(sampled, return_counts=True)
    return len(counts) <= MAX_INSTANCES and bool(2 * np.sort(counts)[-2:].sum() > counts.sum())


def _decode(content: bytes, numbered: bool) -> np.ndarray:
    """The values (H, W) of a mask file: grey levels, or numbers of instances.

    The numbers are the indices of a palette (VOC, DAVIS) and one for each colour except black. The
    alpha channel of a picture that is cut out is its mask. Raises :class:`DamagedImage`.
    """
    kind = cv2.IMREAD_UNCHANGED if numbered else cv2.IMREAD_GRAYSCALE
    try:
        if numbered and content[25:26] == b"\x03":  # a PNG's type of colour: palette
            indices = np.asarray(Image.open(io.BytesIO(content)))
            is_void = (indices == 255) & bool(((indices > 0) & (indices < 255)).any())
            return np.where(is_void, 0, indices).astype(np.uint16)
        image = cv2.imdecode(np.frombuffer(content, np.uint8), kind)
    except (cv2.error, OSError, SyntaxError, ValueError):  # damaged, or too large to decode
        image = None
    if image is None:
        raise DamagedImage("is no image")
    if image.ndim == 2:
        return image
    if image.shape[2] == 4 and np.ptp(image[..., 3]):
        return np.where(image[..., 3] >= MASK_THRESHOLD, 255, 0).astype(np.uint8)
    colours = image[..., :3]
    level = colours.max(-1)
    brightest = colours.reshape(-1, 3)[colours.sum(-1, dtype=int).argmax()].astype(float)
    shade = brightest * (level / max(brightest.max(), 1))[..., None]
    if np.abs(colours - shade).max() < 4:  # one colour, whose outline may be smooth
        if np.ptp(brightest) and _is_smooth(level):
            return np.where(level >= brightest.max() / 2, 255, 0).astype(np.uint8)
        return level
    return colours.astype(np.int64) @ (1, 1 << 16, 1 << 32)


def _is_smooth(level: np.ndarray) -> bool:
    """Whether levels (H, W) are of one mask with a smooth outline, not the numbers of instances.

    Most pixels of the mask have the highest level, and the others are near them.
    """
    inner = (level == level.max()).astype(np.uint8)
    near = cv2.dilate(inner, np.ones((2 * SMOOTH_WIDTH + 1, 2 * SMOOTH_WIDTH + 1), np.uint8))
    return 2 * inner.sum() > np.count_nonzero(level) and bool(near[level > 0].all())


def _has_void(image: np.ndarray) -> bool:
    """Whether 255 is the void of a grey image of numbers, not the instance of a smooth mask."""
    numbers = image[image < 255]
    return 0 < numbers.max(initial=0) < MASK_THRESHOLD and not _is_smooth(image)


def _split(image: np.ndarray, file: MaskFile) -> Iterator[np.ndarray]:
    """The masks (H, W) bool of a grey image."""
    is_grey = image.dtype == np.uint8
    if file.inverted:
        yield image < MASK_THRESHOLD
    elif not file.numbered or (is_grey and image.max() == 255 and not _has_void(image)):
        yield image >= MASK_THRESHOLD
    elif is_grey and image.max() >= MASK_THRESHOLD and _is_smooth(image):
        yield image >= image.max() / 2
    else:
        if is_grey:  # of the classes of a data set, 255 is the void
            image = np.where(image == 255, 0, image)
        values = np.unique(image)
        if len(values) > MAX_INSTANCES:
            raise DamagedImage(
                f"has {len(values)} different values, expected black and white or a number for "
                "each instance"
            )
        for value in values[values != 0]:
            yield image == value


def find_instance_masks(folder: Path) -> dict[str, list[MaskFile]]:
    """Mask files of one camera by the name of their image.

    Names are ``<image>.png`` without a label, ``<image>__<label>.png``,
    ``<image>__<label>__<n>.png``, or in a folder ``<image>/`` the label between digits:
    ``3_cup.png``.
    """
    result: dict[str, list[MaskFile]] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            for inner in sorted(path.iterdir()):
                if _is_png(inner):
                    label = printable(inner.stem).strip("0123456789_-. ")[:MAX_LABEL]
                    result.setdefault(path.name, []).append(MaskFile(inner, label, numbered=True))
        elif _is_png(path):
            image, _, rest = path.stem.partition("__")
            label = printable(rest.partition("__")[0])[:MAX_LABEL]
            result.setdefault(image, []).append(MaskFile(path, label, numbered=True))
    return result


def _is_png(path: Path) -> bool:
    return path.suffix.lower() == ".png" and not path.name.startswith(".") and path.is_file()


def find_release_masks(candidates: Path, camera: str) -> dict[int, MaskFile] | None:
    """Person masks of one camera as the InterCap release's tools store them, by image number.

    Names are ``<camera>/<number>.png`` or ``BodyIndexColor_<n>/<number>.png`` (for camera 1 without
    ``_<n>``). The person is 0 and the background 255. None without such a folder.
    """
    number = camera[1:]
    names = [camera, f"BodyIndexColor_{number}", *(["BodyIndexColor"] if number == "1" else [])]
    for name in names:
        folder = candidates / name
        if folder.is_dir():
            form = re.compile(r"\D*(\d{1,9})\.(?:png|jpe?g)", re.IGNORECASE)
            matches = ((path, form.fullmatch(path.name)) for path in sorted(folder.iterdir()))
            return {int(m.group(1)): MaskFile(path, PERSON_LABEL, True) for path, m in matches if m}
    return None


class BehaveFiles:
    """Keypoints and masks in the folders of BEHAVE's images, by the image's time, microseconds.

    Masks are of one person and of the sequence's object, whose instances get ``object_label``.
    Without a label they are left out.
    """

    def __init__(self, recordings: Path, object_label: str | None) -> None:
        self._folders = frame_folders(recordings) if recordings.is_dir() else {}
        self._labels: dict[tuple[str, ...], str] = {BEHAVE_PERSON: PERSON_LABEL}
        if object_label is not None:
            self._labels[BEHAVE_OBJECT] = object_label

    def keypoints(self, time_us: int, camera: str) -> Path | None:
        """The keypoint file of one image; None if there is none."""
        return self._existing(time_us, f"{camera}.color.json")

    def masks(self, time_us: int, camera: str) -> list[MaskFile]:
        """The masks of one image."""
        result = []
        for kinds, label in self._labels.items():
            paths = (
                self._existing(time_us, f"{camera}.{kind}.{suffix}")
                for kind in kinds
                for suffix in ("png", "jpg")  # the lossless file first
            )
            path = next((path for path in paths if path is not None), None)
            if path is not None:
                result.append(MaskFile(path, label))
        return result

    def _existing(self, time_us: int, name: str) -> Path | None:
        folder = self._folders.get(time_us)
        path = folder / name if folder is not None else None
        return path if path is not None and path.is_file() else None
