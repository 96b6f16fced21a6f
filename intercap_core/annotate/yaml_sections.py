"""One section of a YAML text with another value: only the lines that change are written anew.

What stays equal keeps its bytes and its form, and each comment its entry (:mod:`.yaml_entries`).
New lines end as most lines of the text do.
"""

from __future__ import annotations

import difflib
import io
from collections import Counter
from collections.abc import Sequence
from typing import Any

import yaml

from intercap_core.annotate.yaml_entries import (
    Entries,
    Entry,
    comment_texts,
    comments,
    joined,
    paired,
    same,
    split,
)
from intercap_core.inputs.documents import parse_yaml

_WIDTH = 10_000  # characters of a line, before one is broken: what a user wrote in one stays so
_FLOW_ITEMS = {  # lists with one short entry a line
    "contact", "floor", "subject", "left_right", "object_poses",
}  # fmt: skip
_FLOW_LISTS = {"drop_frames", "rotation_vector", "translation"}


class NoLayout(ValueError):
    """The text is laid out so that a section cannot be changed without harm."""


def with_section(text: str, section: str, value: Any) -> str:
    """``text`` with another value of the section; None takes it away.

    Raises NoLayout, or yaml.YAMLError where the text is none.
    """
    spans = _spans(text)
    if spans is None:
        return _with_whole(text, section, value)
    lines, end = text.splitlines(keepends=True), line_end(text)
    if section in spans:
        first, last = spans[section]
        new: list[str] = []
        if value is not None:
            try:
                new = _changed(lines[first:last], section, value, end)
            except yaml.composer.ComposerError:  # an alias of another section
                return _with_whole(text, section, value)
        return _text([*lines[:first], *new, *lines[last:]], end)
    if value is None:
        return text
    at = len(lines)
    while at and lines[at - 1].strip() in ("...", ""):
        at -= 1
    gap = [end] if at else []
    return _text([*lines[:at], *gap, *_fresh(section, value, end), *lines[at:]], end)


def line_end(text: str) -> str:
    """How most lines of the text end."""
    ends = Counter(line[len(_bare(line)) :] for line in text.splitlines(keepends=True))
    del ends[""]
    return ends.most_common(1)[0][0] if ends else "\n"


def _bare(line: str) -> str:
    return line.splitlines()[0] if line else ""


def _text(lines: Sequence[str], end: str) -> str:
    """The lines as one text; below a last line that had no end others may have come."""
    ended = [line if line != _bare(line) else line + end for line in lines[:-1]]
    return "".join([*ended, *lines[-1:]])


def _spans(text: str) -> dict[str, tuple[int, int]] | None:
    """First line and the one after the last of each section, without the comments that stand before
    the next one; None where sections do not begin lines of their own."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if root is None or root.value == "":  # nothing, or nothing between the document's marks
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
        while last > mark.line + 1 and _between(lines[last - 1]):
            last -= 1
        spans[str(key.value)] = (mark.line, last)
    return spans


def _between(line: str) -> bool:
    return not line.strip() or line.startswith(("#", "...", "---"))


# --- a section by its entries -----------------------------------------------------------------


def _changed(lines: list[str], section: str, value: Any, end: str) -> list[str]:
    """The section's ``lines`` with another value."""
    text = "".join(lines)
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    assert isinstance(root, yaml.MappingNode)
    node = root.value[0][1]
    before: Any = next(iter(parse_yaml(text).values()))
    if same(before, value):
        return lines
    if not before or type(before) not in (list, dict) or type(before) is not type(value):
        return _in_place_of(lines, node, section, value, end)
    if node.flow_style and isinstance(value, dict):
        return _merged_lines(lines, section, value, end)
    between = range(node.start_mark.line, node.end_mark.line)
    if not node.flow_style:
        parts = split(lines, node)
    elif any(n in between for n in comments(text)):
        parts = _one_a_line(lines, node, end)
    else:
        return _items(text, node, before, value, section).splitlines(keepends=True)
    if parts is None:
        raise NoLayout
    if isinstance(value, dict):
        if [str(key.value) for key, _ in node.value] != [str(name) for name in before]:
            raise NoLayout  # keys of another mapping are merged in
        known = [list(before).index(name) if name in before else None for name in value]
        old: list[Any] = [{name: one} for name, one in before.items()]
        new: list[Any] = [{name: one} for name, one in value.items()]
    else:
        known = paired(section, before, value)
        old, new = [[one] for one in before], [[one] for one in value]
    flow = section in _FLOW_ITEMS or bool(getattr(node.value[0], "flow_style", False))
    told: list[tuple[int | None, list[str]]] = []
    for k, one in zip(known, new, strict=True):
        if k is None:
            told.append((k, _below_key(parts.entries[0], one, flow=flow, end=end)))
        elif same(old[k], one):
            told.append((k, parts.entries[k].own))
        else:
            whole = [f"x:{end}", *parts.entries[k].own]
            told.append((k, _merged_lines(whole, "x", one, end)[1:]))
    return _with_head(joined(parts, told, end), value)


