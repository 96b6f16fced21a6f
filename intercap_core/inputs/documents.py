"""JSON, TOML and YAML that a user supplies: each key once, integers of at most 64 bits.

Larger integers become floating-point numbers (infinity beyond their range), so that a reader which
expects a finite number reports the place. YAML is read by the safe loader.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from intercap_core.inputs.files import (
    MAX_CALIBRATION_BYTES,
    MAX_SETTINGS_BYTES,
    UnreadableFile,
    read_bytes,
    read_text,
)

MIN_INTEGER, MAX_INTEGER = -(1 << 63), (1 << 64) - 1
_LONG_INTEGER = b"0" * 19  # the fewest digits of an integer beyond 64 bits
_ANY_DIGIT = bytes.maketrans(b"123456789", b"000000000")
_TAG = "tag:yaml.org,2002:"


def parse_json(text: str, entry: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """Parse JSON; ``entry`` converts each object.

    Raises ValueError, whose message fits after a file's name, for invalid JSON and repeated keys.
    """
    try:
        return json_decoder(text, entry).decode(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def json_decoder(
    text: str, entry: Callable[[dict[str, Any]], Any] | None = None
) -> json.JSONDecoder:
    """Return the decoder that :func:`parse_json` uses for ``text``."""

    def make_object(pairs: list[tuple[str, Any]]) -> Any:
        content = dict(pairs)
        if len(content) != len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"the key {twice!r:.60} is given twice")
        return content if entry is None else entry(content)

    # A call for each integer takes its time, so look for long ones first.
    long = _LONG_INTEGER in text.encode("utf-8", "surrogatepass").translate(_ANY_DIGIT)
    return json.JSONDecoder(object_pairs_hook=make_object, parse_int=_bounded if long else None)


def parse_integer(text: str) -> int:
    """Parse an integer of 64 bits; raises ValueError for other text."""
    number = _bounded(text)
    if not isinstance(number, int):
        raise ValueError(f"{text[:20]!r} is beyond 64 bits")
    return number


def _bounded(text: str) -> int | float:
    """Parse an integer; one that exceeds 64 bits becomes a floating-point number."""
    number = int(text) if len(text) <= 40 else None
    return number if number is not None and MIN_INTEGER <= number <= MAX_INTEGER else float(text)


def read_json(
    path: Path,
    limit: int = MAX_CALIBRATION_BYTES,
    *,
    advice: str = "correct it",
    entry: Callable[[dict[str, Any]], Any] | None = None,
) -> Any:
    """Parse a JSON file of at most ``limit`` bytes; raises UnreadableFile."""
    content = read_bytes(path, limit)
    try:
        return parse_json(content.decode("utf-8-sig"), entry)
    except ValueError as error:
        raise UnreadableFile(path, f"is not valid JSON ({error})", advice) from None


def read_object(path: Path, limit: int = MAX_CALIBRATION_BYTES) -> dict[str, Any]:
    """Parse a JSON file that holds an object; raises UnreadableFile."""
    content = read_json(path, limit)
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise UnreadableFile(path, f"expected names and values, found {kind}", "correct it")
    return content


def read_toml(path: Path, limit: int = MAX_CALIBRATION_BYTES) -> dict[str, Any]:
    """Parse a TOML file of at most ``limit`` bytes; raises UnreadableFile."""
    text = read_text(path, limit)
    try:
        return {key: _bounded_values(value) for key, value in tomllib.loads(text).items()}
    except RecursionError:
        raise UnreadableFile(path, "is not valid TOML (nested too deeply)", "correct it") from None
    except ValueError as error:
        raise UnreadableFile(path, f"is not valid TOML ({error})", "correct it") from None


def _bounded_values(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _bounded_values(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_bounded_values(value) for value in content]
    return _bounded(str(content)) if type(content) is int else content


def _without_base_60(tag: str, pattern: re.Pattern[str]) -> re.Pattern[str]:
    """Return a YAML scalar's ``pattern`` that does not match numbers with colons."""
    numbers = (f"{_TAG}int", f"{_TAG}float")
    return re.compile(f"(?![^:]*:)(?:{pattern.pattern})", re.X) if tag in numbers else pattern


class YamlLoader(yaml.SafeLoader):
    """The safe loader, which refuses repeated keys and reads 10:00:12:13 as text.

    In YAML 1.1 the latter is a number to the base of 60; a user means a time code.
    """

    yaml_implicit_resolvers = {  # noqa: RUF012 (as the base class has it)
        first: [(tag, _without_base_60(tag, pattern)) for tag, pattern in resolvers]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Any, Any]:
        """Refuse a key that a mapping has twice."""
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in seen:
                problem = f"{key.value[:60]!r} is given twice"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add((key.tag, str(key.value)))
        return super().construct_mapping(node, deep)  # type: ignore[arg-type]

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int | float:  # type: ignore[override]
        """Return an integer of 64 bits, else infinity."""
        number = super().construct_yaml_int(node) if len(node.value) <= 80 else None
        if number is not None and MIN_INTEGER <= number <= MAX_INTEGER:
            return number
        return float("-inf" if node.value.startswith("-") else "inf")


YamlLoader.add_constructor(f"{_TAG}int", YamlLoader.construct_yaml_int)


def parse_yaml(text: str, loader: type[YamlLoader] = YamlLoader) -> Any:
    """Parse one YAML document; raises yaml.YAMLError or ValueError."""
    try:
        return yaml.load(text, Loader=loader)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except (TypeError, LookupError, AttributeError, OverflowError) as error:
        raise ValueError(f"a value does not fit its tag: {error}") from None


def yaml_fault(error: Exception) -> str:
    """Return the line and problem of an error of :func:`parse_yaml`, to follow a noun."""
    mark = getattr(error, "problem_mark", None)
    where = f" in line {mark.line + 1}" if mark else ""
    problem = getattr(error, "problem", None) or str(error).partition("\n")[0]
    return f"{where} ({problem[:200]})"


def read_yaml(
    path: Path,
    limit: int = MAX_SETTINGS_BYTES,
    *,
    loader: type[YamlLoader] = YamlLoader,
    prepared: Callable[[str], str] | None = None,
) -> Any:
    """Parse a YAML file of at most ``limit`` bytes; ``prepared`` changes its text first.

    Raises UnreadableFile if it is missing, too large or malformed.
    """
    if not os.path.lexists(path):
        raise UnreadableFile(path, "there is no such file")
    text = read_text(path, limit)
    try:
        return parse_yaml(text if prepared is None else prepared(text), loader)
    except (yaml.YAMLError, ValueError) as error:
        raise UnreadableFile(path, f"not valid YAML{yaml_fault(error)}", "correct it") from None
