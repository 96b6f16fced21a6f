"""Times of the image files of a folder: from a file of timestamps, or from their numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.recordings.image_files import ImagePair
from intercap_core.formats.recordings.numbering import (
    Numbering,
    NumberingKind,
    recognise_numbering,
)
from intercap_core.inputs.files import quoted, read_text

SUFFIXES = (".csv", ".txt", ".tsv")
LATEST_S = 1e11  # beyond all clocks that count seconds; in microseconds it fits into 64 bits
Timestamps = Mapping[str | int, float]  # seconds by name, or by position if lines have no names


def find_timestamps(stem: Path) -> Path | None:
    """Return ``<stem>.csv``, ``.txt`` or ``.tsv``, suffixes in any case; None if none exists.

    Raises UserError if there are several.
    """
    folder = stem.parent
    entries = sorted(folder.iterdir()) if folder.is_dir() else []
    named = [path for path in entries if path.stem == stem.name]
    files = [path for path in named if path.suffix.lower() in SUFFIXES and path.is_file()]
    if len(files) > 1:
        raise UserError(f"{folder}: has {files[0].name} and {files[1].name}; keep one")
    return files[0] if files else None


def read_timestamps(path: Path) -> Timestamps:
    """Read a time from each line, ``seconds`` or ``name, seconds``; there may be a header.

    Returns the times by name, or by 0, 1, ... if the lines have no names. Raises UserError naming
    file and line for text that is no number, for a repeated name, and for milliseconds.
    """
    lines = read_text(path).splitlines()
    times: dict[str | int, float] = {}
    for number, line in enumerate(lines, start=1):
        fields = [field for field in re.split(r"[,;\s]+", line.strip().lstrip("#")) if field]
        if not fields:
            continue
        try:
            seconds = float(fields[-1])
        except ValueError:
            seconds = np.nan
        if not np.isfinite(seconds) or len(fields) > 2:
            if not times and number == 1:
                continue  # a header
            raise UserError(
                f"{path}, line {number}: found {quoted(line)}, expected 'seconds' or 'name, "
                "seconds'; correct it"
            )
        name = fields[0] if len(fields) == 2 else len(times)
        if name in times:
            raise UserError(f"{path}, line {number}: {quoted(name)} is given twice; keep one")
        if abs(seconds) > LATEST_S:
            raise UserError(f"{path}, line {number}: {seconds:.4g} are no seconds; write seconds")
        times[name] = seconds
    _check_seconds(path, list(times.values()))
    return times


def _check_seconds(path: Path, times: list[float]) -> None:
    """Raise UserError, naming ``path``, if times are too far apart to be seconds."""
    steps = np.abs(np.diff(times))
    if len(steps) and np.median(steps) > 5:  # not even a time lapse is so slow
        raise UserError(
            f"{path}: times are {np.median(steps):.4g} apart, expected seconds, so they are likely "
            "milliseconds or less; write seconds"
        )


def frame_rate(times_us: np.ndarray) -> float | None:
    """Images a second, from the median step of device times (N,); None for fewer than 2."""
    steps = np.abs(np.diff(np.asarray(times_us, np.float64)))
    steps = steps[steps > 0]
    return float(1e6 / np.median(steps)) if len(steps) else None


class PairedImages(NamedTuple):
    """The image files of one camera."""

    pairs: list[ImagePair]
    """Files in order of time."""
    timing: str
    """Source of the times, which follows "images": by number, by time, ..."""
    notes: list[str]
    """Notes on files whose place is assumed; each follows the camera's name in a message."""


