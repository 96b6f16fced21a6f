"""Replace one section of a YAML text without touching other lines.

Unchanged lines keep their bytes and each entry its comments (:mod:`.yaml_entries`). Changed
entries are merged by ruamel.yaml. New lines end as most lines of the text do.
"""

from __future__ import annotations

import difflib
import io
from collections import Counter
from typing import Any

import yaml

from intercap_core.annotate.yaml_entries import (
    EntryLines,
    UnsupportedLayout,
    comment_columns,
    comments,
    join_entries,
    match_entries,
    split_entries,
)
from intercap_core.inputs.documents import parse_yaml

_FLOW_ITEMS = {"contact", "floor", "subject", "left_right", "object_poses"}  # an entry per line
_FLOW_LISTS = {"drop_frames", "rotation_vector", "translation"}  # one line


def replace_section(text: str, section: str, value: Any) -> str:
    """Return ``text`` with another value of the section; None removes it.

    Raises UnsupportedLayout, or yaml.YAMLError if the text is not YAML.
    """
    old, old_lines = text.splitlines(), text.splitlines(keepends=True)
    ends = Counter(line[len(bare) :] for line, bare in zip(old_lines, old, strict=True))
    del ends[""]
    end = ends.most_common(1)[0][0] if ends else "\n"
    new = _replaced(old, section, value)
    lines = [line + end for line in new]
    # unchanged lines get their own line ends back
    matcher = difflib.SequenceMatcher(None, old, new, autojunk=False)
    for a, b, size in matcher.get_matching_blocks():
        lines[b : b + size] = old_lines[a : a + size]
    ended = [line if line.splitlines() != [line] else line + end for line in lines[:-1]]
    return "".join([*ended, *lines[-1:]])


def _replaced(lines: list[str], section: str, value: Any) -> list[str]:
    """Return the lines of a text with another value of a section; None removes it."""
    spans = _section_spans(lines)
    if spans is None:
        return _rewritten(lines, section, value)
    if section in spans:
        first, last = spans[section]
        new: list[str] = []
        if value is not None:
            try:
                new = _changed_section(lines[first:last], section, value)
            except yaml.composer.ComposerError:  # an alias of another section
                return _rewritten(lines, section, value)
        return [*lines[:first], *new, *lines[last:]]
    if value is None:
        return lines
    at = len(lines)
    while at and lines[at - 1].strip() in ("...", ""):
        at -= 1
    gap = [""] if at else []
    return [*lines[:at], *gap, *_new_section(section, value), *lines[at:]]


def _section_spans(lines: list[str]) -> dict[str, tuple[int, int]] | None:
    """Return (first line, line after the last) of each section, without comments below it.

    None if a section does not begin at the start of a line of its own.
    """
    root = yaml.compose("\n".join(lines), Loader=yaml.SafeLoader)
    if root is None or root.value == "":  # an empty document
        return {}
    if not isinstance(root, yaml.MappingNode) or root.flow_style:
        return None
    starts = [key.start_mark for key, _ in root.value]
    if any(mark.column for mark in starts) or len({m.line for m in starts}) < len(starts):
        return None
    spans = {}
    ends = [*(mark.line for mark in starts[1:]), len(lines)]
    for (key, _), mark, last in zip(root.value, starts, ends, strict=True):
        while last > mark.line + 1 and (
            not lines[last - 1].strip() or lines[last - 1].startswith(("#", "...", "---"))
        ):
            last -= 1
        spans[str(key.value)] = (mark.line, last)
    return spans


def _changed_section(lines: list[str], section: str, value: Any) -> list[str]:
    """Return the section's ``lines`` with another value."""
    text = _text(lines)
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    assert isinstance(root, yaml.MappingNode)
    node = root.value[0][1]
    before: Any = next(iter(parse_yaml(text).values()))
    if before == value:
        return lines
    if not before or type(before) not in (list, dict) or type(before) is not type(value):
        return _replaced_value(lines, node, section, value)
    if node.flow_style:
        return _merged(lines, section, value)
    old = split_entries(lines, node)
    if isinstance(value, dict):
        if [str(key.value) for key, _ in node.value] != [str(name) for name in before]:
            raise UnsupportedLayout  # keys of another mapping are merged in
        matches = [list(before).index(name) if name in before else None for name in value]
        old_values: list[Any] = [{name: entry} for name, entry in before.items()]
        new_values: list[Any] = [{name: entry} for name, entry in value.items()]
    else:
        matches = match_entries(section, before, value)
        old_values, new_values = [[entry] for entry in before], [[entry] for entry in value]
    flow = section in _FLOW_ITEMS or bool(getattr(node.value[0], "flow_style", False))
    new: list[tuple[int | None, list[str]]] = []
    for k, entry in zip(matches, new_values, strict=True):
        if k is None:
            new.append((k, _new_entry(old.entries[0], entry, flow=flow)))
        elif old_values[k] == entry:
            new.append((k, old.entries[k].lines))
        else:  # the entry's lines become the value of a section named x
            new.append((k, _merged(["x:", *old.entries[k].lines], "x", entry)[1:]))
    joined = join_entries(old, new)
    if not value:  # an empty list, before the section's comment
        column = comment_columns(_text(joined)).get(0, len(joined[0]))
        head = joined[0][:column].rstrip()
        joined[0] = f"{head} []{joined[0][len(head) :]}"
    return joined


