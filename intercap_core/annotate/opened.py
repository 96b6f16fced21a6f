"""What is open of a sequence's artefacts, for as long as the files stay the same."""

from __future__ import annotations

import contextlib
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from intercap_core import artefacts
from intercap_core.formats.recordings.frames import Frames
from intercap_core.project import Project
from intercap_core.schemas import FRAMES, SCENE
from intercap_core.stage_list import SEQUENCE_STAGES

T = TypeVar("T")


class Opened:
    """One sequence's artefacts: images stay open, and what is made of files is kept until one of
    them is another. For several threads; ``lock`` keeps the images open while they are read.

    ``paths`` by stage.
    """

    def __init__(self, project: Project, name: str, paths: dict[str, Path] | None = None) -> None:
        self.project, self.name = project, name
        self.paths = paths or {s: project.artefact(name, s) for s in SEQUENCE_STAGES}
        self.lock = threading.RLock()
        self._made: dict[str, tuple[tuple[str, ...], Any]] = {}
        self._making: defaultdict[str, threading.RLock] = defaultdict(threading.RLock)
        self._stack = contextlib.ExitStack()
        self._images: tuple[str, Frames, Frames, np.ndarray] | None = None

    def stamp(self, *stages: str) -> str:
        """Tells these artefacts, all by default, from others at the same places."""
        return "-".join(_stamp(self.paths[stage]) for stage in stages or self.paths)

    def there(self, stage: str) -> bool:
        """Whether the stage has written."""
        return self.paths[stage].is_file()

    def made(self, key: str, stages: tuple[str, ...], make: Callable[[], T]) -> T:
        """What ``make`` returns, made anew where an artefact of these ``stages`` is another; once,
        however many ask for it meanwhile."""
        with self.lock:
            making = self._making[key]
        with making:
            stamps = tuple(_stamp(self.paths[stage]) for stage in stages)
            known = self._made.get(key)
            if known is None or known[0] != stamps:
                known = stamps, make()
                self._made[key] = known
            return known[1]

    @contextlib.contextmanager
    def images(self) -> Iterator[Frames]:
        """The images by the moment that they show, or by set as long as there is no scene.

        Raises UserError where the frames cannot be read.
        """
        with self.lock:
            yield self._opened()[1]

    @contextlib.contextmanager
    def sets(self) -> Iterator[Frames]:
        """The images by set, as they were recorded."""
        with self.lock:
            yield self._opened()[0]

    def dropped(self) -> np.ndarray:
        """(T,) bool: the sets that were dropped by annotation when the frames were read."""
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
        """Let the files go."""
        with self.lock:
            self._images = None
            self._stack.close()


def _stamp(path: Path) -> str:
    try:
        found = path.stat()
    except OSError:
        return "0"
    return f"{found.st_size:x}.{found.st_mtime_ns:x}.{found.st_ino:x}"
