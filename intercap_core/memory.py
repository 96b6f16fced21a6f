"""Return freed memory to the system, which glibc's malloc would keep for the process.

Without effect for other C libraries.
"""

from __future__ import annotations

import ctypes
import os
from typing import Any

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_RETURNED_BYTES = 4 << 20  # size from which on freed memory goes back to the system


def return_large_arrays() -> None:
    """Make glibc return arrays of 4 MB and more as soon as they are freed.

    By default it keeps freed arrays of up to 32 MB for the process, together a fifth of the joint
    stage's peak at 1,000 frames.
    """
    _call("mallopt", _M_MMAP_THRESHOLD, _RETURNED_BYTES)
    _call("mallopt", _M_TRIM_THRESHOLD, _RETURNED_BYTES)


def return_freed_memory() -> None:
    """Return what is free between the arrays in use.

    Call it after a window of frames: smaller arrays leave gaps, which add up to 0.4 MB per frame of
    the joint fit.
    """
    _call("malloc_trim", 0)


def _call(name: str, *arguments: Any) -> None:
    function = getattr(ctypes.CDLL(None), name, None) if os.name == "posix" else None
    if function is not None:
        function(*arguments)
