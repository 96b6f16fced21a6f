"""Replace one section of a YAML text without touching other lines.

Equal values keep their bytes and each entry its comments (:mod:`.yaml_entries`). New lines end as
most lines of the text do.
"""

from __future__ import annotations

import difflib
import io
from collections import Counter
from collections.abc import Sequence
from typing import Any

import yaml

from intercap_core.annotate.yaml_entries import (
    Entry,
    UnsupportedLayout,
    comment_columns,
    comments,
    equal_values,
    join_entries,
    match_entries,
    split_entries,
)
from intercap_core.inputs.documents import parse_yaml

_WIDTH = 10_000  # characters; longer lines would be broken
_FLOW_ITEMS = {"contact", "floor", "subject", "left_right", "object_poses"}  # an entry per line
_FLOW_LISTS = {"drop_frames", "rotation_vector", "translation"}  # one line


def replace_section(text: str, section: str, value: Any) -> str:
    """Return ``text`` with another value of the section; None removes it.

    Raises UnsupportedLayout, or yaml.YAMLError if the text is not YAML.
    """
    spans = _section_spans(text)
    if spans is None:
        return _rewrite_all(text, section, value)
    lines, end = text.splitlines(keepends=True), _line_end(text)
    if section in spans:
        first, last = spans[section]
        new: list[str] = []
        if value is not None:
            try:
                new = _changed_section(lines[first:last], section, value, end)
            except yaml.composer.ComposerError:  # an alias of another section
                return _rewrite_all(text, section, value)
        return _join([*lines[:first], *new, *lines[last:]], end)
    if value is None:
        return text
    at = len(lines)
    while at and lines[at - 1].strip() in ("...", ""):
        at -= 1
    gap = [end] if at else []
    return _join([*lines[:at], *gap, *_new_section(section, value, end), *lines[at:]], end)


# --- lines ------------------------------------------------------------------------------------


def _line_end(text: str) -> str:
    """Return the most frequent line end."""
    ends = Counter(line[len(_bare(line)) :] for line in text.splitlines(keepends=True))
    del ends[""]
    return ends.most_common(1)[0][0] if ends else "\n"


def _bare(line: str) -> str:
    return line.splitlines()[0] if line else ""


def _join(lines: Sequence[str], end: str) -> str:
    """Join lines; all but the last one get a line end."""
    ended = [line if line != _bare(line) else line + end for line in lines[:-1]]
    return "".join([*ended, *lines[-1:]])


def _with_end(text: str, end: str) -> list[str]:
    return [line + end for line in text.splitlines()]


def _section_spans(text: str) -> dict[str, tuple[int, int]] | None:
    """Return first line and line after the last of each section, without comments below it.

    None if a section does not begin its own line.
    """
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if root is None or root.value == "":  # an empty document
        return {}
    if not isinstance(root, yaml.MappingNode) or root.flow_style:
        return None
    lines = text.splitlines()
    starts = [key.start_mark for key, _ in root.value]
    if any(mark.column for mark in starts) or len({m.line for m in starts}) < len(starts):
        return None
    spans = {}
    ends = [*(mark.line for mark in starts[1:]), len(lines)]
    for (key, _), mark, end in zip(root.value, starts, ends, strict=True):
        last = end
        while last > mark.line + 1 and (
            not lines[last - 1].strip() or lines[last - 1].startswith(("#", "...", "---"))
        ):
            last -= 1
        spans[str(key.value)] = (mark.line, last)
    return spans


# --- a section by its entries -----------------------------------------------------------------


def _changed_section(lines: list[str], section: str, value: Any, end: str) -> list[str]:
    """Return the section's ``lines`` with another value."""
    text = "".join(lines)
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    assert isinstance(root, yaml.MappingNode)
    node = root.value[0][1]
    before: Any = next(iter(parse_yaml(text).values()))
    if equal_values(before, value):
        return lines
    if not before or type(before) not in (list, dict) or type(before) is not type(value):
        return _replace_value(lines, node, section, value, end)
    if node.flow_style:
        if isinstance(value, dict):
            return _merged_lines(lines, section, value, end)
        if any(node.start_mark.line <= n < node.end_mark.line for n in comment_columns(text)):
            raise UnsupportedLayout
        return _flow_list(text, node, before, value, section).splitlines(keepends=True)
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
            new.append((k, _new_entry(old.entries[0], entry, flow=flow, end=end)))
        elif equal_values(old_values[k], entry):
            new.append((k, old.entries[k].lines))
        else:
            section_lines = [f"x:{end}", *old.entries[k].lines]
            new.append((k, _merged_lines(section_lines, "x", entry, end)[1:]))
    joined = join_entries(old, new, end)
    if not value:  # an empty list, next to the section's comment
        column = comment_columns("".join(joined)).get(0, len(_bare(joined[0])))
        head = joined[0][:column].rstrip()
        joined[0] = f"{head} []{joined[0][len(head) :]}"
    return joined


