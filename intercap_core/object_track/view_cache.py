"""Frame sets as tracking uses them, kept while memory allows: each pass looks at all of them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock

from intercap_core.object_track.constants import VIEW_CACHE_BYTES
from intercap_core.object_track.view import View


class ViewCache:
    """Calls ``load(t)`` for the views of frame t once, and again only after they were evicted."""

    def __init__(
        self, load: Callable[[int], list[View]], max_bytes: int = VIEW_CACHE_BYTES
    ) -> None:
        self._load = load
        self._max_bytes = max_bytes
        self._kept: OrderedDict[int, list[View]] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def __call__(self, t: int) -> list[View]:
        """The views of frame t, one a camera; one thread loads at a time."""
        with self._lock:
            return self._get(t)

    def kept(self, t: int) -> list[View] | None:
        """The views of frame t where they are kept; nothing is loaded, and none is forgotten."""
        with self._lock:
            return self._kept.get(t)

    def _get(self, t: int) -> list[View]:
        if t in self._kept:
            self._kept.move_to_end(t)
            return self._kept[t]
        views = self._load(t)
        self._kept[t] = views
        self._bytes += _size(views)
        while self._bytes > self._max_bytes and len(self._kept) > 1:
            _, oldest = self._kept.popitem(last=False)
            self._bytes -= _size(oldest)
        return views


def _size(views: list[View]) -> int:
    return sum(view.nbytes for view in views)
