"""Questions to the annotator whose answers have the largest effect.

They are about lost objects, ambiguous rotations, uncertain contact and doubtful subjects. Answers
are saved next to the annotation, and an answered question is not asked again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.annotate.opened import Opened
from intercap_core.annotate.sides import doubts
from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.errors import UserError
from intercap_core.geometry.solve.time_series import runs
from intercap_core.schemas import JOINT, OBJECT_TRACK, PERSON

_MAX_BYTES = 1 << 22  # of the file of answers
_UNSURE = ("unsure", "I cannot tell")  # choice


def answers_path(annotation: Path) -> Path:
    """Return the file of answers to an annotation."""
    return annotation.with_name(f"{annotation.stem}.answers.jsonl")


def propose(opened: Opened, answered: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return open questions, those that change most frames first.

    Entries of a question:
        ``kind``, ``part``: subject, sides, lost, turn or contact; and the body part of contact.
        ``first``, ``last``: frames that it is about; ``from_s``, ``to_s`` their times, seconds.
        ``frame``: frame to look at.
        ``message``, ``choices``: texts for the user.
        ``weight``: number of frames that an answer may change, times a factor by kind.
    """
    questions: list[dict[str, Any]] = []
    with opened.lock:
        with opened.images() as images:
            times = images.time_s
        object_ = opened.project.sequences[opened.name].object or ""
        for ask in (_ask_subject, _ask_sides, _ask_object, _ask_contact):
            try:
                questions += ask(opened, object_.replace("_", " "), times)
            except UserError:  # missing or of another version, which result.py reports
                continue
    for question in questions:
        question["from_s"] = round(float(times[question["first"]]), 3)
        question["to_s"] = round(float(times[question["last"]]), 3)
    unanswered = [q for q in questions if not any(_answers(q, answer) for answer in answered)]
    unanswered.sort(key=lambda question: -question["weight"])
    return unanswered[:40]


def read_answers(path: Path) -> list[dict[str, Any]]:
    """Read the answers; incomplete lines of interrupted writes are skipped."""
    if not path.is_file() or path.stat().st_size > _MAX_BYTES:
        return []
    answers = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            answer = json.loads(line)
        except ValueError:
            continue
        if isinstance(answer, dict):
            answers.append(answer)
    return answers


def keep_answer(path: Path, answer: Mapping[str, Any], by: str | None) -> None:
    """Append an answer to the file, with annotator and time if ``by`` is given."""
    record = dict(answer)
    if by:
        record |= {"by": by, "at": datetime.now(UTC).isoformat(timespec="seconds")}
    path.parent.mkdir(parents=True, exist_ok=True)
    line = json.dumps(record, ensure_ascii=False) + "\n"
    with path.open("ab+") as file:
        if file.tell():
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":  # after an interrupted write
                line = "\n" + line
        file.write(line.encode())
        file.flush()
        os.fsync(file.fileno())


def _answers(question: Mapping[str, Any], answer: Mapping[str, Any]) -> bool:
    """Return whether an answer belongs to a question, by time, as frames may be renumbered."""
    if any(question[key] != answer.get(key) for key in ("kind", "part")):
        return False
    first, last = answer.get("from_s"), answer.get("to_s")
    if not isinstance(first, int | float) or not isinstance(last, int | float):
        return False
    return bool(first <= question["to_s"] and question["from_s"] <= last)


def _question(
    kind: str, part: str, first: int, last: int, frame: int, message: str, weight: float,
    choices: Sequence[tuple[str, str]], **more: Any,
) -> dict[str, Any]:  # fmt: skip
    return {
        "id": f"{kind}.{part}.{first}.{last}", "kind": kind, "part": part, "first": int(first),
        "last": int(last), "frame": int(frame), "message": message, "weight": round(weight, 2),
        "choices": [{"answer": answer, "label": label} for answer, label in choices], **more,
    }  # fmt: skip