def _flow_list(
    text: str, node: yaml.CollectionNode, before: list[Any], value: list[Any], section: str
) -> str:
    """Return the text with other items of a list in brackets without comments."""
    spans = [(item.start_mark.index, item.end_mark.index) for item in node.value]
    first, last = node.start_mark.index, node.end_mark.index
    items = [
        _to_flow(item) if k is None or not equal_values(before[k], item) else text[slice(*spans[k])]
        for k, item in zip(match_entries(section, before, value), value, strict=True)
    ]
    between = text[spans[0][1] : spans[1][0]] if len(spans) > 1 else ", "
    head, foot = text[first : spans[0][0]], text[spans[-1][1] : last]
    inner = f"{head}{between.join(items)}{foot}" if items else "[]"
    return text[:first] + inner + text[last:]


def _replace_value(
    lines: list[str], node: yaml.Node, section: str, value: Any, end: str
) -> list[str]:
    """Replace the whole value of a section; its comments stay."""
    text = "".join(lines)
    columns = comment_columns(text)
    new = _new_section(section, value, end)
    if 0 in columns and node.start_mark.line == 0:
        head = lines[0][: columns[0]].rstrip()
        new[0] = _bare(new[0]) + lines[0][len(head) :]
    own_line = {n for n, column in columns.items() if not lines[n][:column].strip()}
    kept = [line for n, line in enumerate(lines) if n in own_line or not line.strip()]
    if comments("".join([*new[:1], *kept])) != comments(text):
        raise UnsupportedLayout
    return [*new[:1], *kept, *new[1:]]


# --- new values and merged entries, by ruamel.yaml ------------------------------------------------


def _new_section(section: str, value: Any, end: str) -> list[str]:
    return _with_end(_dump(_writer(""), _container({section: _node(section, value)})), end)


def _new_entry(like: Entry, value: Any, *, flow: bool, end: str) -> list[str]:
    """Return the lines of a new entry of a list or mapping that has entries ``like`` it."""
    root = _container({"x": _node("", value, inner=flow)})
    return _with_end(_dump(_writer("x:\n" + "".join(like.lines)), root), end)[1:]


def _merged_lines(lines: list[str], key: str, value: Any, end: str) -> list[str]:
    """Return the lines of ``key`` with changed values; comments and layout stay."""
    text = "".join(_bare(line) + "\n" for line in lines)
    writer = _writer(text)
    root = writer.load(text)
    root[key] = _merge(root[key], value, key)
    new = _dump(writer, root)
    if comments(new) != comments(text):
        raise UnsupportedLayout
    new_lines, old_lines = new.splitlines(), text.splitlines()
    merged = [line + end for line in new_lines]
    matcher = difflib.SequenceMatcher(None, old_lines, new_lines, autojunk=False)
    for block in matcher.get_matching_blocks():
        for i in range(block.size):
            merged[block.b + i] = lines[block.a + i]
    return merged


def _rewrite_all(text: str, section: str, value: Any) -> str:
    """Replace a section of a text whose sections do not have their own lines."""
    lines, end = text.splitlines(keepends=True), _line_end(text)
    if comment_columns(text):
        raise UnsupportedLayout
    plain = "".join(_bare(line) + "\n" for line in lines)
    writer = _writer(plain)
    root = writer.load(plain) or _container({})
    if value is None:
        root.pop(section, None)
    elif section in root:
        root[section] = _merge(root[section], value, section)
    else:
        root[section] = _node(section, value)
    return "".join(_with_end(_dump(writer, root), end))


def _writer(text: str) -> Any:
    """Return a YAML writer with the indentation of a text."""
    from ruamel.yaml import YAML

    writer = YAML()
    writer.preserve_quotes = True
    writer.width = _WIDTH
    offset, mapping = 2, 2
    for line in text.splitlines()[1:]:
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


def _dump(writer: Any, root: Any) -> str:
    stream = io.StringIO()
    writer.dump(root, stream)
    return stream.getvalue()


def _to_flow(value: Any) -> str:
    """Serialize a value on one line."""
    if type(value) is int:  # fast, as there may be thousands
        return str(value)
    root = _container([_node("", value)])
    root.fa.set_flow_style()
    return _dump(_writer(""), root).strip()[1:-1]


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
    """Return ``node`` with the differing parts of ``value`` changed in place."""
    if equal_values(node, value):
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
    if isinstance(node, list) and isinstance(value, list) and len(node) == len(value):
        for k, item in enumerate(value):
            node[k] = _merge(node[k], item, "")
        return node
    return _node(name, value, flow=flow)