def _with_head(lines: list[str], value: Any) -> list[str]:
    """A list of which nothing is left is [], beside what is said of it."""
    if value:
        return lines
    column = comments("".join(lines)).get(0, len(_bare(lines[0])))
    head = lines[0][:column].rstrip()
    return [f"{head} []{lines[0][len(head) :]}", *lines[1:]]


def _in_place_of(
    lines: list[str], node: yaml.Node, section: str, value: Any, end: str
) -> list[str]:
    """Lines of a value that has no form yet, below what is said of the one that it replaces."""
    text, told = "".join(lines), comments("".join(lines))
    fresh = _fresh(section, value, end)
    if 0 in told and node.start_mark.line == 0:
        head = lines[0][: told[0]].rstrip()
        fresh[0] = _bare(fresh[0]) + lines[0][len(head) :]
    own = {n for n, column in told.items() if not lines[n][:column].strip()}
    kept = [line for n, line in enumerate(lines) if n in own or not line.strip()]
    if comment_texts("".join([*fresh[:1], *kept])) != comment_texts(text):
        raise NoLayout
    return [*fresh[:1], *kept, *fresh[1:]]


def _items(
    text: str, node: yaml.CollectionNode, before: list[Any], value: list[Any], section: str
) -> str:
    """A list in brackets, without comments, with other items."""
    spans = [(one.start_mark.index, one.end_mark.index) for one in node.value]
    first, last = node.start_mark.index, node.end_mark.index
    told = [
        _flow(one) if k is None or not same(before[k], one) else text[slice(*spans[k])]
        for k, one in zip(paired(section, before, value), value, strict=True)
    ]
    between = text[spans[0][1] : spans[1][0]] if len(spans) > 1 else ", "
    head, foot = text[first : spans[0][0]], text[spans[-1][1] : last]
    inner = f"{head}{between.join(told)}{foot}" if told else "[]"
    return text[:first] + inner + text[last:]


def _one_a_line(lines: list[str], node: yaml.CollectionNode, end: str) -> Entries:
    """A list in brackets, with comments between its items, as one of an item a line."""
    text, told = "".join(lines), comments("".join(lines))
    opens, closes = node.start_mark.line, node.end_mark.line

    def said(first: int, last: int) -> list[str]:
        return [f"  {_bare(lines[n][told.pop(n) :])}{end}" for n in range(first, last) if n in told]

    def beside(line: str, number: int) -> str:
        return f"{line}  {_bare(lines[number][told.pop(number) :])}" if number in told else line

    head = text[: node.start_mark.index].rstrip()
    marks = [(one.start_mark, one.end_mark) for one in node.value]
    if opens < marks[0][0].line:
        head = beside(head, opens)
    entries, at = [], opens
    for k, (start, stop) in enumerate(marks):
        lead = said(at, start.line)
        own = f"  - {text[start.index : stop.index]}"
        if k + 1 == len(marks) or marks[k + 1][0].line > stop.line:
            own = beside(own, stop.line)
        entries.append(Entry([], lead, f"{own}{end}".splitlines(keepends=True)))
        at = stop.line
    return Entries([head + end], entries, said(at, closes + 1))


