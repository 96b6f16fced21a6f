"""The entries of a YAML list or mapping by lines, so that each keeps its lines and its comments.

A comment on an entry's lines, deeper below it or directly above it is the entry's. What a blank
line parts from the entry below stands for itself, as does what stands above the whole list.
"""

from __future__ import annotations

import difflib
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

# What an entry of a list is known by, and the numbers that may change in it.
_KNOWN_BY: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "contact": (("part",), ("start", "end")),
    "left_right": (("camera",), ("start", "end")),
    "object_poses": (("frame",), ()),
    "subject": (("camera", "frame"), ()),
}
_DEFAULT = {"frame": 0}


@dataclass(frozen=True)
class Entry:
    """Lines of one entry: ``above`` it what stands for itself, then ``lead``, its comments directly
    above, and its ``own``."""

    above: list[str]
    lead: list[str]
    own: list[str]


@dataclass(frozen=True)
class Entries:
    """Lines of a section: ``header`` down to the first entry, the entries, and what follows."""

    header: list[str]
    entries: list[Entry]
    tail: list[str]


def comments(text: str) -> dict[int, int]:
    """The column at which a comment begins, by the number of its line."""
    ends: dict[int, int] = {}
    within: set[int] = set()  # lines that end inside of a text that goes on
    for token in yaml.scan(text):
        start, stop = token.start_mark, token.end_mark
        if start.index < stop.index:
            ends[stop.line] = max(ends.get(stop.line, 0), stop.column)
            within.update(range(start.line, stop.line))
    found = {}
    for number, line in enumerate(text.splitlines()):
        column = line.find("#", ends.get(number, 0))
        if column >= 0 and number not in within:
            found[number] = column
    return found


def comment_texts(text: str) -> list[str]:
    """The comments of a text, sorted."""
    lines = text.splitlines()
    return sorted(lines[number][column:].rstrip() for number, column in comments(text).items())


def split(lines: Sequence[str], node: yaml.CollectionNode) -> Entries | None:
    """The lines of a section whose value is the block list or mapping ``node``; None where its
    entries do not begin lines of their own."""
    text = "".join(lines)
    if isinstance(node, yaml.MappingNode):
        marks = [key.start_mark for key, _ in node.value]
        column = marks[0].column
    else:
        marks = [t.start_mark for t in yaml.scan(text) if isinstance(t, yaml.BlockEntryToken)]
        column = marks[0].column
        marks = [mark for mark in marks if mark.column == column]
    starts = [mark.line for mark in marks]
    begins = all(not lines[k][:column].strip() for k in starts)
    if not begins or len(starts) != len(node.value) or len(set(starts)) < len(starts):
        return None
    told = comments(text)
    bare = {n for n, at in told.items() if not lines[n][:at].strip()}
    gap = _gap(lines, 1, starts[0], bare)
    header, lead = [*lines[:1], *gap[0]], gap[1]
    above: list[str] = []
    entries = []
    for first, last in zip(starts, [*starts[1:], len(lines)], strict=True):
        end = last
        while end > first + 1 and (end - 1 in bare or not lines[end - 1].strip()):
            end -= 1
        while end < last and end in bare and told[end] > column:  # deeper: of this entry
            end += 1
        entries.append(Entry(above, lead, list(lines[first:end])))
        above, lead = _gap(lines, end, last, bare)
    return Entries(header, entries, above + lead)


def _gap(
    lines: Sequence[str], first: int, last: int, bare: set[int]
) -> tuple[list[str], list[str]]:
    """Comments and blank lines between two entries: what stands for itself, and what is directly
    above the second."""
    at = last
    while at > first and at - 1 in bare:
        at -= 1
    return list(lines[first:at]), list(lines[at:last])