def _replaced_value(lines: list[str], node: yaml.Node, section: str, value: Any) -> list[str]:
    """Replace the whole value of a section; its comments stay."""
    columns = comment_columns(_text(lines))
    new = _new_section(section, value)
    if 0 in columns and node.start_mark.line == 0:
        head = lines[0][: columns[0]].rstrip()
        new[0] += lines[0][len(head) :]
    own_line = {n for n, column in columns.items() if not lines[n][:column].strip()}
    kept = [line for n, line in enumerate(lines) if n in own_line or not line.strip()]
    if comments(_text([*new[:1], *kept])) != comments(_text(lines)):
        raise UnsupportedLayout
    return [*new[:1], *kept, *new[1:]]


def _text(lines: list[str]) -> str:
    return "".join(f"{line}\n" for line in lines)


# --- new values and merged entries, by ruamel.yaml ------------------------------------------------


def _new_section(section: str, value: Any) -> list[str]:
    return _dump(_writer([]), _container({section: _node(section, value)}))


def _new_entry(like: EntryLines, value: Any, *, flow: bool) -> list[str]:
    """Return the lines of a new entry of a list or mapping that has entries ``like`` it."""
    root = _container({"x": _node("", value, inner=flow)})
    return _dump(_writer(["x:", *like.lines]), root)[1:]


def _merged(lines: list[str], key: str, value: Any) -> list[str]:
    """Return the lines of ``key`` with changed values; comments and formats of numbers stay."""
    writer = _writer(lines)
    root = writer.load(_text(lines))
    root[key] = _merge(root[key], value, key)
    new = _dump(writer, root)
    if comments(_text(new)) != comments(_text(lines)):
        raise UnsupportedLayout
    return new


def _rewritten(lines: list[str], section: str, value: Any) -> list[str]:
    """Replace a section of a text whose sections do not have their own lines."""
    if comment_columns(_text(lines)):
        raise UnsupportedLayout
    writer = _writer(lines)
    root = writer.load(_text(lines)) or _container({})
    if value is None:
        root.pop(section, None)
    elif section in root:
        root[section] = _merge(root[section], value, section)
    else:
        root[section] = _node(section, value)
    return _dump(writer, root)


def _writer(lines: list[str]) -> Any:
    """Return a YAML writer with the indentation of a text."""
    from ruamel.yaml import YAML

    writer = YAML()
    writer.preserve_quotes = True
    writer.width = 10_000  # longer lines would be broken
    offset, mapping = 2, 2
    for line in lines[1:]:
        body = line.lstrip(" ")
        if not body or body.startswith("#"):
            continue
        if body.startswith("-"):
            offset = len(line) - len(body)
        else:
            mapping = max(1, len(line) - len(body))
        break
    writer.indent(mapping=mapping, sequence=offset + 2, offset=offset)
    return writer


def _dump(writer: Any, root: Any) -> list[str]:
    stream = io.StringIO()
    writer.dump(root, stream)
    return stream.getvalue().splitlines()


def _container(value: Any) -> Any:
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    return CommentedMap(value) if isinstance(value, dict) else CommentedSeq(value)


def _node(name: str, value: Any, *, flow: bool = False, inner: bool = False) -> Any:
    """Convert a new value; ``flow`` puts it on one line, ``inner`` each of its items."""
    node: Any
    inner = inner or flow or name in _FLOW_ITEMS
    if isinstance(value, dict):
        node = _container({k: _node(str(k), v, flow=flow) for k, v in value.items()})
    elif isinstance(value, list | tuple):
        node = _container([_node("", v, flow=inner) for v in value])
        flow = flow or name in _FLOW_LISTS or not value
    else:
        return value
    if flow:
        node.fa.set_flow_style()
    return node


def _merge(node: Any, value: Any, name: str) -> Any:
    """Return ``node`` with another value; parts that stay equal keep their nodes and format."""
    if node == value:
        return node
    flow = bool(hasattr(node, "fa") and node.fa.flow_style())
    if isinstance(node, dict) and isinstance(value, dict):
        for key in [key for key in node if key not in value]:
            del node[key]
        for key, item in value.items():
            node[key] = (
                _merge(node[key], item, key) if key in node else _node(str(key), item, flow=flow)
            )
        return node
    if isinstance(node, list) and isinstance(value, list):
        if len(node) == len(value):
            for k, item in enumerate(value):
                node[k] = _merge(node[k], item, "")
            return node
        items = [
            _node("", item, flow=True) if k is None else _merge(node[k], item, "")
            for k, item in zip(match_entries(name, node, value), value, strict=True)
        ]
        merged = _container(items)
        if flow:
            merged.fa.set_flow_style()
        return merged
    return _node(name, value, flow=flow)
