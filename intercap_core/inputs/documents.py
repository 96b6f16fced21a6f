"""JSON, TOML and YAML that a user supplies: each key once, integers of at most 64 bits.

Larger integers become floating-point numbers (infinity beyond their range), so that a reader which
expects a finite number reports the place. YAML is read by the safe loader.
"""

from __future__ import annotations

import json
import math
import os
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from intercap_core.inputs.files import MAX_TEXT_BYTES, UnreadableFile, read_bytes, read_text

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
    *,
    advice: str = "correct it",
    entry: Callable[[dict[str, Any]], Any] | None = None,
) -> Any:
    """Parse a JSON file of at most ``MAX_TEXT_BYTES``; raises UnreadableFile."""
    content = read_bytes(path, MAX_TEXT_BYTES)
    try:
        return parse_json(content.decode("utf-8-sig"), entry)
    except ValueError as error:
        raise UnreadableFile(path, f"is not valid JSON ({error})", advice) from None


def read_object(path: Path) -> dict[str, Any]:
    """Parse a JSON file that holds an object; raises UnreadableFile."""
    content = read_json(path)
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise UnreadableFile(path, f"expected names and values, found {kind}", "correct it")
    return content


def read_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file of at most ``MAX_TEXT_BYTES``; raises UnreadableFile."""
    text = read_text(path)
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


# Scalars of YAML 1.2 (core schema, section 10.3.2) by their possible first characters. PyYAML
# reads those of YAML 1.1, in which 0010 is 8, 10:00 is 600 and "no" is false.
_SCALARS = (
    ("bool", "true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
    ("null", "~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("merge", "<<", "<"),
)
_KEYS_AS_TEXT = {f"{_TAG}{kind}" for kind, *_ in _SCALARS if kind != "merge"}


class _Written:
    """Number that keeps its text, such as 01 or 1e3, since it may be a name."""

    text: str

    def __new__(cls, text: str) -> Any:
        """Parse decimal digits."""
        number = super().__new__(cls, text)  # type: ignore[call-arg]
        number.text = text
        return number

    def __str__(self) -> str:
        return self.text


class WrittenInteger(_Written, int):
    """Integer of YAML."""


class WrittenFloat(_Written, float):
    """Finite floating-point number of YAML."""


class YamlLoader(yaml.SafeLoader):
    """The safe loader with the scalars of YAML 1.2. Scalars as keys are text.

    Repeated keys are refused.
    """

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 (as the base class has it)

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Any, Any]:
        """Convert scalars as keys to their text; refuse a key that a mapping has twice."""
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode):
                if key.tag in _KEYS_AS_TEXT:
                    key.tag = f"{_TAG}str"
                if (key.tag, key.value) in seen:
                    problem = f"{key.value[:60]!r} is given twice"
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                seen.add((key.tag, key.value))
        return super().construct_mapping(node, deep)  # type: ignore[arg-type]

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int | float:  # type: ignore[override]
        """Return an integer of 64 bits, else infinity."""
        text = node.value
        base = 0 if text[:2] in ("0o", "0x") else 10
        number = int(text, base) if len(text) <= 80 else MAX_INTEGER + 1
        if not MIN_INTEGER <= number <= MAX_INTEGER:
            return float("-inf" if text.startswith("-") else "inf")
        return WrittenInteger(text) if base and str(number) != text else number

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        """Return the number, which keeps its text if Python writes it otherwise."""
        number = super().construct_yaml_float(node)
        is_plain = str(number) == node.value or not math.isfinite(number)
        return number if is_plain else WrittenFloat(node.value)


for _kind, _pattern, _first in _SCALARS:
    YamlLoader.add_implicit_resolver(f"{_TAG}{_kind}", re.compile(f"(?:{_pattern})$"), _first)
YamlLoader.add_constructor(f"{_TAG}int", YamlLoader.construct_yaml_int)
YamlLoader.add_constructor(f"{_TAG}float", YamlLoader.construct_yaml_float)


def parse_yaml(text: str, loader: type[YamlLoader] = YamlLoader) -> Any:
    """Parse one YAML document; raises yaml.YAMLError or ValueError."""
    try:
        return yaml.load(text, Loader=loader)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except (TypeError, LookupError, AttributeError, ValueError) as error:
        raise ValueError(f"a value does not fit its tag: {error}") from None


class _YamlDumper(yaml.SafeDumper):
    """The safe dumper. Text that YAML 1.1 or 1.2 reads as another type is quoted."""


for _kind, _pattern, _first in _SCALARS[1:3]:
    _YamlDumper.add_implicit_resolver(f"{_TAG}{_kind}", re.compile(f"(?:{_pattern})$"), _first)
_YamlDumper.add_representer(WrittenInteger, lambda dumper, value: dumper.represent_int(int(value)))
_YamlDumper.add_representer(
    WrittenFloat, lambda dumper, value: dumper.represent_float(float(value))
)


def dump_yaml(content: Any, *, sort_keys: bool = False) -> str:
    """Serialize plain values as block-style YAML."""
    return str(yaml.dump(content, Dumper=_YamlDumper, sort_keys=sort_keys))


def yaml_fault(error: Exception) -> str:
    """Return the line and problem of an error of :func:`parse_yaml`, to follow a noun."""
    mark = getattr(error, "problem_mark", None)
    where = f" in line {mark.line + 1}" if mark else ""
    problem = getattr(error, "problem", None) or str(error).partition("\n")[0]
    return f"{where} ({problem[:200]})"


def read_yaml(
    path: Path,
    *,
    loader: type[YamlLoader] = YamlLoader,
    prepared: Callable[[str], str] | None = None,
) -> Any:
    """Parse a YAML file of at most ``MAX_TEXT_BYTES``; ``prepared`` changes its text first.

    Raises UnreadableFile if it is missing, too large or malformed.
    """
    if not os.path.lexists(path):
        raise UnreadableFile(path, "there is no such file")
    text = read_text(path)
    try:
        return parse_yaml(text if prepared is None else prepared(text), loader)
    except (yaml.YAMLError, ValueError) as error:
        raise UnreadableFile(path, f"not valid YAML{yaml_fault(error)}", "correct it") from None
