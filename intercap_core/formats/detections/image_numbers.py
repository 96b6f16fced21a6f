"""Match files of detections, and entries of such files, to the colour images of a camera.

A frame set holds one image of each camera, all taken at nearly the same time. The number by which
files refer to an image depends on the layout of the recording:

- ``k4a``, ``ros``, ``behave``, videos: its position among the camera's copied images, from 0;
- ``plain``: its position among the camera's image files, damaged ones included;
- ``intercap``: the number in the image file's name.

Tools also number images from 1, from the first frame of a clip, or by time, and add other numbers
to a name. :meth:`CameraImages.match_numbers` compares the numbers with those of the images.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np

from intercap_core import artefacts
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.coco import DetectionFile, DetectionPreview, ImageKey, Result
from intercap_core.formats.recordings.image_files import FilesRecording
from intercap_core.formats.recordings.intercap import numbers_from_times
from intercap_core.formats.recordings.numbering import number_fields, recognise_numbering
from intercap_core.formats.recordings.plain import PlainLayout
from intercap_core.inputs.files import printable

DOUBT = "set detections."  # in remarks that leave the numbering to the user
FILES_NAMED = 3  # broken files or entries that a note names; the others are only counted
_SUFFIX = re.compile(r"\.(jpe?g|png|bmp|tiff?|webp|json)$", re.IGNORECASE)
_NUMBERS = re.compile(r"\d{1,25}")
# Least share of the images that have a number, for numbers that count from 1; chosen.
MIN_SHARE_SHIFTED = 0.5
# Largest deviation of times from the images' times, in steps between two images; chosen.
MAX_TIME_ERROR = 0.25


@dataclass(frozen=True)
class CameraImages:
    """The colour images of one camera, by frame set."""

    name: str
    """Name of the camera."""
    size: tuple[int, int]
    """Width and height."""
    number: np.ndarray
    """(T,) number of the image of each set; -1 = no image."""
    time_us: np.ndarray
    """(T,) device time of the image, microseconds; -1 = no image, or a recording of layout k4a,
    whose times are not needed."""
    recorded: frozenset[int] = frozenset()
    """Numbers of all images of the camera, including those in no set."""
    stems: tuple[str, ...] = ()
    """Names of the image files without suffix, in the order of their numbers; () if files cannot
    be named after images."""
    first_number: int | None = None
    """Number of the first image in the detections' names and ids; None = recognised."""

    @property
    def sets(self) -> list[int]:
        """Frame sets with an image."""
        return np.flatnonzero(self.number >= 0).tolist()

    def recognise_names(self, names: Iterable[str]) -> tuple[dict[str, int], str]:
        """Numbers of the images that names of files refer to; other names are left out.

        If any name is that of an image file, only names of image files are matched, unless there is
        one name for each image and all numbers differ from the images' by one constant. Otherwise a
        number in the names counts (``frame_0012_k1.jpg`` is image 12): the last one that differs
        in all names and that :meth:`match_numbers` recognises, otherwise the last one. If two names
        end in the same number and no other number differs, the result is empty. The second value
        is a remark on how the names are numbered, "" = from 0.
        """
        stems = {name: strip_suffix(name) for name in sorted(set(names))}
        places = {stem: place for place, stem in enumerate(self.stems)}
        named = {name: places[stem] for name, stem in stems.items() if stem in places}
        fields = number_fields(stems, decimals=True)
        if named and self.first_number is None:
            if len(named) == len(stems) or not fields or not self.numbers_in_names:
                return named, ""
            shifted = self._match_shifted(self.numbers_in_names, fields[0].values())
            if shifted is not None and len(fields[0]) == len(stems):
                start = min(self.numbers_in_names)
                remark = f"numbered from {min(shifted):.0f}, the images from {start:.0f}"
                return {name: shifted[number] for name, number in fields[0].items()}, remark
            return named, self.remark_on_start(fields[0].values(), self.numbers_in_names)
        matches = [(field, *self.match_numbers(field.values())) for field in fields]
        # Numbers from 0 need no hypothesis, so they come first.
        for field, numbers, remark in sorted(matches, key=lambda match: bool(match[2])):
            if numbers is not None:
                found = {name: numbers[n] for name, n in field.items() if n in numbers}
                return found, remark
        last = {name: int(value) for name, value in fields[0].items()} if fields else {}
        return last, self.remark_on_start(last.values())

    def match_keys(
        self, names: Iterable[str], ids: Collection[int]
    ) -> tuple[dict[str, int], dict[float, int], str]:
        """Image numbers of the names and of the ids in one file, and a remark on their numbering.

        Names take precedence. If the ids match more images, the mapping of names is empty.
        """
        by_name, remark = self.recognise_names(names)
        matched, remark_on_ids = self.match_numbers(ids)
        unmatched: dict[float, int] = {n: n for n in ids}
        by_id = unmatched if matched is None else matched
        known_ids = self.recorded.intersection(by_id.values())
        known_names = self.recorded.intersection(by_name.values())
        if (len(known_ids), bool(remark)) > (len(known_names), bool(remark_on_ids)):
            by_name = {}  # the numbers in the names do not number the images
        return by_name, by_id, remark if by_name else remark_on_ids or self.remark_on_start(ids)

    def match_numbers(self, numbers: Collection[float]) -> tuple[dict[float, int] | None, str]:
        """Image number of each number of the detections, and a remark on how they count.

        None in place of the image numbers if the numbers fit no image or some of them do not.
        Hypotheses in order: the stated first number; image numbers from 0; the numbers in the names
        of the images, if no number is beyond them; from 1, if the numbers begin at 1 and end beyond
        the last image; from any number, or times, if there is one for each image.
        """
        first, given = min(self.recorded, default=0), sorted(set(numbers))
        if not given or not self.recorded:
            return None, ""
        if self.first_number is not None:
            return {n: int(n) - self.first_number + first for n in given}, ""
        named = self.numbers_in_names
        in_range = bool(named) and min(named) <= given[0] and given[-1] <= max(named)
        if self.recorded.issuperset(given):
            remark = self.remark_on_start(given)
            differs = in_range and any(named.get(n) != n for n in given)
            if differs and not remark and len(given) < len(self.recorded):
                remark = (
                    "read as positions from 0, but may be the numbers in the images' names: set "
                    "detections.keypoint_first_number or candidate_first_number, or write file_name"
                )
            return {n: int(n) for n in given}, remark
        in_names = {n: named[n] for n in given if n in named}
        if in_range and len(in_names) >= len(self.recorded.intersection(given)):
            return in_names, "numbered as in the names of the images"
        if first != 0 or len(self.recorded) <= max(self.recorded):
            return None, ""  # the images have numbers of their own
        share = len(given) / len(self.recorded)
        begins_at_1 = given[0] == 1 and self.recorded.issuperset(n - 1 for n in given)
        if share >= MIN_SHARE_SHIFTED and begins_at_1:
            return {n: int(n) - 1 for n in given}, "numbered from 1"
        images = sorted(self.recorded)
        positions: dict[float, int] = {n: n for n in images}
        for numbers_of_images in (positions, named):
            shifted = self._match_shifted(numbers_of_images, given)
            if shifted is not None:
                return shifted, f"numbered from {given[0]:.0f}"
        if len(given) == len(images) and self._are_times(np.array(given), np.array(images)):
            return dict(zip(given, images, strict=True)), "named by time"
        return None, ""

    @cached_property
    def numbers_in_names(self) -> dict[float, int]:
        """Place of each image by the number in its file's name; {} without such numbers."""
        try:
            numbering = recognise_numbering([Path(f"{stem}.x") for stem in self.stems], Path())
        except UserError:
            return {}
        keys = numbering.keys if numbering.kind == "number" else []
        return {number: place for place, number in enumerate(keys)}

    def _match_shifted(
        self, images: Mapping[float, int], numbers: Collection[float]
    ) -> dict[float, int] | None:
        """Image number of each number, if all numbers differ from the images' by one constant.

        None if they do not, or if there is no number for each image. ``images``: image number by
        the number with which the images count.
        """
        given, places = sorted(numbers), sorted(images)
        if not given or len(given) != len(places):
            return None
        shift = given[0] - places[0]
        if any(n - shift != place for n, place in zip(given, places, strict=True)):
            return None
        return {n: images[n - shift] for n in given}

    def _are_times(self, given: np.ndarray, images: np.ndarray) -> bool:
        """Whether numbers (N,) are the times of the images (N,) in any unit, from any start."""
        in_sets = self.number >= 0
        known = dict(
            zip(self.number[in_sets].tolist(), self.time_us[in_sets].tolist(), strict=True)
        )
        times = np.array([known.get(int(image), -1) for image in images], float)
        for clock in (images.astype(float), times):
            if len(given) < 3 or not (clock >= 0).all() or not (np.diff(clock) > 0).all():
                continue
            unit, start = np.polynomial.polynomial.polyfit(clock, given, 1)[::-1]
            error = np.abs(given - start - unit * clock).max()
            if unit > 0 and error <= MAX_TIME_ERROR * unit * np.median(np.diff(clock)):
                return True
        return False

    def remark_on_start(
        self, numbers: Iterable[float], images: Collection[float] | None = None
    ) -> str:
        """Warning if the numbers may be shifted against those of the images, "" otherwise.

        They may be if both their ends lie beyond those of the images in one direction, or if all
        images from the second on have a number and the first has none. ``images``: numbers of the
        images; None = positions.
        """
        given, known = set(numbers), images or self.recorded or {0}
        if not given:
            return ""
        before, after = min(given) - min(known), max(given) - max(known)
        is_dense = len(given) >= max(0.9 * (max(given) - min(given) + 1), 2)
        if before * after <= 0 and not (before == 1 and is_dense):
            return ""
        return (
            f"read as numbered from {min(known):.0f}, but begin at {min(given):.0f}: "
            "set detections.keypoint_first_number or candidate_first_number if this is the first "
            "image"
        )


