"""Label maps: which class a detector's number means, from the settings or a file of classes.

A file is a COCO or LVIS data set (its ``categories``), a mapping of numbers to names, a list of
names from 0 (JSON, or YAML, also under ``names`` as YOLO keeps it), or text with a name a line.
"""

from __future__ import annotations

import json
from pathlib import Path

import yaml

from intercap_core.detections.class_names import COCO_NAMES, COCO_NAMES_FROM_0, names_of
from intercap_core.detections.constants import MAX_LABELS_BYTES
from intercap_core.errors import UserError

BUILT_IN = {"coco": COCO_NAMES, "coco80": COCO_NAMES_FROM_0}


def class_names(setting: str | Path) -> dict[int, str]:
    """Names by number of the setting ``category_names``: a built-in numbering or a file.

    Raises UserError as :func:`read_label_map` does.
    """
    if isinstance(setting, str) and setting in BUILT_IN:
        return BUILT_IN[setting]
    return read_label_map(Path(setting))


def read_label_map(path: Path) -> dict[int, str]:
    """Read a file of class names. Raises UserError naming what is wrong with it."""
    try:
        size = path.stat().st_size
        if size > MAX_LABELS_BYTES:
            raise UserError(
                f"{path}: has {size / 1e6:.0f} MB, expected a list of classes; keep the data set's "
                "'categories' alone, as docs/detectors.md shows"
            )
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: is no text in UTF-8; write the class names again") from None
    suffix = path.suffix.lower()
    try:
        if suffix == ".json":
            return names_of(json.loads(text))
        if suffix in (".yaml", ".yml"):
            return names_of(yaml.safe_load(text))
        return names_of([line.strip() for line in text.strip().splitlines()])
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        words = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise UserError(
            f"{path}: is no list of classes ({words}); expected 'categories' as COCO has them, a "
            "mapping of numbers to names, or names in order"
        ) from None