def pair_images(
    colour: list[Path],
    depth: list[Path],
    *,
    fps: float | None,
    offset_s: float,
    times: Timestamps | None,
    source: Path,
    images: int = 0,
) -> PairedImages:
    """Pair colour and depth files of one camera, with their times.

    Files are paired by the numbers in their names (:mod:`.numbering`). Decimal numbers of which
    both parts change (1305031102.175304.png) are times in seconds; stated times of other images
    then give the difference of the clocks. Raises UserError, naming ``source``, if times are
    unknown or missing, if whole numbers in the names are times, or if the names do not determine
    which files belong together.

    Args:
        colour: colour files.
        depth: depth files.
        fps: images a second; the number in a name divided by it is the time. None = unknown.
        offset_s: seconds that are added to all times.
        times: times of :func:`read_timestamps`, which take precedence over ``fps``: by name, by
            name without suffix, by number, or one for each colour image in order.
        source: folder or video, for messages.
        images: number of images of a video; 0 = unknown.
    """
    pairs, kind, notes = _pair_by_key(colour, depth, source, times or {}, images)
    keys = sorted(pairs)
    if times is not None:
        seconds = {} if kind == "time" and not colour else _stated(pairs, times, source)
        if kind == "time":  # images without a stated time: those of depth between those of colour
            later = [time - key for key, time in seconds.items()]
            seconds = {key: key + float(np.median(later or [0.0])) for key in keys} | seconds
    elif kind == "time":
        taken = [key for key in keys if pairs[key][0] or not colour]
        _check_seconds(source, taken)
        step = float(np.median(np.diff(taken))) if len(taken) > 1 else None
        if fps and step and not 1 / 1.5 < step * fps < 1.5:
            raise UserError(
                f"{source}: the numbers in the names are {step:g} apart, which is no time between "
                f"images at {fps:g} a second; correct fps, or write a timestamps.csv in seconds "
                "('name, seconds')"
            )
        seconds = {key: key for key in keys}
    elif fps is None:
        raise UserError(
            f"{source}: the times of the images are unknown; add fps to the calibration, "
            "or a timestamps.csv"
        )
    else:
        _refuse_whole_times([key for key in keys if pairs[key][0] or not colour], fps, source)
        seconds = {key: key / fps for key in keys}
    latest = max((abs(time + offset_s) for time in seconds.values()), default=0.0)
    if latest > LATEST_S:
        raise UserError(
            f"{source}: an image would be taken at {latest:.3g} s, so the numbers in the names are "
            "likely times, or time_offset is no seconds; write a timestamps.csv in seconds"
        )
    shots = [
        ImagePair(round((seconds[key] + offset_s) * 1e6), *pairs[key])
        for key in keys
        if key in seconds
    ]
    return PairedImages(shots, "by timestamps" if times is not None else f"by {kind}", notes)


