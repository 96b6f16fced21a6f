"""What detectors' files call the colour images that a frames artefact holds."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from intercap_core import artefacts
from intercap_core.config import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.image_files import FilesRecording
from intercap_core.formats.recordings.intercap import numbers_of
from intercap_core.formats.recordings.plain import PlainLayout

_SUFFIX = re.compile(r"\.(jpe?g|png|bmp|tiff?|webp|json)$", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"(?:.*\D)?(\d{1,9})")


@dataclass(frozen=True)
class CameraImages:
    """The colour images that the T frame sets hold of one camera.

    ``number`` (T,) is what files of keypoints and candidates call the image, -1 = no image;
    ``time_us`` (T,) its device time. ``recorded`` are the numbers of all its images, also of those
    in no set. ``stems`` are the names of its image files without suffix, in the order that
    ``number`` counts, where files may be named after them.
    """

    name: str
    size: tuple[int, int]
    number: np.ndarray
    time_us: np.ndarray
    recorded: frozenset[int] = frozenset()
    stems: tuple[str, ...] = ()

    @property
    def sets(self) -> list[int]:
        """Frame sets with an image."""
        return np.flatnonzero(self.number >= 0).tolist()

    def numbers_of_names(self, names: Iterable[str]) -> dict[str, int]:
        """The images that file names mean, as far as they mean any.

        Where any is named after an image file, that counts. Else the number at a name's end does
        (``frame_0012.jpg`` is image 12), as long as no two names end in the same.
        """
        stems = {name: stem_of(name) for name in sorted(set(names))}
        places = {stem: place for place, stem in enumerate(self.stems)}
        named = {name: places[stem] for name, stem in stems.items() if stem in places}
        if named:
            return named
        matches = {name: _LAST_NUMBER.fullmatch(stem) for name, stem in stems.items()}
        numbers = {name: int(match.group(1)) for name, match in matches.items() if match}
        return numbers if len(set(numbers.values())) == len(numbers) else {}


def stem_of(name: str) -> str:
    """A file's name without folders (of either system) and without an image's suffix."""
    return _SUFFIX.sub("", PurePosixPath(name.replace("\\", "/")).name)


def camera_images(source: artefacts.Artefact, sequence: SequenceEntry) -> list[CameraImages]:
    """The images of every camera of an open frames artefact, in its order of cameras.

    Raises UserError where a plain recording's files no longer are those of the artefact.
    """
    indices = np.where(source["dropped"][:, None], -1, source["colour_index"])
    plain = PlainLayout(sequence) if sequence.layout == "plain" else None
    images = []
    for c, name in enumerate(source.text("camera_names")):
        width, height = (int(n) for n in source["colour_size"][c])
        index = number = indices[:, c]
        times = np.full(len(index), -1, np.int64)
        stems: tuple[str, ...] = ()
        every = np.arange(_count(source, name, index))
        if sequence.layout != "k4a" and (index >= 0).any():
            all_times = source[f"cameras/{name}/colour_time"]
            times = np.where(index >= 0, all_times[index], -1)
            if plain is not None:
                number, stems = _plain_numbers(plain, name, index, times)
                every = np.arange(len(stems)) if stems else every
            if sequence.layout == "intercap":
                number = np.where(index >= 0, numbers_of(times), -1)
                every = numbers_of(all_times)
        recorded = frozenset(every.tolist())
        images.append(CameraImages(name, (width, height), number, times, recorded, stems))
    return images


def _count(source: artefacts.Artefact, name: str, index: np.ndarray) -> int:
    """How many colour images of a camera the artefact holds."""
    key = f"cameras/{name}/colour_offsets"
    if key in source:
        return len(source[key]) - 1
    return int(index.max(initial=-1)) + 1


def _plain_numbers(
    layout: PlainLayout, name: str, index: np.ndarray, times_us: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Places (T,) among all image files of a camera, -1 = no image, and the files' stems.

    ``index`` counts only the images that could be copied, so that a damaged file would move all
    keypoints after it to another image. Of a video it is the place.
    """
    with layout.open(name) as recording:
        if not isinstance(recording, FilesRecording):
            return index, ()
        files = recording.colour_files
    places = {time_us: place for place, (time_us, _) in reversed(list(enumerate(files)))}
    held = times_us[index >= 0].tolist()
    lost = [time_us for time_us in held if time_us not in places]
    if lost:
        raise UserError(
            f"sequence {layout.sequence.sequence!r}: none of the {len(files)} images of camera "
            f"{name} in {recording.source} was taken at {lost[0] / 1e6:.6f} s as the frames "
            "artefact says; images, timestamps or calibration have changed, so run the frames "
            "stage again"
        )
    number = np.full(len(index), -1)
    number[index >= 0] = [places[time_us] for time_us in held]
    return number, tuple(path.stem for _, path in files)
