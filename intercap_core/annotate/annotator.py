"""A project as the annotation page asks of it: what is to be seen, and what may be changed."""

from __future__ import annotations

import contextlib
import hashlib
import shlex
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

from starlette.exceptions import HTTPException

from intercap_core import artefacts
from intercap_core.annotate import (
    before,
    document,
    objects,
    questions,
    rerun,
    result,
    snap,
)
from intercap_core.annotate.opened import Opened, Pictures
from intercap_core.annotate.questions import answers_path
from intercap_core.commands.check import fault_of_cameras
from intercap_core.config import Annotation, ObjectEntry, ObjectPose
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import stated_errors
from intercap_core.output.site.tables import sequence_table
from intercap_core.project import Project, load_project
from intercap_core.schemas import CONTACT_REGIONS, SUMMARY

_MOST = 1e9  # of a number that a page tells
OPEN_SEQUENCES = 3  # with their images and meshes in memory


class Annotator:
    """A project as the page sees it; ``by`` is who annotates, kept with what is answered."""

    def __init__(
        self, settings: Path, *, by: str = "", cores: int = 0, profile: Path | None = None
    ) -> None:
        self.settings, self.by = settings, by
        self.project = load_project(settings)
        self.runs = rerun.Runs(cores=cores, profile=profile)
        self.pictures = Pictures()
        self._list = SequenceList()
        self._opened: OrderedDict[str, Opened] = OrderedDict()
        self._lock = threading.Lock()

    # --- looking -------------------------------------------------------------------------------

    def sequences(self) -> dict[str, Any]:
        """The table, read again: rows may have come."""
        self.project = load_project(self.settings)
        rows = self._list.rows(self.project)
        return {"dataset": self.project.config.dataset, "by": self.by, "sequences": rows}

    def opened(self, name: str, version: str = "now") -> Opened:
        """The sequence's artefacts, or those before the last run; raises HTTPException where the
        table has no such sequence."""
        if name not in self.project.sequences or version not in ("now", "before"):
            raise HTTPException(404, f"there is no sequence {name[:80]!r} in the table")
        key = f"{version}/{name}"
        with self._lock:
            if key not in self._opened:
                paths = before.before_paths(self.project, name) if version == "before" else None
                self._opened[key] = Opened(self.project, name, paths)
            self._opened.move_to_end(key)
            while len(self._opened) > 2 * OPEN_SEQUENCES:
                self._opened.popitem(last=False)[1].close()
            return self._opened[key]

    def sequence(self, name: str) -> dict[str, Any]:
        """Everything but images and meshes."""
        opened = self.opened(name)
        if not opened.there("frames"):
            by_hand = shlex.join(["intercap", "run", str(self.settings), "--", "--until", "frames"])
            told = f"no images have been read of this recording yet: run it, or `{by_hand}`"
            found: dict[str, Any] = {
                "sequence": name, "frames": 0, "notes": [told], "result": opened.stamp(),
            }  # fmt: skip
        else:
            try:
                found = result.describe(opened)
            except UserError as error:  # a run can make the images anew
                found = {
                    "sequence": name, "frames": 0, "notes": [str(error)], "result": opened.stamp(),
                }  # fmt: skip
        row = self.project.sequences[name]
        made = self.project.annotation_made(name)
        found |= {
            "object": row.object or "",
            "person": row.subject,
            "annotation": self.annotation(name),
            "regions": list(CONTACT_REGIONS),
            "read_only": "the studio writes this annotation anew with the recording"
            if made
            else document.locked(self.project.annotation_path(name)),
            "profile": str(self.runs.profile or ""),
            "project": hashlib.sha256(str(self.settings.resolve()).encode()).hexdigest()[:16],
        }
        return found

    def annotation(self, name: str) -> dict[str, Any]:
        """The annotation file as it is."""
        found = document.read(self.project.annotation_path(name))
        return told_of(found)

    def state(self, name: str) -> dict[str, Any]:
        """What tells an open page that annotation or results are others by now."""
        opened = self.opened(name)
        return {
            "annotation": document.read(self.project.annotation_path(name)).digest,
            "result": opened.stamp(),
        }

    def questions(self, name: str) -> list[dict[str, Any]]:
        """Open questions, those first that change most."""
        answered = questions.read_answers(self._answers(name))
        return questions.propose(self.opened(name), answered)

    # --- changing ------------------------------------------------------------------------------

    def check(self, name: str, told: dict[str, Any]) -> dict[str, Any]:
        """What is wrong with changed sections, what changes in the file, and what runs again."""
        now = document.read(self.project.annotation_path(name))
        changes = _changes(told)
        faults, text = self._edited(name, now, changes)
        found: dict[str, Any] = {"faults": faults, "digest": now.digest, "difference": ""}
        if faults:
            return found
        found["difference"] = document.difference(now.text, text, now.path.name)
        if told.get("plan"):
            annotation = Annotation.model_validate(document.sections_with(now, changes))
            edited = rerun.EditedProject.of(self.project, name, annotation)
            found["touched"] = rerun.touched(edited, name)
        return found

    def save(self, name: str, told: dict[str, Any]) -> dict[str, Any]:
        """Save changed sections into the file that the page has read."""
        if self.project.annotation_made(name):
            raise UserError("the studio writes this annotation; it is not changed here")
        path = self.project.annotation_path(name)
        now = document.read(path)
        changes = _changes(told)
        if now.digest != told.get("digest"):
            base = str(told.get("text", ""))
            raise document.Changed(now, document.difference(base, now.text, path.name))
        faults, text = self._edited(name, now, changes)
        if faults:
            raise UserError("; ".join(f"{one['where']}: {one['words']}" for one in faults))
        saved = document.save(now, text)
        if self.by:
            told = {"kind": "saved", "sections": sorted(changes)}
            with contextlib.suppress(OSError):  # the annotation is saved, whoever did it
                questions.keep_answer(self._answers(name), told, self.by)
        return told_of(saved)

    def answer(self, name: str, told: dict[str, Any]) -> dict[str, Any]:
        """Keep an answer, so that it is not asked again."""
        opened = self.opened(name)
        del opened
        kept = {key: told.get(key) for key in ("kind", "part", "answer", "first", "last", "frame")}
        if any(v is not None and not isinstance(v, str | int) for v in kept.values()):
            raise UserError("an answer has words and frames")
        if any(len(str(v)) > 80 for v in kept.values()):
            raise UserError("an answer's words are too long")
        kept |= {key: _number(told, key) for key in ("from_s", "to_s")}
        questions.keep_answer(self._answers(name), kept, self.by or None)
        return {"questions": self.questions(name)}

    def snap(self, name: str, told: dict[str, Any]) -> dict[str, Any]:
        """The object's pose fitted to the images of a frame."""
        entry, pose = self._object(name), _pose(told)
        opened = self.opened(name)
        with opened.images() as images:
            if not 0 <= pose.frame < images.num_sets:
                raise UserError(f"there is no frame {pose.frame}")
        found = snap.snap(
            opened, entry, pose.frame, list(pose.rotation_vector), list(pose.translation)
        )
        return found.__dict__

    def read_surface(self, name: str) -> dict[str, Any]:
        """Where people are likely to touch the sequence's object."""
        return objects.read_surface(self.project, self._object(name))

    def surface(self, name: str, told: dict[str, Any]) -> dict[str, Any]:
        """Keep where people are likely to touch the object, for all sequences that have it."""
        vertices = told["vertices"]
        if not isinstance(vertices, list) or not all(type(v) is int for v in vertices):
            raise UserError("vertices are numbers of the mesh's")
        if any(not 0 <= v < _MOST for v in vertices):
            raise UserError("a vertex is not one of the mesh's")
        digest = str(told["digest"])
        saved = objects.save_surface(self.project, self._object(name), vertices, digest)
        self.project = load_project(self.settings)
        return saved

    def read_symmetry(self, name: str) -> dict[str, Any]:
        """How the sequence's object can be turned and look the same."""
        return objects.read_symmetry(self.project, self._object(name))

    def symmetry(self, name: str, told: dict[str, Any]) -> dict[str, Any]:
        """Keep the object's symmetry, for all sequences that have it."""
        wanted = told["symmetry"]
        if not isinstance(wanted, dict):
            raise UserError("symmetry is discrete, continuous or sphere")
        entry = self._object(name)
        saved = objects.save_symmetry(self.project, entry, wanted, str(told["digest"]))
        self.project = load_project(self.settings)
        return saved

    def _object(self, name: str) -> ObjectEntry:
        entry = self.project.object_of(self.opened(name).name)
        if entry is None:
            raise UserError(f"sequence {name!r} names no object")
        return entry

    def point(self, name: str, told: dict[str, Any]) -> dict[str, Any]:
        """The point of the room under a pixel."""
        opened = self.opened(name)
        frame, x, y = int(_number(told, "frame")), _number(told, "x"), _number(told, "y")
        with opened.images() as images:
            if not 0 <= frame < images.num_sets:
                raise UserError(f"there is no frame {frame}")
        return {"point": snap.point_under(opened, str(told["camera"]), frame, x, y)}

    def run(self, name: str, told: dict[str, Any]) -> dict[str, Any]:
        """Start, stop or look at a run."""
        wanted = told.get("do")
        project = self.project
        if wanted == "start":
            self.opened(name)
            self.project.annotation(name)
            self.runs.start(project, name)
        elif wanted == "stop":
            self.runs.stop()
        return self.run_state(name)

    def run_state(self, name: str) -> dict[str, Any]:
        """The run's progress, and the command that does the same."""
        self.opened(name)
        told = rerun.command(self.project, name, cores=self.runs.cores, profile=self.runs.profile)
        progress = self.runs.progress(self.project)
        return progress | {"command": shlex.join(told), "cluster": self.runs.profile is not None}

    def _answers(self, name: str) -> Path:
        return questions.answers_path(self.project.annotation_path(name))

    def _edited(
        self, name: str, now: document.Document, changes: dict[str, Any]
    ) -> tuple[list[dict[str, str]], str]:
        """What is wrong with the annotation when it is changed, and the file's text then."""
        if now.problem:
            return [{"where": "file", "words": now.problem}], now.text
        sections = document.sections_with(now, changes)
        faults = document.faults(sections)
        faults = faults or self._faults(name, Annotation.model_validate(sections))
        if faults:
            return faults, now.text
        text = document.patched(now, changes)
        # an entry that stays as it is written may be wrong by its form alone: 12.0 is no frame
        return document.faults(document.parsed(text)), text

    def _faults(self, name: str, annotation: Annotation) -> list[dict[str, str]]:
        """What the recording says against an annotation."""
        told = [annotation.check_object(self.project.sequences[name].object)]
        recorded = self.project.recording_extent(name)
        told.append(
            annotation.check_recording(recorded)
            if recorded
            else fault_of_cameras(self.project, name, annotation)
        )
        return [{"where": words.partition(".")[0].partition("[")[0].split(" ")[0], "words": words}
                for words in told if words]  # fmt: skip