def _refuse_whole_times(numbers: list[float], fps: float, source: Path) -> None:
    """Raise UserError if sorted whole numbers of images are times in a fraction of a second.

    They are if the median step is the period of ``fps``: roughly, or to rounding if all steps are
    equal.
    """
    steps = np.diff(numbers)
    if not len(steps) or np.median(steps) < 2:
        return
    rounding = 0.5 / np.median(steps)
    tolerance = 0.25 if (steps % steps.min()).any() else rounding
    for unit, name in ((1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds")):
        if abs(np.median(steps) * unit * fps - 1) <= tolerance:
            raise UserError(
                f"{source}: the numbers in the names are {np.median(steps):g} apart, so at "
                f"{fps:g} images a second they are likely {name}; write a timestamps.csv in "
                "seconds ('name, seconds')"
            )


def _pair_by_key(
    colour: list[Path], depth: list[Path], source: Path, times: Timestamps, images: int
) -> tuple[dict[float, tuple[Path | None, Path | None]], NumberingKind, list[str]]:
    """Colour and depth file by number, time or position, the kind of these keys, and notes.

    If the names do not determine the order of the colour files, ``times`` by name determine it.
    """
    try:
        of_colour = recognise_numbering(colour, source)
    except UserError:
        stated = [times.get(path.name, times.get(path.stem, np.nan)) for path in colour]
        if not np.isfinite(stated).all():
            raise
        of_colour = Numbering("order", np.argsort(np.argsort(stated, kind="stable")).tolist())
    of_depth = recognise_numbering(depth, source / "depth", like=of_colour.keys)
    kind = of_colour.kind if colour else of_depth.kind
    notes: list[str] = []
    if colour and depth and (kind == "order" or of_depth.kind != kind):
        order = {path.stem: key for path, key in zip(colour, of_colour.keys, strict=True)}
        strays = [path.name for path in depth if path.stem not in order]
        if strays:
            raise UserError(
                f"{source}: depth/{strays[0]} has neither a number nor the name of a colour image; "
                "number both alike"
            )
        of_depth = Numbering(kind, [order[path.stem] for path in depth])
    elif depth and kind == "number" and (colour or images):
        names = [path.name for path in colour] or [f"image {n}" for n in range(images)]
        shift, note = _align(
            dict(zip(of_colour.keys or range(images), names, strict=True)),
            dict(zip(of_depth.keys, (path.name for path in depth), strict=True)),
            source,
        )
        of_depth = Numbering(kind, [key - shift for key in of_depth.keys])
        notes += [note] if note else []
    if kind == "order" and colour and not times:
        notes.append(
            "its images are taken in the order of their names, which have no number of their own; "
            "if images are missing, write a timestamps.csv"
        )
    by_key = [
        dict(zip(numbering.keys, files, strict=True))
        for numbering, files in ((of_colour, colour), (of_depth, depth))
    ]
    keys = {*by_key[0], *by_key[1]}
    return {key: (by_key[0].get(key), by_key[1].get(key)) for key in keys}, kind, notes


def _align(
    images: Mapping[float, str], given: Mapping[float, str], source: Path
) -> tuple[float, str]:
    """Depth number minus colour number of one image, and a note if it is not 0.

    Equal numbers belong together, unless there is one depth file for each colour image and all
    numbers differ by one constant. Raises UserError if no number is equal otherwise.

    Args:
        images: descriptions of the colour images by number.
        given: names of the depth files by number.
        source: folder or video, for messages.
    """
    first, first_given = min(images), min(given)
    shift = first_given - first
    if shift and [number - shift for number in sorted(given)] == sorted(images):
        return shift, (
            f"its depth has a counter of its own: depth/{given[first_given]} is taken for the "
            f"depth of {images[first]}; if equal numbers belong together, remove the images "
            "without a partner"
        )
    if not images.keys() & given.keys():
        raise UserError(
            f"{source}: no depth file has the number of a colour image, the first ones are "
            f"depth/{given[first_given]} and {images[first]}; number both alike"
        )
    return 0, ""


def _stated(
    pairs: Mapping[float, tuple[Path | None, Path | None]], times: Timestamps, source: Path
) -> dict[float, float]:
    """The stated time, seconds, of each key.

    Times without names belong to the colour images in order. If there are none, as for the depth
    files of a video, the key is the position of the time in the list.
    """
    coloured = [key for key in sorted(pairs) if pairs[key][0] is not None]
    if all(isinstance(name, int) for name in times):
        if not coloured:
            return {key: times[int(key)] for key in pairs if key in times}
        if len(times) == len(coloured):
            return dict(zip(coloured, times.values(), strict=True))
        raise UserError(
            f"{source}: {len(times)} timestamps for {len(coloured)} colour images; write one for "
            "each, or 'name, seconds'"
        )
    by_number: dict[float, float] = {
        int(name): time
        for name, time in times.items()
        if isinstance(name, str) and re.fullmatch(r"[0-9]{1,18}", name)
    }
    seconds = {}
    for key, files in pairs.items():
        names = [name for file in files if file is not None for name in (file.name, file.stem)]
        stated = next((times[name] for name in names if name in times), by_number.get(key))
        if stated is not None:
            seconds[key] = stated
    missing = [path.name for key in coloured if key not in seconds and (path := pairs[key][0])]
    if missing:
        raise UserError(
            f"{source}: {len(missing)} images have no timestamp (first: {missing[0]}); add them, "
            "or remove the images"
        )
    return seconds
