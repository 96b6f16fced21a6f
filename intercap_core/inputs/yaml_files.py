"""YAML that a user supplies: the safe loader, with bounds on what aliases make of it.

An alias is no copy, so that a few lines name more values than memory holds ("a billion laughs"), or
a list that holds itself. The nodes are measured, aliases written out, before any value is made.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from intercap_core.inputs.files import MAX_SETTINGS_BYTES, Unreadable, read_text
from intercap_core.inputs.json_files import LARGEST, SMALLEST
from intercap_core.inputs.structure import MAX_DEPTH

MAX_NODES = 1_000_000  # with aliases written out; the longest settings file has a thousand
_TAG = "tag:yaml.org,2002:"
_NUMBERS = (f"{_TAG}int", f"{_TAG}float")
_SCALARS = ("null", "bool", "int", "float", "str", "timestamp")
KINDS = {  # what a standard tag may stand before
    **{f"{_TAG}{name}": yaml.ScalarNode for name in _SCALARS},
    f"{_TAG}seq": yaml.SequenceNode,
    f"{_TAG}map": yaml.MappingNode,
}


def _without_base_60(tag: str, pattern: re.Pattern[str]) -> re.Pattern[str]:
    """A scalar's ``pattern`` in YAML, without numbers that have colons."""
    return re.compile(f"(?![^:]*:)(?:{pattern.pattern})", re.X) if tag in _NUMBERS else pattern


class Loader(yaml.SafeLoader):
    """The safe loader, which refuses a key that a mapping has twice, and reads 10:00:12:13 as text:
    YAML 1.1 means a number to the base of 60, a user a time code."""

    yaml_implicit_resolvers = {  # noqa: RUF012 (as the base class has it)
        first: [(tag, _without_base_60(tag, pattern)) for tag, pattern in resolvers]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    kinds = KINDS

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Refuse a tag before what it cannot mean; the constructors fail in ways of their own."""
        kind = self.kinds.get(node.tag)
        if kind is None and node.tag in self.yaml_constructors and node.tag.startswith(_TAG):
            _refuse(node, f"the tag {node.tag.removeprefix(_TAG)} is not used here")
        if kind is not None and not isinstance(node, kind):
            _refuse(node, f"a {_name(node)} is no {node.tag.removeprefix(_TAG)}")
        if kind is yaml.ScalarNode and node.tag != f"{_TAG}str":
            told = self.yaml_implicit_resolvers.get(node.value[:1], [])
            if not any(tag == node.tag and form.match(node.value) for tag, form in told):
                _refuse(node, f"{node.value[:40]!r} is no {node.tag.removeprefix(_TAG)}")
        return super().construct_object(node, deep)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in seen:
                _refuse(key, f"{key.value[:60]!r} is given twice")
            seen.add((key.tag, str(key.value)))
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int | float:  # type: ignore[override]
        """A whole number of 64 bits, as in JSON."""
        number = super().construct_yaml_int(node) if len(node.value) <= 80 else None
        if number is not None and SMALLEST <= number <= LARGEST:
            return number
        return float("-inf" if node.value.startswith("-") else "inf")


Loader.add_constructor(f"{_TAG}int", Loader.construct_yaml_int)


def _name(node: yaml.Node) -> str:
    return str(getattr(node, "id", "node"))


def _refuse(node: yaml.Node, problem: str) -> None:
    raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


def parse_yaml(text: str, loader: type[Loader] = Loader) -> Any:
    """Parse one YAML document; raises yaml.YAMLError or ValueError where it is none, too deep or
    too large."""
    opened = loader(text)
    try:
        node = opened.get_single_node()
        if node is None:
            return None
        _measure(node)
        return opened.construct_document(node)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    finally:
        opened.dispose()


def _measure(root: yaml.Node) -> None:
    """Raise ConstructorError where a node holds itself, or is too deep or too large."""
    sizes: dict[int, tuple[int, int]] = {}
    open_: set[int] = set()

    def measured(node: yaml.Node) -> tuple[int, int]:
        key = id(node)
        if key in sizes:
            return sizes[key]
        if key in open_:
            _refuse(node, "a value holds itself by an alias")
        inner: list[yaml.Node] = []
        if isinstance(node, yaml.SequenceNode):
            inner = node.value
        elif isinstance(node, yaml.MappingNode):
            inner = [part for pair in node.value for part in pair]
        if len(open_) > MAX_DEPTH:
            _refuse(node, f"nested more than {MAX_DEPTH} deep")
        open_.add(key)
        found = [measured(part) for part in inner]
        open_.discard(key)
        sizes[key] = 1 + sum(size for size, _ in found), 1 + max((d for _, d in found), default=0)
        if sizes[key][1] > MAX_DEPTH + 1:
            _refuse(node, f"nested more than {MAX_DEPTH} deep")
        if sizes[key][0] > MAX_NODES:
            _refuse(node, f"more than {MAX_NODES} values, aliases written out")
        return sizes[key]

    measured(root)


def read_yaml(
    path: Path,
    limit: int = MAX_SETTINGS_BYTES,
    *,
    loader: type[Loader] = Loader,
    prepared: Callable[[str], str] | None = None,
) -> Any:
    """Parse a YAML file; ``prepared`` changes its text first. Raises Unreadable where it is
    missing, too large or malformed."""
    if not os.path.lexists(path):
        raise Unreadable(path, "there is no such file")
    text = read_text(path, limit)
    try:
        return parse_yaml(text if prepared is None else prepared(text), loader)
    except (yaml.YAMLError, ValueError) as error:
        raise Unreadable(path, f"not valid YAML{told(error)}", "correct it") from None


def told(error: Exception) -> str:
    """Line and problem of what :func:`parse_yaml` raised."""
    mark = getattr(error, "problem_mark", None)
    where = f" in line {mark.line + 1}" if mark else ""
    problem = getattr(error, "problem", None) or str(error).splitlines()[0]
    return f"{where} ({problem[:200]})"
