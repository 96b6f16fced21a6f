"""A section with other entries: each entry keeps its comments, each line that stays its bytes."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from intercap_core.annotate.yaml_edit import replace_section
from intercap_core.annotate.yaml_entries import UnsupportedLayout

PARTS = ("right_hand", "left_hand", "seat", "any")
Interval = dict[str, Any]


@st.composite
def _entries(draw: st.DrawFn) -> list[Interval]:
    pairs = draw(st.lists(st.tuples(st.sampled_from(PARTS), st.integers(0, 9)), unique=True,
                         max_size=6))  # fmt: skip
    return [{"part": part, "start": 10 * at, "end": 10 * at + 5} for part, at in pairs]


@st.composite
def _written(draw: st.DrawFn) -> tuple[str, list[Interval]]:
    """A file with comments at random places, each of which tells whose it is."""
    entries = draw(_entries().filter(bool))
    dash = draw(st.sampled_from(["", "  ", "    "]))
    lines = [*draw(st.sampled_from([[], ["# head", ""], ["# head"]])), "contact:"]
    lines[-1] += draw(st.sampled_from(["", " # key"]))
    for k, entry in enumerate(entries):
        if draw(st.booleans()):
            lines += draw(st.sampled_from([[""], ["", f"{dash}# loose{k}", ""]]))
        if draw(st.booleans()):
            lines += [f"{dash}# lead{k}"] * draw(st.integers(1, 2))
        comment = f" # own{k}" if draw(st.booleans()) else ""
        if draw(st.booleans()):
            inner = ", ".join(f"{key}: {value}" for key, value in entry.items())
            lines.append(f"{dash}- {{{inner}}}{comment}")
        else:
            (first, part), *rest = entry.items()
            lines.append(f"{dash}- {first}: {part}{comment}")
            lines += [f"{dash}  {key}:  {value}" for key, value in rest]
            if draw(st.booleans()):
                lines.insert(-1, f"{dash}  # own{k}")
        if draw(st.booleans()):
            lines.append(f"{dash}   # own{k}")
    if dash and draw(st.booleans()):
        lines.append(f"{dash}# tail")
    lines += ["# between", "drop_frames: [1] # dark", "# foot"]
    end = draw(st.sampled_from(["\n", "\r\n"]))
    text = end.join(lines) + draw(st.sampled_from(["", end]))
    return text, entries


@st.composite
def _edited(draw: st.DrawFn, entries: list[Interval]) -> list[Interval]:
    """Entries deleted, moved in time, split, added, and put into another order."""
    result = []
    for entry in entries:
        action = draw(st.sampled_from(["stays", "stays", "goes", "moves", "splits"]))
        if action == "moves":
            result.append({**entry, "end": entry["end"] + 1})
        elif action == "splits":
            middle = entry["start"] + 2
            result += [{**entry, "end": middle}, {**entry, "start": middle}]
        elif action == "stays":
            result.append(entry)
    result += [entry for entry in draw(_entries()) if entry not in entries and entry not in result]
    return draw(st.permutations(result)) if draw(st.booleans()) else result


def _comments_by_entry(text: str) -> dict[str, list[str]]:
    """The comments on, in and directly above each entry, by the entry's values."""
    lines = text.splitlines()
    starts = [k for k, line in enumerate(lines) if line.lstrip().startswith("- ")]
    result: dict[str, list[str]] = {}
    for number, k in enumerate(starts):
        dash = len(lines[k]) - len(lines[k].lstrip())
        first = k
        while lines[first - 1].lstrip().startswith("#"):
            if len(lines[first - 1]) - len(lines[first - 1].lstrip()) > dash:
                break
            first -= 1
        last = k + 1
        while last < len(lines) and lines[last].strip() and last not in starts:
            if len(lines[last]) - len(lines[last].lstrip()) <= dash:
                break
            last += 1
        value = yaml.safe_load("\n".join(lines[k:last]))[0]
        words = [line.partition("#")[2] for line in lines[first:last] if "#" in line]
        assert str(value) not in result, number
        result[str(value)] = words
    return result


