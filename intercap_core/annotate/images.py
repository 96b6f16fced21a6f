"""Images of a sequence as small JPEGs, as large as the page shows them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Literal

import cv2

from intercap_core.annotate.opened import Opened
from intercap_core.errors import UserError

WIDTHS = (240, 320, 480, 640, 960, 1280)  # pixels; others are rounded up to one, or as recorded
KEPT_BYTES = 192 << 20
_QUALITY = 78  # of JPEG: 20 kB of an image 480 pixels wide


class Pictures:
    """Reduced images, the last ones kept in memory."""

    def __init__(self, kept_bytes: int = KEPT_BYTES) -> None:
        self._kept: OrderedDict[tuple[str, str, int, int, int], bytes] = OrderedDict()
        self._bytes, self._most = 0, kept_bytes
        self._lock = threading.Lock()

    def jpeg(self, opened: Opened, camera: str, moment: int, width: int) -> bytes | None:
        """The image of ``camera`` that shows a moment, at least ``width`` pixels wide where it is
        recorded so; None where there is none. Raises UserError where it cannot be read."""
        wide = next((one for one in WIDTHS if one >= width), 0)
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
    """How many pixels the decoder may join into one."""
    if recorded >= 4 * wide:
        return 4
    return 2 if recorded >= 2 * wide else 1