def _number(told: dict[str, Any], key: str) -> float:
    value = told.get(key)
    if not isinstance(value, int | float) or not -_MOST < value < _MOST:
        raise UserError(f"{key} is to be a number")
    return float(value)


def told_of(found: document.Document) -> dict[str, Any]:
    """An annotation file as the page is told of it."""
    return {
        "path": str(found.path), "text": found.text, "digest": found.digest,
        "sections": found.sections, "problem": found.problem, "note": found.note,
    }  # fmt: skip


def _changes(told: dict[str, Any]) -> dict[str, Any]:
    changes = told.get("changes")
    if not isinstance(changes, dict):
        raise UserError("changes are sections by name")
    return changes


def _pose(told: dict[str, Any]) -> ObjectPose:
    faults = document.faults({"object_poses": [told]})
    if faults:
        raise UserError(f"{faults[0]['where']}: {faults[0]['words']}")
    return ObjectPose.model_validate(told)


class SequenceList:
    """Rows of all sequences; a summary is read again only where it is another file."""

    def __init__(self) -> None:
        self._known: dict[Path, tuple[tuple[int, int], SequenceMetrics | str]] = {}

    def rows(self, project: Project) -> list[dict[str, Any]]:
        """A row a sequence, worst first by the report's own rank, those without a result last."""
        rows, measured = [], []
        for name, row in project.sequences.items():
            found = self._summary(project.artefact(name, "summary"))
            annotation = project.annotation_path(name)
            one: dict[str, Any] = {
                "name": name, "subject": row.subject, "object": row.object or "", "rank": None,
                "annotated": annotation.is_file(),
                "answered": answers_path(annotation).is_file(),
                "frames_there": project.artefact(name, "frames").is_file(),
                "note": found if isinstance(found, str) else "",
            }  # fmt: skip
            if isinstance(found, SequenceMetrics):
                measured.append(found)
                one |= {
                    "frames": len(found),
                    "flagged": int(found.values["flagged"].sum()),
                    "errors": {
                        e.part: round(e.stated, 1) if e.stated == e.stated else None
                        for e in stated_errors(found)
                    },
                }
            rows.append(one)
        if measured:
            table = sequence_table(measured, {})
            ranks = dict(zip(table["sequence"], table["rank"], strict=True))
            for one in rows:
                one["rank"] = int(ranks[one["name"]]) if one["name"] in ranks else None
        return sorted(rows, key=lambda one: (one["rank"] is None, one["rank"] or 0))

    def _summary(self, path: Path) -> SequenceMetrics | str:
        """A sequence's figures, or why there are none."""
        try:
            stat = path.stat()
        except OSError:
            return "no result yet"
        stamp = stat.st_mtime_ns, stat.st_size
        known = self._known.get(path)
        if known is None or known[0] != stamp:
            try:
                with artefacts.read(path, SUMMARY) as artefact:
                    known = stamp, SequenceMetrics.of(artefact)
            except UserError as error:
                known = stamp, str(error)
            self._known[path] = known
        return known[1]
