"""Entries of a YAML list or mapping as lines: splitting, joining and matching.

Each entry keeps its comments: those on its lines, indented below it, or directly above it. A
comment that a blank line separates from the entry below stands alone, as do comments above the
whole list. Lines have no line ends.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

# Keys that identify an entry of a list; a missing frame is frame 0
_IDENTITY = {
    "contact": ("part",),
    "left_right": ("camera",),
    "object_poses": ("frame",),
    "subject": ("camera", "frame"),
}


class UnsupportedLayout(ValueError):
    """The layout of the text does not let a section be changed without loss."""


@dataclass(frozen=True)
class EntryLines:
    """Lines of an entry of a list or mapping."""

    standalone: list[str]
    """Comments and blank lines above that do not belong to the entry."""
    lead: list[str]
    """Comments directly above."""
    lines: list[str]
    """Lines of the entry, with comments on them and indented below."""


@dataclass(frozen=True)
class SectionLines:
    """Lines of a section."""

    header: list[str]
    """Lines from the section's name down to the lead of the first entry."""
    entries: list[EntryLines]
    tail: list[str]
    """Lines below the last entry."""


def comment_columns(text: str) -> dict[int, int]:
    """Map the number of each line with a comment to the column of the comment."""
    ends: dict[int, int] = {}
    inside: set[int] = set()  # lines that end inside of a multi-line scalar
    for token in yaml.scan(text):
        start, stop = token.start_mark, token.end_mark
        if start.index < stop.index:
            ends[stop.line] = max(ends.get(stop.line, 0), stop.column)
            inside.update(range(start.line, stop.line))
    columns = {}
    for number, line in enumerate(text.splitlines()):
        column = line.find("#", ends.get(number, 0))
        if column >= 0 and number not in inside:
            columns[number] = column
    return columns


def comments(text: str) -> list[str]:
    """Return the comments of a text, sorted."""
    lines = text.splitlines()
    return sorted(lines[n][column:].rstrip() for n, column in comment_columns(text).items())


def split_entries(lines: Sequence[str], node: yaml.CollectionNode) -> SectionLines:
    """Split a section whose value is the block list or mapping ``node``."""
    text = "\n".join(lines)
    if isinstance(node, yaml.MappingNode):
        marks = [key.start_mark for key, _ in node.value]
    else:
        marks = [t.start_mark for t in yaml.scan(text) if isinstance(t, yaml.BlockEntryToken)]
    column = marks[0].column
    starts = [mark.line for mark in marks if mark.column == column]
    own_line = all(not lines[k][:column].strip() for k in starts)
    if not own_line or len(starts) != len(node.value) or len(set(starts)) < len(starts):
        raise UnsupportedLayout
    columns = comment_columns(text)
    comment_lines = {n for n, at in columns.items() if not lines[n][:at].strip()}

    def gap(first: int, last: int) -> tuple[list[str], list[str]]:
        """Split lines between entries into standalone lines and the lead of the next entry."""
        at = last
        while at > first and at - 1 in comment_lines:
            at -= 1
        return list(lines[first:at]), list(lines[at:last])

    standalone, lead = gap(1, starts[0])
    header = [*lines[:1], *standalone]
    standalone = []
    entries = []
    for first, last in zip(starts, [*starts[1:], len(lines)], strict=True):
        end = last
        while end > first + 1 and (end - 1 in comment_lines or not lines[end - 1].strip()):
            end -= 1
        while end < last and end in comment_lines and columns[end] > column:  # indented below
            end += 1
        entries.append(EntryLines(standalone, lead, list(lines[first:end])))
        standalone, lead = gap(end, last)
    return SectionLines(header, entries, standalone + lead)


def join_entries(old: SectionLines, new: Sequence[tuple[int | None, list[str]]]) -> list[str]:
    """Join the lines of a section with other entries.

    The comments of a removed entry are removed with it. A comment above it stays if it may be a
    heading of the list or of remaining entries below.

    Args:
        new: (index in ``old.entries``, or None for a new entry; lines) of each entry.
    """
    place = {k: j for j, (k, _) in enumerate(new) if k is not None}
    header = list(old.header)
    kept: defaultdict[int, list[str]] = defaultdict(list)  # by the new entry below, -1 = the end
    for k, entry in enumerate(old.entries):
        if k in place:
            continue
        remaining = list(entry.standalone)
        if entry.lead and (k == 0 or any(i in place for i in _directly_below(old.entries, k))):
            remaining += [*entry.lead, ""]
        below = next((place[i] for i in range(k, len(old.entries)) if i in place), -1)
        (header if k == 0 else kept[below]).extend(remaining)
    lines = header
    for j, (known, own) in enumerate(new):
        entry = EntryLines([], [], own) if known is None else old.entries[known]
        lines = _append(_append(lines, kept[j]), entry.standalone) + entry.lead + own
    lines = _append(_append(lines, kept[-1]), old.tail)
    while not old.tail and not lines[-1].strip():
        lines.pop()
    return lines


def _directly_below(entries: Sequence[EntryLines], k: int) -> list[int]:
    """Return the entries that follow entry ``k`` without lines between them."""
    below = []
    for i in range(k + 1, len(entries)):
        if entries[i].standalone or entries[i].lead:
            break
        below.append(i)
    return below


def _append(lines: list[str], more: list[str]) -> list[str]:
    """Concatenate lines with at most one blank line between."""
    if lines and more and not lines[-1].strip() and not more[0].strip():
        more = more[1:]
    return [*lines, *more]


def match_entries(section: str, old: Sequence[Any], new: Sequence[Any]) -> list[int | None]:
    """Return for each new entry of a list the index of its old entry, None if it is new.

    Equal entries match first, then the nearest intervals of the same identity.
    """
    left = list(range(len(old)))
    matches: list[int | None] = []
    for entry in new:
        match = next((k for k in left if old[k] == entry), None)
        matches.append(match)
        if match is not None:
            left.remove(match)
    keys = _IDENTITY.get(section, ())
    pairs = sorted(
        (_distance(old[k], new[j]), j, k)
        for j, match in enumerate(matches)
        for k in left
        if match is None and keys and _same_identity(old[k], new[j], keys)
    )
    for _, j, k in pairs:
        if matches[j] is None and k in left:
            matches[j] = k
            left.remove(k)
    return matches


def _same_identity(a: Any, b: Any, keys: Sequence[str]) -> bool:
    if not isinstance(a, Mapping) or not isinstance(b, Mapping):
        return False
    return all(a.get(key, 0) == b.get(key, 0) for key in keys)


def _distance(a: Mapping[str, Any], b: Mapping[str, Any]) -> float:
    """Sum of the differences of start and end, frames; 0 for entries without an interval."""
    pairs = [(a.get(key), b.get(key)) for key in ("start", "end")]
    return sum(
        abs(x - y) for x, y in pairs if isinstance(x, int | float) and isinstance(y, int | float)
    )
