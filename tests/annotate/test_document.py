"""The annotation file: what a user wrote stays, saves are whole, another's change is noticed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError

from intercap_core.annotate import document
from intercap_core.annotation import STATED_EMPTY, Annotation
from intercap_core.errors import UserError

EXAMPLE = Path(__file__).resolve().parents[2] / "config" / "annotations.example.yaml"
WRITTEN = """\
# by Ann, on Monday
contact: # looked at twice
- part: seat # sits
  start: 1
  end: 4
# between
- part: back
  start: 1
  end: 4 # late
drop_frames: [3, 4] # dark
# the end
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "s01.yaml"


def _patched(path: Path, text: str, **changes: object) -> str:
    path.write_text(text)
    return document.patched(document.read(path), changes)


def test_a_section_that_stays_is_not_touched(path: Path) -> None:
    text = EXAMPLE.read_text()
    new = _patched(path, text, drop_frames=[17, 18, 40])
    assert new == text.replace("drop_frames: [17, 18]", "drop_frames: [17, 18, 40]")


def test_each_section_can_be_changed_taken_away_and_added(path: Path) -> None:
    text = EXAMPLE.read_text()
    whole = yaml.safe_load(text)
    for section, value in whole.items():
        if section in ("starts", "starts_sigma"):
            continue
        without = _patched(path, text, **{section: None})
        assert yaml.safe_load(without) == {k: v for k, v in whole.items() if k != section}
        assert without.count("#") == text.count("#")  # no comment is lost with it
        again = _patched(path, without, **{section: value})
        assert yaml.safe_load(again) == whole


def test_a_new_file_reads_like_the_example(path: Path) -> None:
    changes = {
        "contact": [{"part": "seat", "start": 1, "end": 5}],
        "object_poses": [
            {"frame": 3, "rotation_vector": [0.1, 0.2, 0.3], "translation": [0, 0.5, 2.25]},
            {"frame": 5, "rotation_vector": [0.1, 0.2, 0.4], "translation": [0, 0.5, 2.5]},
        ],
    }
    new = document.patched(document.read(path), changes)
    assert new == (
        "contact:\n  - {part: seat, start: 1, end: 5}\n\nobject_poses:\n"
        "  - {frame: 3, rotation_vector: [0.1, 0.2, 0.3], translation: [0, 0.5, 2.25]}\n"
        "  - {frame: 5, rotation_vector: [0.1, 0.2, 0.4], translation: [0, 0.5, 2.5]}\n"
    )


@pytest.mark.parametrize(
    "text",
    [
        "{contact: [{part: seat, start: 1, end: 4}]}\n",
        "contact: &c\n  - {part: seat, start: 1, end: 4}\n",
        "contact:\r\n  - {part: seat, start: 1, end: 4}\r\n",
        "---\ncontact:\n  - {part: seat, start: 1, end: 4}\n...\n",
        "contact:\n  - {part: seat, start: 1, end: 4}",
    ],
)
def test_other_layouts_are_understood_or_left_alone(path: Path, text: str) -> None:
    path.write_bytes(text.encode())
    new = document.patched(document.read(path), {"drop_frames": [2]})
    assert yaml.safe_load(new) == {**yaml.safe_load(text), "drop_frames": [2]}
    assert ("\r\n" in new) == ("\r\n" in text)


def test_an_invalid_file_is_reported_and_not_written(path: Path) -> None:
    path.write_text("contact: [\n")
    file = document.read(path)
    assert str(path) in file.problem and "line" in file.problem
    with pytest.raises(UserError, match="not valid YAML"):
        document.patched(file, {"drop_frames": [1]})


def test_faults_are_those_of_the_settings_model() -> None:
    faults = document.faults(
        {"contact": [{"part": "tail", "start": 5, "end": 2}], "floor": [[0, 0, 1]]}
    )
    assert {fault["where"] for fault in faults} >= {"contact.0.part"}
    assert not document.faults({"contact": [{"part": "any", "start": 1, "end": 2}]})


def test_a_change_of_another_annotator_is_kept(path: Path) -> None:
    path.write_text(WRITTEN)
    mine = document.read(path)
    theirs = WRITTEN.replace("[3, 4]", "[3, 4, 5]")
    path.write_text(theirs)
    with pytest.raises(document.Changed) as refused:
        document.save(mine, document.patched(mine, {"contact": None}))
    assert path.read_text() == theirs
    assert "+drop_frames: [3, 4, 5] # dark" in refused.value.difference
    assert refused.value.now.sections["drop_frames"] == [3, 4, 5]


def test_a_new_file_of_another_annotator_is_kept(path: Path) -> None:
    nothing = document.read(path)
    path.write_text("drop_frames: [1]\n")
    with pytest.raises(document.Changed):
        document.save(nothing, "drop_frames: [2]\n")
    assert path.read_text() == "drop_frames: [1]\n"