@settings(max_examples=80, deadline=None)
@given(st.data())
def test_each_entry_keeps_its_own_comments(data: st.DataObject) -> None:
    text, old = data.draw(_written())
    new = data.draw(_edited(old))
    changed = replace_section(text, "contact", new)
    assert yaml.safe_load(changed) == {"contact": new, "drop_frames": [1]}
    before, after = _comments_by_entry(text), _comments_by_entry(changed)
    for entry in new:
        if entry in old:
            assert after[str(entry)] == before[str(entry)], changed
    for k in range(len(old)):
        for word in (f"# own{k}", f"# lead{k}"):
            assert changed.count(word) <= text.count(word), changed
    words = ["head", "key", "tail", "between", "dark", "foot", *(f"loose{k}" for k in range(9))]
    for word in words:
        assert text.count(f"# {word}") == changed.count(f"# {word}"), (word, changed)
    for k, entry in enumerate(old):
        if entry in new:
            others = [w for other, words in after.items() if other != str(entry) for w in words]
            assert not {f" lead{k}", f" own{k}"} & set(others), changed
    assert ("\r\n" in text) == ("\r\n" in changed) and "\r\r" not in changed
    assert "\r\n" not in text or "\n" not in changed.replace("\r\n", "")


def test_a_changed_entry_keeps_comments_and_number_formats() -> None:
    text = (
        "object_poses:  # by Ann\n  # the first\n  - frame: 0\n"
        "    rotation_vector: [0.10, -1.2, 0.30] # by eye\n"
        "    translation: [0.25, 0.60, 2.40]\n  # the last\n"
        "  - {frame: 9, rotation_vector: [0, 0, 0], translation: [0, 0, 2.50]} # sure\n"
    )
    poses = yaml.safe_load(text)["object_poses"]
    poses[0]["translation"] = [0.25, 0.6, 2.5]
    poses.insert(1, {"frame": 4, "rotation_vector": [0, 0, 0], "translation": [0, 0, 2]})
    assert replace_section(text, "object_poses", poses) == text.replace("2.40", "2.5").replace(
        "  # the last",
        "  - {frame: 4, rotation_vector: [0, 0, 0], translation: [0, 0, 2]}\n  # the last",
    )


@pytest.mark.parametrize(
    ("text", "value", "expected"),
    [
        ("contact: []  # none\n", [{"part": "any"}], "contact:  # none\n  - {part: any}\n"),
        ("contact:  # told\n  # head\n\n  - {part: any} # x\n", [],
         "contact: []  # told\n  # head\n"),
        ("contact: # told\n# late\n- {part: any}\n", [], "contact: [] # told\n# late\n"),
        ("contact: null\n", [], "contact: []\n"),
        ("contact: [{part: any}]\r\n", [], "contact: []\r\n"),
        ("drop_frames: [3, 4] # dark\n", [3, 5], "drop_frames: [3, 5] # dark\n"),
        ("drop_frames:\n- 3 # dark\n- 4 # blurred\n- 5\n", [4, 5, 6],
         "drop_frames:\n- 4 # blurred\n- 5\n- 6\n"),
        ("floor: [\n  [0.0, 0, 1.50],\n  [1, 0, 1]\n]\n", [[0, 0, 1.5], [2, 0, 1], [1, 0, 1]],
         "floor: [[0.0, 0, 1.50], [2, 0, 1], [1, 0, 1]]\n"),
        ("football:\n  mesh: a.ply\n  symmetry: {sphere: true}\n  # maybe\n  labels: [x]\n",
         {"mesh": "a.ply", "labels": ["x"]},
         "football:\n  mesh: a.ply\n  # maybe\n  labels: [x]\n"),
    ],
)  # fmt: skip
def test_sections_of_other_forms(text: str, value: Any, expected: str) -> None:
    assert replace_section(text, text.partition(":")[0], value) == expected


@pytest.mark.parametrize(
    "text",
    [
        "{contact: [{part: any}], # x\n drop_frames: [1]}\n",
        "contact: {part: any} # x\n# y\n? drop_frames\n: [1]\n",
        "contact: [ # x\n  {part: any}, # y\n]\n",
    ],
)
def test_layouts_that_would_lose_comments_are_refused(text: str) -> None:
    with pytest.raises(UnsupportedLayout):
        replace_section(text, "contact", [{"part": "seat"}, {"part": "back"}])
