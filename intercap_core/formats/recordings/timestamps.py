"""Times of the image files of a folder: from a file of timestamps, or from their numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.recordings.image_files import ImagePair
from intercap_core.inputs.files import quoted, read_text

SUFFIXES = (".csv", ".txt")
LATEST_S = 1e11  # beyond all clocks that count seconds; in microseconds it fits into 64 bits
_DECIMAL = re.compile(r"(\d+)\.(\d+)(?=\D*$)")  # the last number of a name
Timestamps = Mapping[str | int, float]  # seconds by name, or by position if lines have no names


def find_timestamps(stem: Path) -> Path | None:
    """Return ``<stem>.csv`` or ``<stem>.txt``; None if neither exists."""
    files = [stem.with_name(stem.name + suffix) for suffix in SUFFIXES]
    return next((file for file in files if file.is_file()), None)


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


def pair_images(
    colour: list[Path],
    depth: list[Path],
    *,
    fps: float | None,
    offset_s: float,
    times: Timestamps | None,
    source: Path,
) -> list[ImagePair]:
    """Pair colour and depth files of one camera, with their times.

    Files are paired by the last number in their names, or by order if any name has no number of its
    own. Decimal numbers of which both parts change (1305031102.175304.png) are times in seconds;
    stated times of other images then give the difference of the clocks.
    Raises UserError, naming ``source``, if times are unknown or missing, or if whole numbers in the
    names are times.

    Args:
        colour: colour files.
        depth: depth files.
        fps: images a second; the number in a name divided by it is the time. None = unknown.
        offset_s: seconds that are added to all times.
        times: times of :func:`read_timestamps`, which take precedence over ``fps``: by name, by
            name without suffix, by number, or one for each colour image in order.
        source: folder or video, for messages.
    """
    pairs, named_by_time = _by_key(colour, depth, source)
    keys = sorted(pairs)
    if times is not None:
        seconds = {} if named_by_time and not colour else _stated(pairs, times, source)
        if named_by_time:  # images without a stated time: those of depth between those of colour
            later = [time - key for key, time in seconds.items()]
            seconds = {key: key + float(np.median(later or [0.0])) for key in keys} | seconds
    elif named_by_time:
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
    return [
        ImagePair(round((seconds[key] + offset_s) * 1e6), *pairs[key])
        for key in keys
        if key in seconds
    ]


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


def _by_key(
    colour: list[Path], depth: list[Path], source: Path
) -> tuple[dict[float, tuple[Path | None, Path | None]], bool]:
    """Colour and depth file by number or, if any name has no number of its own, by position.

    The second value is whether the numbers are times in seconds.
    """
    by_time = any(_are_times(paths) for paths in (colour, depth))
    number_of = _decimal if by_time else _number
    by_number = [{number_of(path): path for path in paths} for paths in (colour, depth)]
    are_numbered = all(
        len(numbers) == len(paths) and None not in numbers
        for numbers, paths in zip(by_number, (colour, depth), strict=True)
    )
    if not are_numbered:
        order = {path.stem: index for index, path in enumerate(colour)}
        strays = [path.name for path in depth if path.stem not in order]
        if strays and colour:
            raise UserError(
                f"{source}: depth/{strays[0]} has neither a number nor the name of a colour image; "
                "number both alike"
            )
        by_number = [
            dict(enumerate(colour)),
            {order.get(path.stem, index): path for index, path in enumerate(depth)},
        ]
    keys = {key for numbers in by_number for key in numbers if key is not None}
    pairs = {key: (by_number[0].get(key), by_number[1].get(key)) for key in keys}
    return pairs, by_time and are_numbered


def _number(path: Path) -> float | None:
    match = re.search(r"\d+(?=\D*$)", path.stem)  # the last number of the name
    return int(match.group()) if match else None


def _decimal(path: Path) -> float | None:
    match = _DECIMAL.search(path.stem)
    return float(match.group()) if match else None


def _are_times(paths: list[Path]) -> bool:
    """Whether all names end in decimal numbers.

    Names of one whole part (k1.0001.png), or of one decimal part (0001.k1.png), have two numbers.
    """
    found = [_DECIMAL.search(path.stem) for path in paths]
    parts = zip(*(match.groups() for match in found if match), strict=True)
    return None not in found and all(len(set(part)) > 1 for part in parts) and bool(found)


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
