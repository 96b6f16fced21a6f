"""Which questions are asked, in which order, and that none is asked twice."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from intercap_core.annotate import questions
from intercap_core.annotate.opened import Opened
from intercap_core.project import load_project
from intercap_core.schemas import CONTACT_REGIONS
from tests.annotate.served import NAME, artefact, copied

HAND, SEAT = (CONTACT_REGIONS.index(name) for name in ("right_hand", "seat"))


@pytest.fixture(scope="module")
def settings(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = copied(made, tmp_path_factory.mktemp("asked") / "project")
    with h5py.File(artefact(settings, "joint"), "r+") as file:
        file["contact_probability"][...] = 0.01
        file["contact_probability"][1:5, HAND] = [0.3, 0.5, 0.5, 0.6]
        file["contact_probability"][2:4, SEAT] = [0.3, 0.3]
        file["contact_annotated"][...] = -1
    with h5py.File(artefact(settings, "object_track"), "r+") as file:
        file["lost"][...] = False
        file["lost"][3:6] = True
        file["ambiguous"][...] = False
    return settings


def test_questions_with_the_largest_effect_come_first(opened: Opened) -> None:
    proposed = [q for q in questions.propose(opened, []) if q["kind"] != "subject"]
    assert [(q["kind"], q["part"], q["first"], q["last"]) for q in proposed] == [
        ("lost", "", 3, 5), ("contact", "right_hand", 1, 4), ("contact", "seat", 2, 3),
    ]  # fmt: skip
    assert proposed[1]["message"] == "Does the right hand touch the football here?"
    even = np.array([0.3, 0.5, 0.5, 0.6])
    assert proposed[1]["weight"] == pytest.approx(float((4 * even * (1 - even)).sum()), abs=0.01)


def test_answered_questions_are_not_asked_again(opened: Opened, tmp_path: Path) -> None:
    first = questions.propose(opened, [])
    path = tmp_path / "x.answers.jsonl"
    hand = next(q for q in first if q["part"] == "right_hand")
    questions.keep_answer(path, {**hand, "answer": "unsure"}, None)
    remaining = questions.propose(opened, questions.read_answers(path))
    assert [q["id"] for q in remaining] == [q["id"] for q in first if q is not hand]


def test_answers_match_questions_by_time(opened: Opened) -> None:
    hand = next(q for q in questions.propose(opened, []) if q["part"] == "right_hand")
    answered = {**hand, "first": 400, "last": 403, "answer": "yes"}
    assert hand["id"] not in [q["id"] for q in questions.propose(opened, [answered])]


def test_an_interrupted_write_keeps_other_answers(tmp_path: Path) -> None:
    path = tmp_path / "x.answers.jsonl"
    questions.keep_answer(path, {"kind": "turn"}, None)
    path.write_bytes(path.read_bytes() + b'{"kind": "lo')
    questions.keep_answer(path, {"kind": "lost"}, "ann")
    assert [answer["kind"] for answer in questions.read_answers(path)] == ["turn", "lost"]


def test_annotated_contact_is_not_asked(settings: Path, tmp_path: Path) -> None:
    annotated = copied(settings, tmp_path / "project")
    with h5py.File(artefact(annotated, "joint"), "r+") as file:
        file["contact_annotated"][...] = 0
    opened = Opened(load_project(annotated), NAME)
    assert "contact" not in {q["kind"] for q in questions.propose(opened, [])}
    opened.close()