def strip_suffix(name: str) -> str:
    """A file's name without folders (of any system) and without the suffix of an image."""
    return _SUFFIX.sub("", PurePosixPath(name.replace("\\", "/")).name)


def find_repeated_number(names: Iterable[str]) -> list[str]:
    """Names that end in the same number; [] if there are no two such names."""
    by_number: dict[int, list[str]] = {}
    for name in names:
        numbers = _NUMBERS.findall(strip_suffix(name))
        if numbers:
            by_number.setdefault(int(numbers[-1]), []).append(name)
    return next((group for group in by_number.values() if len(group) > 1), [])


def camera_images(source: artefacts.Artefact, sequence: SequenceEntry) -> list[CameraImages]:
    """The images of every camera of an open frames artefact, in its order of cameras.

    Raises UserError if the files of a plain recording are no longer those of the artefact.
    """
    indices = np.where(source["dropped"][:, None], -1, source["colour_index"])
    plain = PlainLayout(sequence) if sequence.layout == "plain" else None
    images = []
    for c, name in enumerate(source.text("camera_names")):
        width, height = (int(n) for n in source["colour_size"][c])
        index = number = indices[:, c]
        times = np.full(len(index), -1, np.int64)
        stems: tuple[str, ...] = ()
        key = f"cameras/{name}/colour_offsets"
        every = np.arange(len(source[key]) - 1 if key in source else 0)
        if sequence.layout != "k4a" and (index >= 0).any():
            all_times = source[f"cameras/{name}/colour_time"]
            times = np.where(index >= 0, all_times[index], -1)
            if plain is not None:
                number, stems = _plain_numbers(plain, name, index, times)
                every = np.arange(len(stems)) if stems else every
            if sequence.layout == "intercap":
                number = np.where(index >= 0, numbers_from_times(times), -1)
                every = numbers_from_times(all_times)
        recorded = frozenset(every.tolist())
        images.append(CameraImages(name, (width, height), number, times, recorded, stems))
    return images