def _below_key(like: Entry, whole: Any, *, flow: bool, end: str) -> list[str]:
    """Lines of an entry that has no form yet, in a list or mapping that has entries ``like`` it."""
    writer = _writer("x:\n" + "".join(like.own))
    root = _commented({"x": _node("", whole, inner=flow)})
    return _ended(_written(writer, root), end)[1:]


def _merged_lines(lines: list[str], key: str, value: Any, end: str) -> list[str]:
    """The lines of ``key`` with what differs from ``value`` changed, comments and form kept."""
    text = "".join(_bare(line) + "\n" for line in lines)
    writer = _writer(text)
    root = writer.load(text)
    root[key] = _merged(root[key], value, key)
    new = _written(writer, root)
    if comment_texts(new) != comment_texts(text):
        raise NoLayout
    made, old = new.splitlines(), text.splitlines()
    found = [line + end for line in made]
    for block in difflib.SequenceMatcher(None, old, made, autojunk=False).get_matching_blocks():
        for i in range(block.size):
            found[block.b + i] = lines[block.a + i]
    return found


def _fresh(section: str, value: Any, end: str) -> list[str]:
    root = _commented({section: _node(section, value)})
    return _ended(_written(_writer(""), root), end)


def _ended(text: str, end: str) -> list[str]:
    return [line + end for line in text.splitlines()]


# --- by the library, which keeps a value's form but moves comments --------------------------------


def _with_whole(text: str, section: str, value: Any) -> str:
    """The same of a text whose sections have no lines of their own."""
    lines, end = text.splitlines(keepends=True), line_end(text)
    if comments(text):
        raise NoLayout
    plain = "".join(_bare(line) + "\n" for line in lines)
    writer = _writer(plain)
    root = writer.load(plain) or _commented({})
    if value is None:
        root.pop(section, None)
    elif section in root:
        root[section] = _merged(root[section], value, section)
    else:
        root[section] = _node(section, value)
    return "".join(_ended(_written(writer, root), end))


def _writer(text: str) -> Any:
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


def _written(writer: Any, root: Any) -> str:
    stream = io.StringIO()
    writer.dump(root, stream)
    return stream.getvalue()


def _flow(value: Any) -> str:
    """A value on one line."""
    if type(value) is int:  # of which there may be thousands
        return str(value)
    root = _commented([_node("", value)])
    root.fa.set_flow_style()
    return _written(_writer(""), root).strip()[1:-1]


def _commented(value: Any) -> Any:
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    return CommentedMap(value) if isinstance(value, dict) else CommentedSeq(value)


def _node(name: str, value: Any, *, flow: bool = False, inner: bool = False) -> Any:
    """A value that has no form yet; ``flow``: on one line, ``inner``: its items are."""
    node: Any
    inner = inner or flow or name in _FLOW_ITEMS
    if isinstance(value, dict):
        node = _commented({k: _node(str(k), v, flow=flow) for k, v in value.items()})
    elif isinstance(value, list | tuple):
        node = _commented([_node("", v, flow=inner) for v in value])
        flow = flow or name in _FLOW_LISTS or not value
    else:
        return value
    if flow:
        node.fa.set_flow_style()
    return node


def _merged(node: Any, value: Any, name: str) -> Any:
    """``node`` with what differs from ``value`` changed in place."""
    if same(node, value):
        return node
    flow = bool(hasattr(node, "fa") and node.fa.flow_style())
    if isinstance(node, dict) and isinstance(value, dict):
        for key in [key for key in node if key not in value]:
            del node[key]
        for key, one in value.items():
            node[key] = (
                _merged(node[key], one, key) if key in node else _node(str(key), one, flow=flow)
            )
        return node
    if isinstance(node, list) and isinstance(value, list) and len(node) == len(value):
        for k, one in enumerate(value):
            node[k] = _merged(node[k], one, "")
        return node
    return _node(name, value, flow=flow)
