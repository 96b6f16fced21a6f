"""Requests of the annotation page: reading and changing a project."""

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
from intercap_core.annotation import Annotation, ObjectPose
from intercap_core.commands.check import fault_of_cameras
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import stated_errors
from intercap_core.output.site.tables import sequence_table
from intercap_core.project import Project, load_project
from intercap_core.schemas import CONTACT_REGIONS, SUMMARY

_MOST = 1e9  # largest number that a page may send
OPEN_SEQUENCES = 3  # whose images and meshes stay in memory


class Annotator:
    """A project that is being annotated.

    Args:
        settings: the project's config.yaml.
        by: name of the annotator, saved with answers.
        cores: number of cores of runs, 0 for all.
        profile: Snakemake profile of a cluster.
    """

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

    # --- reading -------------------------------------------------------------------------------

    def sequences(self) -> dict[str, Any]:
        """Return the table of sequences, which is read again."""
        self.project = load_project(self.settings)
        rows = self._list.rows(self.project)
        return {"dataset": self.project.config.dataset, "by": self.by, "sequences": rows}

    def opened(self, name: str, version: str = "now") -> Opened:
        """Return the sequence's artefacts, "now" or "before" the last run.

        Raises HTTPException if the table has no such sequence.
        """
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
        """Return everything but images and meshes."""
        opened = self.opened(name)
        if not opened.has("frames"):
            by_hand = shlex.join(["intercap", "run", str(self.settings), "--", "--until", "frames"])
            note = f"no images have been read of this recording yet: run it, or `{by_hand}`"
            found: dict[str, Any] = {
                "sequence": name, "frames": 0, "notes": [note], "result": opened.stamp(),
            }  # fmt: skip
        else:
            try:
                found = result.describe(opened)
            except UserError as error:  # a run can read the images again
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
            "read_only": "the studio writes this annotation together with the recording"
            if made
            else document.locked(self.project.annotation_path(name)),
            "profile": str(self.runs.profile or ""),
            "project": hashlib.sha256(str(self.settings.resolve()).encode()).hexdigest()[:16],
        }
        return found

    def annotation(self, name: str) -> dict[str, Any]:
        """Return the annotation file."""
        return document_to_json(document.read(self.project.annotation_path(name)))

    def state(self, name: str) -> dict[str, Any]:
        """Return stamps by which an open page notices changed annotations or results."""
        opened = self.opened(name)
        return {
            "annotation": document.read(self.project.annotation_path(name)).digest,
            "result": opened.stamp(),
        }

    def questions(self, name: str) -> list[dict[str, Any]]:
        """Return open questions, those with the largest effect first."""
        answered = questions.read_answers(self._answers(name))
        return questions.propose(self.opened(name), answered)

    # --- changing ------------------------------------------------------------------------------

    def check(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Return faults of changed sections, the difference in the file, and stages to re-run."""
        now = document.read(self.project.annotation_path(name))
        changes = _changes(request)
        faults, text = self._edited(name, now, changes)
        found: dict[str, Any] = {"faults": faults, "digest": now.digest, "difference": ""}
        if faults:
            return found
        found["difference"] = document.difference(now.text, text, now.path.name)
        if request.get("plan"):
            annotation = Annotation.model_validate(document.sections_with(now, changes))
            edited = rerun.EditedProject.of(self.project, name, annotation)
            found["touched"] = rerun.touched(edited, name)
        return found

    def save(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Save changed sections if the file is still the one that the page has read."""
        if self.project.annotation_made(name):
            raise UserError("the studio writes this annotation; it cannot be changed here")
        path = self.project.annotation_path(name)
        now = document.read(path)
        changes = _changes(request)
        if now.digest != request.get("digest"):
            base = str(request.get("text", ""))
            raise document.Changed(now, document.difference(base, now.text, path.name))
        faults, text = self._edited(name, now, changes)
        if faults:
            raise UserError("; ".join(f"{fault['where']}: {fault['words']}" for fault in faults))
        saved = document.save(now, text)
        if self.by:
            record = {"kind": "saved", "sections": sorted(changes)}
            with contextlib.suppress(OSError):  # the annotation itself is saved
                questions.keep_answer(self._answers(name), record, self.by)
        return document_to_json(saved)

    def answer(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Save an answer, so that its question is not asked again."""
        self.opened(name)
        kept = {
            key: request.get(key) for key in ("kind", "part", "answer", "first", "last", "frame")
        }
        if any(v is not None and not isinstance(v, str | int) for v in kept.values()):
            raise UserError("an answer may have texts and frame numbers only")
        if any(len(str(v)) > 80 for v in kept.values()):
            raise UserError("a text of the answer is longer than 80 characters")
        kept |= {key: _number(request, key) for key in ("from_s", "to_s")}
        questions.keep_answer(self._answers(name), kept, self.by or None)
        return {"questions": self.questions(name)}

    def snap(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Fit the object's pose to the images of a frame."""
        entry, pose = self._object(name), _pose(request)
        opened = self.opened(name)
        with opened.images() as images:
            if not 0 <= pose.frame < images.num_sets:
                raise UserError(f"there is no frame {pose.frame}")
        found = snap.snap(
            opened, entry, pose.frame, list(pose.rotation_vector), list(pose.translation)
        )
        return found.__dict__

    def read_surface(self, name: str) -> dict[str, Any]:
        """Return where people are likely to touch the sequence's object."""
        return objects.read_surface(self.project, self._object(name))

    def surface(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Save where people are likely to touch the object, for all of its sequences."""
        vertices = request["vertices"]
        if not isinstance(vertices, list) or not all(type(v) is int for v in vertices):
            raise UserError("vertices must be a list of vertex numbers")
        if any(not 0 <= v < _MOST for v in vertices):
            raise UserError("a vertex number is outside of the mesh")
        digest = str(request["digest"])
        saved = objects.save_surface(self.project, self._object(name), vertices, digest)
        self.project = load_project(self.settings)
        return saved

    def read_symmetry(self, name: str) -> dict[str, Any]:
        """Return the symmetry of the sequence's object."""
        return objects.read_symmetry(self.project, self._object(name))

    def symmetry(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Save the object's symmetry, for all of its sequences."""
        wanted = request["symmetry"]
        if not isinstance(wanted, dict):
            raise UserError("symmetry must be discrete, continuous or sphere")
        entry = self._object(name)
        saved = objects.save_symmetry(self.project, entry, wanted, str(request["digest"]))
        self.project = load_project(self.settings)
        return saved

    def _object(self, name: str) -> ObjectEntry:
        entry = self.project.object_of(self.opened(name).name)
        if entry is None:
            raise UserError(f"sequence {name!r} names no object")
        return entry

    def point(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Return the 3D point at a pixel."""
        opened = self.opened(name)
        frame, x, y = int(_number(request, "frame")), _number(request, "x"), _number(request, "y")
        with opened.images() as images:
            if not 0 <= frame < images.num_sets:
                raise UserError(f"there is no frame {frame}")
        return {"point": snap.point_under(opened, str(request["camera"]), frame, x, y)}

    def run(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Start or stop a run; return its state."""
        wanted = request.get("do")
        project = self.project
        if wanted == "start":
            self.opened(name)
            self.project.annotation(name)
            self.runs.start(project, name)
        elif wanted == "stop":
            self.runs.stop()
        return self.run_state(name)

    def run_state(self, name: str) -> dict[str, Any]:
        """Return the run's progress, and the equivalent command."""
        self.opened(name)
        command = rerun.command(
            self.project, name, cores=self.runs.cores, profile=self.runs.profile
        )
        cluster = self.runs.profile is not None
        progress = self.runs.progress(self.project)
        return progress | {"command": shlex.join(command), "cluster": cluster}

    def _answers(self, name: str) -> Path:
        return questions.answers_path(self.project.annotation_path(name))

    def _edited(
        self, name: str, now: document.Document, changes: dict[str, Any]
    ) -> tuple[list[dict[str, str]], str]:
        """Return faults of the changed annotation, and the file's changed text."""
        if now.problem:
            return [{"where": "file", "words": now.problem}], now.text
        sections = document.sections_with(now, changes)
        faults = document.faults(sections)
        faults = faults or self._faults(name, Annotation.model_validate(sections))
        if faults:
            return faults, now.text
        text = document.patched(now, changes)
        # an unchanged entry may have an invalid form, such as frame 12.0
        return document.faults(document.parsed(text)), text

    def _faults(self, name: str, annotation: Annotation) -> list[dict[str, str]]:
        """Return contradictions between an annotation and the recording."""
        faults = [annotation.check_object(self.project.sequences[name].object)]
        recorded = self.project.recording_extent(name)
        faults.append(
            annotation.check_recording(recorded)
            if recorded
            else fault_of_cameras(self.project, name, annotation)
        )
        return [{"where": words.partition(".")[0].partition("[")[0].split(" ")[0], "words": words}
                for words in faults if words]  # fmt: skip


def _number(request: dict[str, Any], key: str) -> float:
    value = request.get(key)
    if not isinstance(value, int | float) or not -_MOST < value < _MOST:
        raise UserError(f"{key} must be a number")
    return float(value)


def document_to_json(found: document.Document) -> dict[str, Any]:
    """Serialize an annotation file for the page."""
    return {
        "path": str(found.path), "text": found.text, "digest": found.digest,
        "sections": found.sections, "problem": found.problem, "note": found.note,
    }  # fmt: skip


def _changes(request: dict[str, Any]) -> dict[str, Any]:
    changes = request.get("changes")
    if not isinstance(changes, dict):
        raise UserError("changes must be sections by name")
    return changes


def _pose(request: dict[str, Any]) -> ObjectPose:
    faults = document.faults({"object_poses": [request]})
    if faults:
        raise UserError(f"{faults[0]['where']}: {faults[0]['words']}")
    return ObjectPose.model_validate(request)


class SequenceList:
    """Rows of all sequences; a summary is read again only if its file changed."""

    def __init__(self) -> None:
        self._known: dict[Path, tuple[tuple[int, int], SequenceMetrics | str]] = {}

    def rows(self, project: Project) -> list[dict[str, Any]]:
        """Return a row per sequence, worst first by the site's rank, without a result last."""
        rows, measured = [], []
        for name, row in project.sequences.items():
            found = self._summary(project.artefact(name, "summary"))
            annotation = project.annotation_path(name)
            entry: dict[str, Any] = {
                "name": name, "subject": row.subject, "object": row.object or "", "rank": None,
                "annotated": annotation.is_file(),
                "answered": answers_path(annotation).is_file(),
                "frames_there": project.artefact(name, "frames").is_file(),
                "note": found if isinstance(found, str) else "",
            }  # fmt: skip
            if isinstance(found, SequenceMetrics):
                measured.append(found)
                entry |= {
                    "frames": len(found),
                    "flagged": int(found.values["flagged"].sum()),
                    "errors": {
                        e.part: round(e.stated, 1) if e.stated == e.stated else None
                        for e in stated_errors(found)
                    },
                }
            rows.append(entry)
        if measured:
            table = sequence_table(measured, {})
            ranks = dict(zip(table["sequence"], table["rank"], strict=True))
            for entry in rows:
                entry["rank"] = int(ranks[entry["name"]]) if entry["name"] in ranks else None
        return sorted(rows, key=lambda entry: (entry["rank"] is None, entry["rank"] or 0))

    def _summary(self, path: Path) -> SequenceMetrics | str:
        """Return a sequence's figures, or why there are none."""
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