def _plain_numbers(
    layout: PlainLayout, name: str, index: np.ndarray, times_us: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Positions (T,) among all image files of a camera, -1 = no image, and the files' stems.

    ``index`` counts only the images that could be copied: a damaged file would otherwise move the
    keypoints of all later images. For a video, the position is ``index``.
    """
    with layout.open(name) as recording:
        files = recording.colour_files if isinstance(recording, FilesRecording) else []
    if not files:  # a video
        return index, ()
    places = {time_us: place for place, (time_us, _) in reversed(list(enumerate(files)))}
    used_times = times_us[index >= 0].tolist()
    missing = [time_us for time_us in used_times if time_us not in places]
    if missing:
        raise UserError(
            f"sequence {layout.sequence.sequence!r}: none of the {len(files)} images of camera "
            f"{name} in {recording.source} was taken at {missing[0] / 1e6:.6f} s as the frames "
            "artefact states; images, timestamps or calibration have changed, so run the frames "
            "stage again"
        )
    number = np.full(len(index), -1)
    number[index >= 0] = [places[time_us] for time_us in used_times]
    return number, tuple(path.stem for _, path in files)


def find_json_files(folder: Path) -> list[Path]:
    """The JSON files in a folder; [] without the folder."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return sorted(p for p in paths if p.suffix.lower() == ".json" and not p.name.startswith("."))


def refuse_both(whole: Path | None, files: Collection[Path]) -> None:
    """Raise UserError if a camera has a file of all images and also files of single images."""
    first = next(iter(sorted(files)), None)
    if whole is not None and first is not None and first.parent.parent == whole.parent:
        raise UserError(
            f"{whole}: holds detections of all images, and so do the {len(files)} files in "
            f"{first.parent} (first: {first.name}); remove or move the outdated ones"
        )


def sort_by_image(
    file: DetectionFile[Result], images: CameraImages
) -> tuple[dict[int, list[Result]], list[str], str]:
    """Sort a file's results by image number.

    Returns the results by number, the names of images that were not recorded, and a remark on how
    the images are numbered, "" = from 0. An empty list means that the detector processed the image
    and found nothing. Images without a list are unknown:

    - images with a faulty entry and no other result;
    - images that are missing in the file's list of images;
    - all images, if the file has no such list and none of its entries can be used.
    """
    keys = [*(key for key, _ in file.results), *file.faulty, *(file.images or ())]
    by_name, by_id, remark = images.match_keys(
        (key.name for key in keys if key.name is not None),
        {key.number for key in keys if key.number is not None},
    )

    def number(key: ImageKey) -> int | None:
        if key.name is not None and (by_name or key.number is None):
            return by_name.get(key.name)
        return None if key.number is None else by_id.get(key.number)

    if file.images is not None:
        known = {n for n in map(number, file.images) if n is not None}
    else:
        known = set() if file.is_useless else set(images.recorded)
    known -= {n for n in map(number, file.faulty) if n is not None}
    by_image: dict[int, list[Result]] = {n: [] for n in sorted(known & images.recorded)}
    absent = []
    for key, result in file.results:
        place = number(key)
        if place is not None and place in images.recorded:
            by_image.setdefault(place, []).append(result)
        else:
            absent.append(key.name if key.name is not None else str(key.number))
    return by_image, absent, remark


def note_absent(notes: list[str], names: list[str], images: CameraImages, where: str) -> None:
    """Note results of images that were not recorded."""
    if not names:
        return
    has = f"images {min(images.recorded)} to {max(images.recorded)}" if images.recorded else "none"
    if images.stems:
        has += printable(f", {images.stems[0]} to {images.stems[-1]}")
    notes.append(
        f"{len(names)} results in {where} are of images that the recording does not have (first: "
        f"{printable(names[0][:80])}; it has {has})"
    )


def note_faults(notes: list[str], what: str, faults: list[str]) -> None:
    """Note entries that were left out, the first ones with their reasons."""
    if faults:
        notes.append(f"{len(faults)} {what} left out: {'; '.join(faults[:FILES_NAMED])}")


def preview_names(
    preview: DetectionPreview, folder: Path, names: Iterable[str], images: CameraImages
) -> None:
    """Add the numbering of files of single images to a preview; doubts about it are notes."""
    names = list(names)
    numbers, remark = images.recognise_names(names)
    if remark:
        doubtful = DOUBT in remark
        text = f"{folder}: files are {remark}" if doubtful else f"files {remark}"
        (preview.notes if doubtful else preview.recognised).append(text)
    if images.stems:
        absent = [name for name in names if numbers.get(name) not in images.recorded]
        note_unmatched(preview.notes, f"files in {folder}", absent)


def note_unmatched(notes: list[str], what: str, names: list[str]) -> None:
    """Note files that belong to no image of the camera."""
    if names:
        first = printable(names[0][:80])
        notes.append(f"{len(names)} {what} belong to no image (first: {first})")


def short_name(path: Path) -> str:
    """The file's name with that of its folder, which names the camera or BEHAVE's frame."""
    return printable(f"{path.parent.name}/{path.name}")


def note_broken(notes: list[str], what: str, broken: list[str]) -> None:
    """Note files that cannot be read, the first ones by name."""
    if broken:
        more = f" and {len(broken) - FILES_NAMED} more" if len(broken) > FILES_NAMED else ""
        notes.append(f"{what} not readable: {', '.join(broken[:FILES_NAMED])}{more}")