@pytest.mark.parametrize("cut_off_in", ["fsync", "replace"])
def test_an_interrupted_save_leaves_the_file_unchanged(
    path: Path, monkeypatch: pytest.MonkeyPatch, cut_off_in: str
) -> None:
    path.write_text(WRITTEN)
    file = document.read(path)

    def cut_off(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, cut_off_in, cut_off)
        patch.setattr(Path, "unlink", lambda *_, **__: None)  # a killed process clears nothing
        with pytest.raises(KeyboardInterrupt):
            document.save(file, "drop_frames: [2]\n")
    assert path.read_text() == WRITTEN
    again = document.read(path)
    assert "interrupted" in again.note and again.digest == file.digest
    saved = document.save(again, "drop_frames: [2]\n")
    assert path.read_text() == "drop_frames: [2]\n" and not saved.note
    assert [fault.name for fault in path.parent.iterdir()] == [path.name]


def test_a_link_and_its_permissions_stay(tmp_path: Path) -> None:
    (tmp_path / "kept").mkdir()
    real, link = tmp_path / "kept" / "a.yaml", tmp_path / "s01.yaml"
    real.write_text("drop_frames: [1]\n")
    real.chmod(0o640)
    link.symlink_to(real)
    document.save(document.read(link), "drop_frames: [2]\n")
    assert link.is_symlink() and real.read_text() == "drop_frames: [2]\n"
    assert real.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize(
    "text",
    [
        "drop_frames: !!timestamp 2020-01-01\n", "floor: [[.nan, 0, 1], [1, 0, 1], [0, 1, 1]]\n",
        "subject: [{camera: \"\\ud800\", x: 1, y: 2}]\n", "starts: {k1: .inf, k2: 0}\n",
    ],
)  # fmt: skip
def test_values_without_json_form_are_reported_not_written(path: Path, text: str) -> None:
    path.write_text(text)
    file = document.read(path)
    assert str(path) in file.problem and "correct it in an editor" in file.problem
    with pytest.raises(UserError, match="correct it in an editor"):
        document.patched(file, {"drop_frames": [1]})


def test_removing_an_aliased_value_is_refused(path: Path) -> None:
    text = (
        "floor:\n  - &p [0, 0, 1]\n  - [1, 0, 1]\n  - [0, 1, 1]\n"
        "object_pose: {frame: 0, rotation_vector: [0, 0, 0], translation: *p}\n"
    )
    with pytest.raises(UserError, match="change it in an editor"):
        _patched(path, text, floor=[[0, 0, 2], [1, 0, 2], [0, 1, 2]])
    assert path.read_text() == text


def test_only_an_empty_contact_section_is_a_statement(path: Path) -> None:
    """Of the others an empty list is what the section is without, or no value at all."""
    without = Annotation()
    for name in Annotation.model_fields:
        if name in STATED_EMPTY:
            assert getattr(Annotation.model_validate({name: []}), name) is not None
            continue
        try:
            value = Annotation.model_validate({name: []})
        except ValidationError:
            continue
        assert value == without, name
    assert STATED_EMPTY == ("contact",)
    assert _patched(path, "drop_frames: [1]\nfloor: []\n", drop_frames=[]) == "floor: []\n"
    assert document.faults(document.read(path).sections)  # as a run has it


def test_unchanged_lines_keep_their_bytes_and_line_ends(path: Path) -> None:
    mixed = (
        "\ufeff# café\r\n\r\ncontact:\n- part: seat\r\n  start: 1\n  end: 4\r\n\r\n"
        "drop_frames: [3]\r\nfloor: # of the hall\n- [0, 0, 1]\n- [1, 0, 1]\n- [0, 1, 1]"
    ).encode()
    path.write_bytes(mixed)
    file = document.read(path)
    contact = [{"part": "seat", "start": 1, "end": 5}, {"part": "any", "start": 7, "end": 8}]
    floor = [*file.sections["floor"], [1, 1, 1]]
    document.save(file, document.patched(file, {"contact": contact, "floor": floor}))
    assert path.read_bytes() == mixed.replace(
        b"  end: 4\r\n", b"  end: 5\r\n- {part: any, start: 7, end: 8}\r\n"
    ).replace(b"- [0, 1, 1]", b"- [0, 1, 1]\r\n- [1, 1, 1]\r\n")


def test_a_read_only_file_is_not_overwritten(path: Path) -> None:
    path.write_text(WRITTEN)
    path.chmod(0o444)
    file = document.read(path)
    with pytest.raises(UserError, match="read-only"):
        document.save(file, "drop_frames: [2]\n")
    assert path.read_text() == WRITTEN and document.locked(path)
    path.chmod(0o644)
    assert not document.locked(path) and not document.locked(path.with_name("none.yaml"))
    document.save(file, "drop_frames: [2]\n")