def joined(old: Entries, new: Sequence[tuple[int | None, list[str]]], end: str) -> list[str]:
    """The lines with ``new`` entries: the number of the old one each was, None = it is new, and its
    own lines.

    Of an entry that is gone its own comments go along. One above it stays, by itself, where it may
    be a heading: of the list, or of entries below that are still there.
    """
    place = {k: j for j, (k, _) in enumerate(new) if k is not None}
    header = list(old.header)
    held: defaultdict[int, list[str]] = defaultdict(list)  # by the new entry that it stands above
    for k, entry in enumerate(old.entries):
        if k in place:
            continue
        stays = list(entry.above)
        below = _beneath(old.entries, k)
        if entry.lead and (k == 0 or any(i in place for i in below)):
            stays += [*entry.lead, end]
        if k == 0:
            header += stays
        else:
            held[next((place[i] for i in range(k, len(old.entries)) if i in place), -1)] += stays
    lines = header
    for j, (known, own) in enumerate(new):
        entry = Entry([], [], own) if known is None else old.entries[known]
        lines = _below(_below(lines, held[j]), entry.above) + entry.lead + own
    lines = _below(_below(lines, held[-1]), old.tail)
    while not old.tail and not lines[-1].strip():
        lines.pop()
    return lines


def _beneath(entries: Sequence[Entry], k: int) -> list[int]:
    """The entries that follow the ``k``-th without anything between."""
    found = []
    for i in range(k + 1, len(entries)):
        if entries[i].above or entries[i].lead:
            break
        found.append(i)
    return found


def _below(lines: list[str], more: list[str]) -> list[str]:
    """``more`` below ``lines``; one blank line between them is enough."""
    if lines and more and not lines[-1].strip() and not more[0].strip():
        more = more[1:]
    return [*lines, *more]


def same(a: Any, b: Any) -> bool:
    """Whether two values of YAML or JSON are the same; a page knows no 1.0 beside 1."""
    return _plain(a) == _plain(b)


def _plain(value: Any) -> str:
    return json.dumps(_whole(value), sort_keys=True, default=str)


def _whole(value: Any) -> Any:
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(value, Mapping):
        return {str(k): _whole(v) for k, v in value.items()}
    return [_whole(v) for v in value] if isinstance(value, list | tuple) else value


def paired(name: str, old: Sequence[Any], new: Sequence[Any]) -> list[int | None]:
    """For each entry of a list's ``new`` ones the old one that it was, None = it is new: the same
    one, else of the same part or frame the nearest."""
    a, b = [_plain(one) for one in old], [_plain(one) for one in new]
    found: dict[int, int] = {}
    for block in difflib.SequenceMatcher(None, a, b, autojunk=False).get_matching_blocks():
        found |= {block.b + i: block.a + i for i in range(block.size)}
    left = set(range(len(old))) - set(found.values())
    moved: defaultdict[str, list[int]] = defaultdict(list)
    for k in sorted(left, reverse=True):
        moved[a[k]].append(k)
    for j, one in enumerate(b):
        if j not in found and moved[one]:
            found[j] = moved[one].pop()
    keys, numbers = _KNOWN_BY.get(name, ((), ()))
    left -= set(found.values())
    apart = sorted(
        (_distance(old[k], new[j], numbers), j, k)
        for j in sorted(set(range(len(new))) - set(found))
        for k in sorted(left)
        if keys and _alike(old[k], new[j], keys)
    )
    for _, j, k in apart:
        if j not in found and k in left:
            found[j] = k
            left.remove(k)
    return [found.get(j) for j in range(len(new))]


def _alike(a: Any, b: Any, keys: Sequence[str]) -> bool:
    if not isinstance(a, Mapping) or not isinstance(b, Mapping):
        return False
    return all(same(a.get(key, _DEFAULT.get(key)), b.get(key, _DEFAULT.get(key))) for key in keys)


def _distance(a: Mapping[str, Any], b: Mapping[str, Any], numbers: Sequence[str]) -> float:
    apart = 0.0
    for key in numbers:
        x, y = a.get(key), b.get(key)
        apart += abs(x - y) if isinstance(x, int | float) and isinstance(y, int | float) else 1e9
    return apart
