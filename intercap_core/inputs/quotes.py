"""What was found, in messages: bounded in length and in the time to write it, printable."""

from __future__ import annotations

import reprlib
from typing import Any

_REPR = reprlib.Repr()
_REPR.maxlevel = 3
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = _REPR.maxset = _REPR.maxfrozenset = 6
_REPR.maxstring = _REPR.maxother = 80
_MAX_DIGITS = 80


def quoted(value: Any, most: int = 80) -> str:
    """A value as Python writes it, in at most about ``most`` characters, however large it is."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 64:
        return f"a whole number of {value.bit_length()} bits"
    if isinstance(value, dict):
        keys = ", ".join(printable(str(key)[:40]) for key in list(value)[:5])
        return f"an object with {keys}" if keys else "an empty object"
    text = printable(_REPR.repr(value))
    return text if len(text) <= most else f"{text[: most - 3]}..."


def printable(text: str) -> str:
    """Text that any file can hold: what is none (names that are no UTF-8) becomes ``?``."""
    return text.encode("utf-8", "replace").decode("utf-8", "replace")
