"""Reader of the frames artefact: images of every camera by frame set or by moment.

A frame set holds the images that the recordings' clocks put at one time. The scene stage corrects
the clocks and chooses for each moment, and each camera, the frame set whose image shows it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig
from intercap_core.schemas import FRAMES

_DECODED = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
}


class Frames:
    """An open frames artefact. ``c`` is a camera of the rig, ``t`` a frame set (0 <= t < T).

    After :meth:`showing`, ``t`` is a moment.
    """

    def __init__(self, artefact: artefacts.Artefact, image_of: np.ndarray | None = None) -> None:
        self._artefact = artefact
        self._image_of = image_of
        self._offsets: dict[int, np.ndarray] = {}

    @classmethod
    @contextlib.contextmanager
    def open(cls, path: Path) -> Iterator[Frames]:
        """Open for a ``with`` block; raises UserError as :func:`artefacts.read` does."""
        with artefacts.read(path, FRAMES) as artefact:
            yield cls(artefact)

    def showing(self, image_of: np.ndarray) -> Frames:
        """Return the images indexed by moment instead of frame set.

        Raises UserError if ``image_of`` is of another recording.

        Args:
            image_of: (T, C) of the scene artefact: the frame set whose image of each camera shows
                each moment, -1 = none.
        """
        if image_of.shape != self._colour_index.shape:
            sets, cameras = self._colour_index.shape
            raise UserError(
                f"{self._artefact.path}: holds {sets} frame sets of {cameras} cameras, the scene "
                f"artefact {image_of.shape[0]} of {image_of.shape[1]}; re-run stage 'scene' for "
                f"sequence {self.sequence!r}"
            )
        return Frames(self._artefact, image_of)

    def at(self, rig: Rig) -> Frames:
        """Return the same images with other lenses or poses of the cameras."""
        frames = Frames(self._artefact, self._image_of)
        frames.rig = rig
        return frames

    @cached_property
    def rig(self) -> Rig:
        """Lenses and extrinsics of the calibration (unrefined)."""
        return Rig.from_artefact(self._artefact)

    @property
    def num_sets(self) -> int:
        """Number T of frame sets or moments."""
        return len(self.time_s)

    @property
    def fps(self) -> float:
        """Nominal sets a second."""
        return float(self._artefact.attributes["fps"])

    @property
    def sequence(self) -> str:
        """The sequence's name."""
        return str(self._artefact.attributes["sequence"])

    @property
    def master(self) -> str:
        """Name of the camera whose frame the extrinsics are in."""
        return str(self._artefact.attributes["master"])

    @cached_property
    def time_s(self) -> np.ndarray:
        """(T,) seconds since the first set."""
        return self._artefact["times"]

    @cached_property
    def present(self) -> np.ndarray:
        """(C,) bool: the camera has a recording and a pose."""
        return self._artefact["present"]

    @cached_property
    def _colour_index(self) -> np.ndarray:
        return self._by_moment(self._artefact["colour_index"], -1)

    @cached_property
    def _depth_index(self) -> np.ndarray:
        return self._by_moment(self._artefact["depth_index"], -1)

    def _by_moment(self, values: np.ndarray, none: float) -> np.ndarray:
        """Values (T, C) of frame sets, rearranged if ``t`` is a moment; ``none`` without image."""
        if self._image_of is None:
            return values
        shown = np.take_along_axis(values, np.maximum(self._image_of, 0), 0)
        return np.where(self._image_of < 0, values.dtype.type(none), shown)

    @property
    def colour_available(self) -> np.ndarray:
        """(T, C) bool: the set holds a colour image of this camera."""
        return self._colour_index >= 0

    @property
    def depth_available(self) -> np.ndarray:
        """(T, C) bool: the set holds a depth image of this camera."""
        return self._depth_index >= 0

    @property
    def available(self) -> np.ndarray:
        """(T, C) bool: the set holds any image of this camera; False for dropped sets."""
        return self.colour_available | self.depth_available

    @cached_property
    def skew_s(self) -> np.ndarray:
        """(T, C) float32: image's device time minus the set's time, seconds, NaN = none."""
        return self._by_moment(self._artefact["skew"], np.nan)

    @cached_property
    def first_set_s(self) -> float:
        """Time of the first set on the recordings' own clock, seconds; NaN without images."""
        for name, first_s in zip(self.rig.names, self.first_image_s.tolist(), strict=True):
            if np.isfinite(first_s):
                return float(self._artefact[f"cameras/{name}/colour_time"][0]) * 1e-6 - first_s
        return float("nan")

    @cached_property
    def first_image_s(self) -> np.ndarray:
        """(C,) time of each camera's first image by its own times, seconds since the first set.

        NaN = no image in any set.
        """
        result = np.full(len(self.present), np.nan)
        index, skew = self._artefact["colour_index"], self._artefact["skew"].astype(float)
        for c, name in enumerate(self.rig.names):
            seen = np.flatnonzero(index[:, c] >= 0)
            if len(seen):
                times = self._artefact[f"cameras/{name}/colour_time"]
                t = seen[0]
                since = (times[index[t, c]] - times[0]) * 1e-6
                result[c] = self.time_s[t] + skew[t, c] - since
        return result

    @property
    def sound_starts(self) -> dict[str, tuple[float, float]]:
        """Start of each camera and its standard deviation, seconds, as estimated from sound.

        A start is the time of the camera's first image on a common clock with an arbitrary zero.
        Keys are names of cameras; cameras that share no sound are left out.
        """
        if "sound_start" not in self._artefact:
            return {}
        pairs = zip(self._artefact["sound_start"], self._artefact["sound_start_sigma"], strict=True)
        starts = dict(zip(self.rig.names, pairs, strict=True))
        return {n: (float(s), float(d)) for n, (s, d) in starts.items() if np.isfinite(s)}

    @cached_property
    def gravity(self) -> np.ndarray:
        """(C, 3) direction down, unit, in each colour camera's frame; NaN = unknown."""
        return self._artefact["gravity"]

    @cached_property
    def stated_up(self) -> np.ndarray:
        """(3,) unit, direction up that the user states, master's frame; NaN = not stated."""
        return self._stated("stated_up")

    @cached_property
    def stated_floor(self) -> np.ndarray:
        """(3,) point of the floor that the user states, master's frame; NaN = not stated."""
        return self._stated("stated_floor")

    def _stated(self, key: str) -> np.ndarray:
        return self._artefact[key] if key in self._artefact else np.full(3, np.nan)

    def depth(self, t: int, c: int) -> np.ndarray | None:
        """The depth image (H, W) uint16, millimetres, 0 = invalid; None if there is none."""
        index = int(self._depth_index[t, c])
        if index < 0:
            return None
        return self._artefact.rows(f"cameras/{self.rig.names[c]}/depth", index)

    def colour_jpeg(self, t: int, c: int) -> bytes | None:
        """The JPEG (or PNG) file as recorded; None if there is none."""
        index = int(self._colour_index[t, c])
        if index < 0:
            return None
        group = f"cameras/{self.rig.names[c]}"
        if c not in self._offsets:
            self._offsets[c] = self._artefact[f"{group}/colour_offsets"]
        start, end = self._offsets[c][index : index + 2]
        return self._artefact.rows(f"{group}/colour", slice(int(start), int(end))).tobytes()

    def colour(self, t: int, c: int, reduction: Literal[1, 2, 4] = 1) -> np.ndarray | None:
        """The colour image (H, W, 3) uint8, BGR; None if there is none.

        With a ``reduction`` of n, each pixel is the mean of n by n pixels, which is faster. Raises
        UserError if the recorded image cannot be decoded.
        """
        jpeg = self.colour_jpeg(t, c)
        if jpeg is None:
            return None
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), _DECODED[reduction])
        lens = self.rig[c].colour
        size = (-(-lens.height // reduction), -(-lens.width // reduction), 3)
        if image is None or image.shape != size:
            raise UserError(
                f"{self._artefact.path}: sequence {self.sequence}, camera {self.rig.names[c]}, "
                f"frame {t}: the recorded image does not decode to {lens.width}x{lens.height}; add "
                f"{t} to drop_frames in the sequence's annotation"
            )
        return image
