"""Numbers in the names of image files: which of them is the number, or the time, of an image.

The recogniser serves colour, depth and detections. A number identifies images if it stands at the
same place in all names and differs in all of them. For the files of a recording, a second witness
is required: the number counts the files in the natural order of their names, in which ``frame2``
precedes ``frame10``, or in equal steps. Names without such a number are ordered only if all of them
have one form; otherwise the camera is refused.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from intercap_core.errors import UserError

_WHOLE = re.compile(r"\d{1,25}")
_DECIMAL = re.compile(r"\d{1,15}(?:\.\d{1,9})?")
_LAST_DECIMAL = re.compile(r"(\d+)\.(\d+)(?=\D*$)")  # the last number of a name

FRAME_FOLDER = re.compile(r"t(\d{1,6}(?:\.\d{1,6})?)")  # BEHAVE's folder of one time, seconds

NumberingKind = Literal["number", "time", "order"]


class Numbering(NamedTuple):
    """The place of each file among the images of a camera."""

    kind: NumberingKind
    """Meaning of the keys: number of the image, time in seconds, or position."""
    keys: list[float]
    """Key of each file."""


def number_fields(texts: Mapping[str, str], *, decimals: bool = False) -> list[dict[str, float]]:
    """Numbers that may identify images, by the keys of ``texts``; the last one of each text first.

    A field is a number at the same place in all texts that have numbers, and differs in all of
    them. Places count from the end, then from the start. ``decimals`` adds decimal numbers, such as
    times in seconds, as last fields.
    """
    fields: list[dict[str, float]] = []
    for form in (_WHOLE, _DECIMAL)[: 1 + decimals]:
        parse: type[float] = int if form is _WHOLE else float  # times have more digits than floats
        found = {key: numbers for key, text in texts.items() if (numbers := form.findall(text))}
        fewest = min(map(len, found.values()), default=0)
        for at in (*range(-1, -fewest - 1, -1), *range(fewest)):
            field = {key: parse(numbers[at]) for key, numbers in found.items()}
            if len(set(field.values())) == len(field) and field not in fields:
                fields.append(field)
    return fields


def natural_key(name: str) -> list[str | int]:
    """Sorting key that compares numbers in names by value."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"([0-9]+)", name)]


def recognise_numbering(
    files: Sequence[Path], source: Path, *, like: Collection[float] = ()
) -> Numbering:
    """Recognise the numbers, or times in seconds, in the names of a camera's files.

    Raises UserError, naming ``source``, if the place of any file is not determined.

    Args:
        files: image files of one folder.
        source: folder or video, for messages.
        like: numbers of the images to which the files belong. Of several numbers in the names, the
            one that shares the most values with them is used; otherwise the last one.
    """
    if _are_times(files):
        found = (_LAST_DECIMAL.search(file.stem) for file in files)
        return Numbering("time", [float(match.group()) for match in found if match])
    stems = {file.name: file.stem for file in files}
    natural = sorted(stems, key=natural_key)
    fields = [field for field in number_fields(stems) if len(field) == len(files)]
    counting = [field for field in fields if _counts(field, natural)]
    if counting or not files:
        best = max(counting, key=lambda field: len({*like} & {*field.values()}), default={})
        return Numbering("number", [best[file.name] for file in files])
    forms: dict[str, str] = {}
    for name in natural:
        forms.setdefault(re.sub(r"\d+", "#", stems[name]), name)
    is_numbered = any(_WHOLE.search(stem) for stem in stems.values())
    if fields or (is_numbered and len(forms) > 1):
        examples = [fields and natural[0], *forms.values(), natural[-1]]
        first, second = list(dict.fromkeys(name for name in examples if name))[:2]
        raise UserError(
            f"{source}: the names do not determine the order of the images, for example {first} "
            f"and {second}: expected one number for each image, such as 00012.jpg; rename or "
            "remove such files, or write a timestamps.csv ('name, seconds')"
        )
    return Numbering("order", [natural.index(file.name) for file in files])


def _counts(field: Mapping[str, float], natural: list[str]) -> bool:
    """Whether a field increases in the natural order of the names, or has equal steps."""
    values = [field[name] for name in natural]
    steps = {after - before for before, after in itertools.pairwise(sorted(values))}
    return values == sorted(values) or len(steps) == 1


def _are_times(files: Sequence[Path]) -> bool:
    """Whether all names end in decimal numbers.

    Names of one whole part (k1.0001.png), or of one decimal part (0001.k1.png), have two numbers.
    """
    found = [_LAST_DECIMAL.search(file.stem) for file in files]
    parts = zip(*(match.groups() for match in found if match), strict=True)
    return None not in found and all(len(set(part)) > 1 for part in parts) and bool(found)