def _ask_subject(opened: Opened, object_: str, times: np.ndarray) -> Iterator[dict[str, Any]]:
    """Ask whether the chosen person is the subject, at the most confident image of the hips."""
    with artefacts.read(opened.paths["person"], PERSON) as person:
        doubts, by = str(person.attributes["doubts"]), str(person.attributes["chosen_by"])
        if by in ("alone", "named") and not doubts:
            return
        hips = person["keypoints"][:, :, KEYPOINT_NAMES.index("mid_hip")]  # (T, C, 3)
        t, c = np.unravel_index(int(hips[..., 2].argmax()), hips.shape[:2])
        x, y, confidence = hips[t, c]
        camera = person.text("camera_names")[c]
    if confidence > 0:
        why = f" ({doubts})" if doubts else ""
        yield _question(
            "subject", "", 0, len(times) - 1, int(t),
            f"Several people are visible. Is the marked person the subject?{why}", len(times),
            (("yes", "Yes"), ("no", "No: I click the subject")),
            camera=camera, x=round(float(x), 1), y=round(float(y), 1),
        )  # fmt: skip


def _ask_sides(opened: Opened, object_: str, times: np.ndarray) -> Iterator[dict[str, Any]]:
    """Ask about doubtful left and right (:func:`.sides.doubts`)."""
    for doubt in doubts(opened):
        yield _question(
            "sides", "", doubt.first, doubt.last, doubt.frame,
            "Are L and R in the views the subject's own left and right?",
            2.0 * (doubt.last - doubt.first + 1),
            (("yes", "Yes, in every view"), ("view", f"Swapped in {doubt.camera}"),
             ("all", "Swapped in every view"), ("mark", "I mark where"), _UNSURE),
            camera=doubt.camera, why=doubt.message,
        )  # fmt: skip


def _ask_object(opened: Opened, object_: str, times: np.ndarray) -> Iterator[dict[str, Any]]:
    """Ask where the object is in lost frames, and whether ambiguous rotations are right."""
    if not object_:
        return
    with artefacts.read(opened.paths["object_track"], OBJECT_TRACK) as track:
        lost, ambiguous = track["lost"], track["ambiguous"] & ~track["lost"]
    for first, last in runs(lost):
        yield _question(
            "lost", "", first, last, (first + last) // 2,
            f"The {object_} is lost here. Where is it?", 2.0 * (last - first + 1),
            (("place", "I place it"), ("hidden", "It is not visible")),
        )  # fmt: skip
    for first, last in runs(ambiguous):
        yield _question(
            "turn", "", first, last, (first + last) // 2,
            f"Is the rotation of the {object_} as drawn?", 3.0 + 1.5 * (last - first),
            (("yes", "Yes, as drawn"), ("no", "No: I rotate it"), _UNSURE),
        )  # fmt: skip


def _ask_contact(opened: Opened, object_: str, times: np.ndarray) -> Iterator[dict[str, Any]]:
    """Ask about contact that is not annotated and whose probability is between 0.25 and 0.75."""
    with artefacts.read(opened.paths["joint"], JOINT) as joint:
        probability, labels = joint["contact_probability"], joint["contact_annotated"]
        regions = joint.text("region_names")
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    for r, region in enumerate(regions):
        p = probability[:, r]
        for first, last in runs((p > 0.25) & (p < 0.75) & (labels[:, r] < 0)):
            if (last - first + 1) * step < 0.1:  # seconds; too short to matter
                continue
            # weight: each frame counts 4 p (1 - p), which is 1 at p = 0.5 and 0 if p is certain
            run = p[first : last + 1]
            yield _question(
                "contact", region, first, last, first + int(np.abs(run - 0.5).argmin()),
                f"Does the {region.replace('_', ' ')} touch the {object_} here?",
                float((4 * run * (1 - run)).sum()),
                (("yes", "It touches"), ("no", "It does not"), _UNSURE),
            )  # fmt: skip
