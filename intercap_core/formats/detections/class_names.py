"""Names of classes by number: COCO's numberings and files of class names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from intercap_core.errors import UserError
from intercap_core.inputs.documents import parse_json, parse_yaml
from intercap_core.inputs.files import quoted, read_text

MAX_LABEL = 200  # characters; the artefact stores all labels at the length of the longest
# COCO's 80 classes. Their published ids, from 1 to 90, have gaps.
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
# Category ids of COCO from 1 to 90 that no annotated category has.
_UNUSED_IDS = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
COCO_NAMES: dict[int, str] = dict(
    zip([i for i in range(1, 91) if i not in _UNUSED_IDS], _CLASSES, strict=True)
)
COCO_NAMES_FROM_0: dict[int, str] = dict(enumerate(_CLASSES))
COCO_NAMES_FROM_1: dict[int, str] = dict(enumerate(_CLASSES, start=1))


def parse_class_names(content: Any) -> dict[int, str]:
    """Return class names by number from parsed JSON or YAML; raises ValueError without names.

    The content is one of the following, itself or under ``categories`` or ``names``:

    - a list of names, numbered from 0;
    - a mapping of numbers to names;
    - COCO's list of objects with ``id`` and ``name``.
    """
    if isinstance(content, dict):
        for key in ("categories", "names"):
            if isinstance(content.get(key), list | dict):
                return parse_class_names(content[key])
    if isinstance(content, list) and content and all(isinstance(v, dict) for v in content):
        return _unique([(v.get("id"), v.get("name")) for v in content])
    if isinstance(content, list):
        return _unique(list(enumerate(content)))
    if isinstance(content, dict):
        return _unique(list(content.items()))
    raise ValueError(f"it holds {type(content).__name__}")


def _unique(pairs: Sequence[tuple[Any, Any]]) -> dict[int, str]:
    """Names by number; raises ValueError for an invalid or repeated entry, and for none."""
    names: dict[int, str] = {}
    for number, name in pairs:
        if isinstance(number, str) and number.isdecimal() and len(number) < 10:
            number = int(number)
        if type(number) is not int or not isinstance(name, str):
            raise ValueError(f"class {quoted(number, 40)} has the name {quoted(name, 40)}")
        if number in names:
            raise ValueError(f"two classes have the number {number}")
        names[number] = check_label(name)
    if not names:
        raise ValueError("it lists none")
    return names


def check_label(name: str) -> str:
    """Return the name; raises ValueError if it is no valid text or longer than ``MAX_LABEL``."""
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        raise ValueError(f"the category's name {quoted(name)} is not valid text") from None
    if len(name) > MAX_LABEL:
        raise ValueError(f"a category's name has {len(name)} characters, at most {MAX_LABEL}")
    return name


BUILT_IN = {"coco": COCO_NAMES, "coco80": COCO_NAMES_FROM_0}


def class_names(setting: str | Path) -> dict[int, str]:
    """Return class names by number for the setting ``category_names``.

    The setting is a key of ``BUILT_IN`` or the path of a file.

    Raises UserError as :func:`read_label_map` does.
    """
    if isinstance(setting, str) and setting in BUILT_IN:
        return BUILT_IN[setting]
    return read_label_map(Path(setting))


def read_label_map(path: Path) -> dict[int, str]:
    """Read a file of class names. Raises UserError naming what is wrong with it."""
    text = read_text(
        path,
        1 << 26,  # a list of classes has some kB; the annotations are not needed
        advice="name a list of classes, such as a data set's 'categories' alone, as "
        "docs/detectors.md shows",
    )
    suffix = path.suffix.lower()
    try:
        if suffix == ".json":
            return parse_class_names(parse_json(text))
        if suffix in (".yaml", ".yml"):
            return parse_class_names(parse_yaml(text))
        return parse_class_names([line.strip() for line in text.strip().splitlines()])
    except (ValueError, yaml.YAMLError) as error:
        words = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise UserError(
            f"{path}: is no list of classes ({words}); expected 'categories' as COCO has them, a "
            "mapping of numbers to names, or names in order"
        ) from None
