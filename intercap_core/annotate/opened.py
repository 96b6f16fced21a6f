"""Open artefacts of a sequence, and its images as small JPEGs."""

from __future__ import annotations

import contextlib
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, TypeVar

import cv2

from intercap_core import artefacts
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.project import Project
from intercap_core.schemas import SCENE
from intercap_core.stage_list import SEQUENCE_STAGES

T = TypeVar("T")
NO_FILE = "0"  # stamp of a missing file


class Opened:
    """Open artefacts of one sequence, with a cache of results that are valid until a file changes.

    Set t contains the images that the cameras recorded at the same device time. Frame t is what
    happened at the time of set t. A delayed camera shows frame t in the image of a later set
    (``image_of`` of the scene artefact).

    Thread-safe. Hold ``lock`` to keep the images open.

    Args:
        paths: artefacts by stage, by default those of the project.
    """

    def __init__(self, project: Project, name: str, paths: dict[str, Path] | None = None) -> None:
        self.project, self.name = project, name
        self.paths = paths or {s: project.artefact(name, s) for s in SEQUENCE_STAGES}
        self.lock = threading.RLock()
        self._cache: dict[str, tuple[tuple[str, ...], Any]] = {}
        self._making: defaultdict[str, threading.RLock] = defaultdict(threading.RLock)
        self._stack = contextlib.ExitStack()
        self._images: tuple[str, tuple[Frames, Frames]] | None = None

    def stamp(self, *stages: str) -> str:
        """Return a text that changes if one of these artefacts, by default any, is replaced."""
        return "-".join(stamp_of(self.paths[stage]) for stage in stages or self.paths)

    def has(self, stage: str) -> bool:
        """Return whether the artefact of a stage exists."""
        return self.paths[stage].is_file()

    def cached(self, key: str, stages: tuple[str, ...], make: Callable[[], T]) -> T:
        """Return the result of ``make``; call it again if an artefact of ``stages`` changed.

        Concurrent callers share one call.
        """
        with self.lock:
            making = self._making[key]
        with making:
            stamps = tuple(stamp_of(self.paths[stage]) for stage in stages)
            known = self._cache.get(key)
            if known is None or known[0] != stamps:
                known = stamps, make()
                self._cache[key] = known
            return known[1]

    @contextlib.contextmanager
    def images(self, *, by_set: bool = False) -> Iterator[Frames]:
        """Open the images, indexed by the frame that they show, or by set without a scene artefact.

        Raises UserError if the artefact of frames cannot be read.

        Args:
            by_set: index the images by set, as recorded.
        """
        with self.lock:
            stamp = self.stamp("frames", "scene")
            if self._images is None or self._images[0] != stamp:
                self.close()
                sets = shown = self._stack.enter_context(Frames.open(self.paths["frames"]))
                with (
                    contextlib.suppress(artefacts.Unreadable),
                    artefacts.read(self.paths["scene"], SCENE) as scene,
                ):
                    shown = sets.showing(scene["image_of"])
                self._images = stamp, (shown, sets)
            yield self._images[1][by_set]

    def close(self) -> None:
        """Close the files."""
        with self.lock:
            self._images = None
            self._stack.close()


def object_of(project: Project, sequence: str) -> ObjectEntry:
    """Return a sequence's object; raises UserError if it names none."""
    entry = project.object_of(sequence)
    if entry is None:
        raise UserError(f"sequence {sequence!r} names no object")
    return entry


def stamp_of(path: Path) -> str:
    """Return a text that changes if a file is replaced."""
    try:
        status = path.stat()
    except OSError:
        return NO_FILE
    return f"{status.st_size:x}.{status.st_mtime_ns:x}.{status.st_ino:x}"


WIDTHS = (240, 320, 480, 640, 960, 1280)  # pixels; requests are rounded up to one of these


def read_jpeg(opened: Opened, camera: str, frame: int, width: int) -> bytes | None:
    """Return the image of a camera in a frame as JPEG, None if there is none.

    It is reduced to the next of ``WIDTHS`` if the recorded image is wider. Raises UserError if the
    image cannot be read. Browsers cache the images.
    """
    reduced = next((size for size in WIDTHS if size >= width), 0)
    with opened.images() as frames:
        names = frames.rig.names
        if camera not in names or not 0 <= frame < frames.num_sets:
            raise UserError(
                f"sequence {opened.name!r} has no image of camera {camera!r}, frame {frame}"
            )
        c = names.index(camera)
        lens = frames.rig[c].colour
        if reduced == 0 or reduced >= lens.width:
            return frames.colour_jpeg(frame, c)
        factors: tuple[Literal[1, 2, 4], ...] = (4, 2, 1)  # by which the decoder can reduce
        factor = next(f for f in factors if lens.width >= f * reduced)
        image = frames.colour(frame, c, factor)
    if image is None:
        return None
    size = (reduced, round(lens.height * reduced / lens.width))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    quality = 78  # 20 kB for an image 480 pixels wide
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
