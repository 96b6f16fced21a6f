"""JSON and TOML that a user supplies: of bounded depth, every key once, whole numbers of 64 bits.

A larger one becomes a floating-point number, infinity for hundreds of digits, so that whoever wants
a finite or a whole number finds none, and says where.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from intercap_core.inputs.files import MAX_CALIBRATION_BYTES, Unreadable, decoded, read_bytes
from intercap_core.inputs.structure import check_structure

MAX_DIGITS = 1000
LARGEST = (1 << 64) - 1
SMALLEST = -(1 << 63)
_LONG = b"0" * 19  # as few digits as a number beyond 64 bits may have
_ANY_DIGIT = bytes.maketrans(b"123456789", b"000000000")


def parse_json(text: str, entry: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """Parse JSON; ``entry`` makes another value of each object.

    Raises ValueError, in words that fit after a file's name: no JSON, nested too deeply, a key that
    an object has twice.
    """

    try:
        value = decoder(text, entry).decode(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    check_structure(value)
    return value


def decoder(text: str, entry: Callable[[dict[str, Any]], Any] | None = None) -> json.JSONDecoder:
    """What :func:`parse_json` parses ``text`` with, but for the depth."""

    def made(pairs: list[tuple[str, Any]]) -> Any:
        found = dict(pairs)
        if len(found) != len(pairs):
            raise ValueError(f"the key {_twice(pairs)!r:.60} is given twice")
        return found if entry is None else entry(found)

    # A check of every number takes its time: is there any that may be beyond 64 bits?
    long = _LONG in text.encode("utf-8", "surrogatepass").translate(_ANY_DIGIT)
    return json.JSONDecoder(object_pairs_hook=made, parse_int=bounded if long else None)


def whole(text: str) -> int:
    """A whole number of 64 bits; raises ValueError for anything else."""
    number = bounded(text)
    if not isinstance(number, int):
        raise ValueError(f"{text[:20]!r} is beyond 64 bits")
    return number


def bounded(text: str) -> int | float:
    """A whole number as it is within 64 bits, else as a floating-point number."""
    if len(text) > MAX_DIGITS:
        raise ValueError(f"it holds a number of {len(text)} digits")
    number = int(text) if len(text) <= 40 else None
    return number if number is not None and SMALLEST <= number <= LARGEST else float(text)


def read_json(
    path: Path,
    limit: int = MAX_CALIBRATION_BYTES,
    *,
    advice: str = "correct it",
    entry: Callable[[dict[str, Any]], Any] | None = None,
) -> Any:
    """Parse a JSON file of at most ``limit`` bytes; raises Unreadable where it is none."""
    content = read_bytes(path, limit)
    try:
        return parse_json(content.decode("utf-8-sig"), entry)
    except ValueError as error:
        raise Unreadable(path, f"is not valid JSON ({error})", advice) from None


def read_object(path: Path, limit: int = MAX_CALIBRATION_BYTES) -> dict[str, Any]:
    """Parse a JSON file of names and values; raises Unreadable where it is none."""
    content = read_json(path, limit)
    if not isinstance(content, dict):
        found = type(content).__name__
        raise Unreadable(path, f"expected names and values, found {found}", "correct it")
    return content


def read_toml(path: Path, limit: int = MAX_CALIBRATION_BYTES) -> dict[str, Any]:
    """Parse a TOML file of at most ``limit`` bytes; raises Unreadable where it is none."""
    text = decoded(path, read_bytes(path, limit))
    try:
        content = tomllib.loads(text)
        check_structure(content)
    except RecursionError:
        raise Unreadable(path, "is not valid TOML (nested too deeply)", "correct it") from None
    except ValueError as error:
        raise Unreadable(path, f"is not valid TOML ({error})", "correct it") from None
    return _bounded(content)


def _bounded(content: Any) -> Any:
    """Parsed values of bounded depth with whole numbers of 64 bits."""
    if isinstance(content, dict):
        return {key: _bounded(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_bounded(value) for value in content]
    if type(content) is int and not SMALLEST <= content <= LARGEST:
        far = math.inf if content > 0 else -math.inf
        return far if content.bit_length() > 1000 else float(content)
    return content


def _twice(pairs: list[tuple[str, Any]]) -> str:
    seen: set[str] = set()
    return next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
