"""Label maps: which class a detector's number means, from the settings or a file of classes.

A file is a COCO or LVIS data set (its ``categories``), a mapping of numbers to names, a list of
names from 0 (JSON, or YAML, also under ``names`` as YOLO keeps it), or text with a name a line.
"""

from __future__ import annotations

from pathlib import Path

import yaml

from intercap_core.errors import UserError
from intercap_core.formats.detections.class_names import COCO_NAMES, COCO_NAMES_FROM_0, names_of
from intercap_core.formats.detections.constants import MAX_LABELS_BYTES
from intercap_core.inputs.files import read_text
from intercap_core.inputs.json_files import parse_json
from intercap_core.inputs.yaml_files import parse_yaml

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
    text = read_text(
        path,
        MAX_LABELS_BYTES,
        advice="name a list of classes, such as a data set's 'categories' alone, as "
        "docs/detectors.md shows",
    )
    suffix = path.suffix.lower()
    try:
        if suffix == ".json":
            return names_of(parse_json(text))
        if suffix in (".yaml", ".yml"):
            return names_of(parse_yaml(text))
        return names_of([line.strip() for line in text.strip().splitlines()])
    except (ValueError, yaml.YAMLError) as error:
        words = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise UserError(
            f"{path}: is no list of classes ({words}); expected 'categories' as COCO has them, a "
            "mapping of numbers to names, or names in order"
        ) from None
