"""Open artefacts of a sequence, and its images as small JPEGs."""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, TypeVar

import cv2
import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.project import Project
from intercap_core.schemas import FRAMES, SCENE
from intercap_core.stage_list import SEQUENCE_STAGES

T = TypeVar("T")


class Opened:
    """Artefacts of one sequence, with a cache of results that is valid until the files change.

    It is thread-safe; ``lock`` keeps the images open while they are read.

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
        self._images: tuple[str, Frames, Frames, np.ndarray] | None = None

    def stamp(self, *stages: str) -> str:
        """Return a stamp that changes with these artefacts, by default with any."""
        return "-".join(_stamp(self.paths[stage]) for stage in stages or self.paths)

    def has(self, stage: str) -> bool:
        """Return whether the artefact of a stage exists."""
        return self.paths[stage].is_file()

    def cached(self, key: str, stages: tuple[str, ...], make: Callable[[], T]) -> T:
        """Return the result of ``make``, called again if an artefact of ``stages`` changed.

        Concurrent callers wait for one call.
        """
        with self.lock:
            making = self._making[key]
        with making:
            stamps = tuple(_stamp(self.paths[stage]) for stage in stages)
            known = self._cache.get(key)
            if known is None or known[0] != stamps:
                known = stamps, make()
                self._cache[key] = known
            return known[1]

    @contextlib.contextmanager
    def images(self) -> Iterator[Frames]:
        """Open the images by the frame that they show; by set if there is no scene artefact.

        Raises UserError if the frames cannot be read.
        """
        with self.lock:
            yield self._opened()[1]

    @contextlib.contextmanager
    def sets(self) -> Iterator[Frames]:
        """Open the images by set, as recorded."""
        with self.lock:
            yield self._opened()[0]

    def dropped(self) -> np.ndarray:
        """Return which sets (T,) were dropped by annotation when the frames were read."""
        with self.lock:
            return self._opened()[2]

    def _opened(self) -> tuple[Frames, Frames, np.ndarray]:
        stamp = self.stamp("frames", "scene")
        if self._images is None or self._images[0] != stamp:
            self.close()
            file = self._stack.enter_context(artefacts.read(self.paths["frames"], FRAMES))
            sets = shown = Frames(file)
            with (
                contextlib.suppress(artefacts.Unreadable),
                artefacts.read(self.paths["scene"], SCENE) as scene,
            ):
                shown = sets.showing(scene["image_of"])
            self._images = stamp, sets, shown, file["dropped"]
        return self._images[1:]

    def close(self) -> None:
        """Close the files."""
        with self.lock:
            self._images = None
            self._stack.close()


def _stamp(path: Path) -> str:
    try:
        found = path.stat()
    except OSError:
        return "0"
    return f"{found.st_size:x}.{found.st_mtime_ns:x}.{found.st_ino:x}"


WIDTHS = (240, 320, 480, 640, 960, 1280)  # pixels; requests are rounded up to one of these
KEPT_BYTES = 192 << 20
_QUALITY = 78  # of JPEG: 20 kB for an image 480 pixels wide


class Pictures:
    """Reduced images with a cache of the last used."""

    def __init__(self, kept_bytes: int = KEPT_BYTES) -> None:
        self._kept: OrderedDict[tuple[str, str, int, int, int], bytes] = OrderedDict()
        self._bytes, self._most = 0, kept_bytes
        self._lock = threading.Lock()

    def jpeg(self, opened: Opened, camera: str, moment: int, width: int) -> bytes | None:
        """Return the image of a camera at a frame, at least ``width`` pixels wide if recorded so.

        None if there is no image. Raises UserError if it cannot be read.
        """
        wide = next((size for size in WIDTHS if size >= width), 0)
        with opened.images() as frames:
            names = frames.rig.names
            if camera not in names or not 0 <= moment < frames.num_sets:
                raise UserError(
                    f"sequence {opened.name!r} has no image of camera {camera!r}, frame {moment}"
                )
            c = names.index(camera)
            key = (opened.name, opened.stamp("frames", "scene"), moment, c, wide)
            with self._lock:
                if key in self._kept:
                    self._kept.move_to_end(key)
                    return self._kept[key]
            lens = frames.rig[c].colour
            if wide == 0 or wide >= lens.width:
                data = frames.colour_jpeg(moment, c)
            else:
                data = None
                image = frames.colour(moment, c, _reduction(lens.width, wide))
                if image is not None:
                    size = (wide, round(lens.height * wide / lens.width))
                    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
                    options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
                    data = cv2.imencode(".jpg", small, options)[1].tobytes()
        if data is not None:
            self._keep(key, data)
        return data

    def _keep(self, key: tuple[str, str, int, int, int], data: bytes) -> None:
        with self._lock:
            if key not in self._kept:
                self._kept[key] = data
                self._bytes += len(data)
            while self._bytes > self._most and len(self._kept) > 1:
                self._bytes -= len(self._kept.popitem(last=False)[1])


def _reduction(recorded: int, wide: int) -> Literal[1, 2, 4]:
    """Return by which factor the decoder may reduce an image."""
    if recorded >= 4 * wide:
        return 4
    return 2 if recorded >= 2 * wide else 1
