"""Requests of the annotation page: reading and changing a project."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import shlex
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

from starlette.exceptions import HTTPException

from intercap_core import artefacts
from intercap_core.annotate import document, objects, questions, rerun, result, snap
from intercap_core.annotate.before import Backup
from intercap_core.annotate.edits import list_edits
from intercap_core.annotate.opened import NO_FILE, Opened, object_of, stamp_of
from intercap_core.annotation import Annotation, ObjectPose
from intercap_core.commands.check import fault_of_cameras
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import stated_errors
from intercap_core.output.site.tables import sequence_table
from intercap_core.project import load_project
from intercap_core.schemas import CONTACT_REGIONS, SUMMARY

_LARGEST = 1e9  # largest number that the page may send
_OPEN_SEQUENCES = 6  # sequences whose files stay open; current and previous results count apart


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
        self.runs = rerun.RunManager(cores=cores, profile=profile)
        self._summary = functools.lru_cache(maxsize=10_000)(_read_summary)
        self._opened: OrderedDict[str, Opened] = OrderedDict()
        self._lock = threading.Lock()

    # --- reading -------------------------------------------------------------------------------

    def sequences(self) -> dict[str, Any]:
        """Read the project again and return the table of sequences."""
        self.project = load_project(self.settings)
        rows = self._rows()
        return {"dataset": self.project.config.dataset, "by": self.by, "sequences": rows}

    def _rows(self) -> list[dict[str, Any]]:
        """Return a row per sequence, worst first as on the site, then those without a result.

        A summary is read again only if its file changed.
        """
        rows, measured = [], []
        for name, row in self.project.sequences.items():
            path = self.project.artefact(name, "summary")
            summary = self._summary(path, stamp_of(path))
            entry: dict[str, Any] = {
                "name": name, "subject": row.subject, "object": row.object or "", "rank": None,
                "annotated": self.project.annotation_path(name).is_file(),
                "note": summary if isinstance(summary, str) else "",
            }  # fmt: skip
            if isinstance(summary, SequenceMetrics):
                measured.append(summary)
                entry |= {
                    "frames": len(summary),
                    "flagged": summary.values["flagged"].sum(axis=0).tolist(),  # by part
                    "errors": {
                        e.part: round(e.stated, 1) if e.stated == e.stated else None
                        for e in stated_errors(summary)
                    },
                }
            rows.append(entry)
        if measured:
            table = sequence_table(measured, {})
            ranks = dict(zip(table["sequence"], table["rank"], strict=True))
            for entry in rows:
                entry["rank"] = int(ranks[entry["name"]]) if entry["name"] in ranks else None
        return sorted(rows, key=lambda entry: (entry["rank"] is None, entry["rank"] or 0))

    def opened(self, name: str, version: str = "now") -> Opened:
        """Return a sequence's artefacts: the present ones ("now") or the backup ("before").

        Raises HTTPException if the table has no such sequence.
        """
        if name not in self.project.sequences or version not in ("now", "before"):
            raise HTTPException(404, f"there is no sequence {name[:80]!r} in the table")
        key = f"{version}/{name}"
        with self._lock:
            if key not in self._opened:
                paths = Backup(self.project, name).paths if version == "before" else None
                self._opened[key] = Opened(self.project, name, paths)
            self._opened.move_to_end(key)
            while len(self._opened) > _OPEN_SEQUENCES:
                self._opened.popitem(last=False)[1].close()
            return self._opened[key]

    def sequence(self, name: str) -> dict[str, Any]:
        """Return everything that the page shows of a sequence, except images and meshes."""
        opened = self.opened(name)
        try:
            if not opened.has("frames"):
                run = shlex.join(["intercap", "run", str(self.settings), "--", "--until", "frames"])
                raise UserError(f"no images of this recording have been read: run it, or `{run}`")
            description = result.describe(opened)
        except UserError as error:  # shown in the page, from which a run can read the images again
            description = {
                "sequence": name, "frames": 0, "notes": [str(error)], "result": opened.stamp(),
            }  # fmt: skip
        row = self.project.sequences[name]
        return description | {
            "object": row.object or "",
            "person": row.subject,
            "annotation": self.annotation(name),
            "regions": list(CONTACT_REGIONS),
            "read_only": "the studio writes this annotation together with the recording"
            if self.project.annotation_made(name)
            else document.locked(self.project.annotation_path(name)),
            "profile": str(self.runs.profile or ""),
            "uncertainty_frames": self.project.config.joint.annotation_uncertainty_frames,
            "project": hashlib.sha256(str(self.settings.resolve()).encode()).hexdigest()[:16],
        }

    def annotation(self, name: str) -> dict[str, Any]:
        """Return the annotation file."""
        return document.read(self.project.annotation_path(name)).to_json()

    def state(self, name: str) -> dict[str, Any]:
        """Return stamps by which an open page notices changed annotations or results."""
        annotation = document.read(self.project.annotation_path(name))
        return {"annotation": annotation.digest, "result": self.opened(name).stamp()}

    def compare(self, name: str) -> dict[str, Any]:
        """Compare the result with the one before the last run, and with the annotation."""
        comparison = Backup(self.project, name).compare()
        with contextlib.suppress(UserError):  # an annotation with faults
            annotation = self.project.annotation(name)
            comparison["edits"] = list_edits(self.opened(name), annotation)
        return comparison

    def questions(self, name: str) -> list[dict[str, Any]]:
        """Return open questions, those with the largest effect first."""
        answered = questions.read_answers(self._answers(name))
        return questions.propose(self.opened(name), answered)

    # --- changing ------------------------------------------------------------------------------

    def check(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Return faults of changed sections, the difference in the file, and stale stages."""
        now = document.read(self.project.annotation_path(name))
        changes = _changes(request)
        faults, text = self._edited(name, now, changes)
        answer: dict[str, Any] = {"faults": faults, "digest": now.digest, "difference": ""}
        if faults:
            return answer
        answer["difference"] = document.difference(now.text, text, now.path.name)
        if request.get("plan"):
            annotation = Annotation.model_validate(document.parsed(text))
            edited = rerun.EditedProject.of(self.project, name, annotation)
            answer["stale"] = rerun.stale_stages(edited, name)
        return answer

    def save(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Save changed sections if the file is still the one that the page has read."""
        if self.project.annotation_made(name):
            raise UserError("the studio writes this annotation; it cannot be changed here")
        now = document.read(self.project.annotation_path(name))
        changes = _changes(request)
        if now.digest != request.get("digest"):
            base = str(request.get("text", ""))
            raise document.Changed(now, document.difference(base, now.text, now.path.name))
        faults, text = self._edited(name, now, changes)
        if faults:
            raise UserError("; ".join(f"{fault['where']}: {fault['message']}" for fault in faults))
        saved = document.save(now, text)
        if self.by:
            record = {"kind": "saved", "sections": sorted(changes)}
            with contextlib.suppress(OSError):  # the annotation itself is saved
                questions.keep_answer(self._answers(name), record, self.by)
        return saved.to_json()

    def answer(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Save an answer, so that its question is not asked again."""
        keys = ("kind", "part", "answer", "first", "last", "frame")
        record = {key: request.get(key) for key in keys}
        if any(v is not None and not isinstance(v, str | int) for v in record.values()):
            raise UserError("an answer may have texts and frame numbers only")
        if any(len(str(v)) > 80 for v in record.values()):
            raise UserError("a text of the answer is longer than 80 characters")
        record |= {key: _number(request, key) for key in ("from_s", "to_s")}
        questions.keep_answer(self._answers(name), record, self.by or None)
        return {"questions": self.questions(name)}

    def snap(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Fit the object's pose to the images of a frame."""
        opened, pose = self.opened(name), _pose(request)
        _check_frame(opened, pose.frame)
        return snap.snap(opened, object_of(self.project, name), pose)

    def point(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Return the 3D point at a pixel."""
        opened = self.opened(name)
        frame, x, y = int(_number(request, "frame")), _number(request, "x"), _number(request, "y")
        _check_frame(opened, frame)
        return {"point": snap.point_under(opened, str(request["camera"]), frame, x, y)}

    def read_surface(self, name: str) -> dict[str, Any]:
        """Return the vertices of likely contact of the sequence's object."""
        return objects.read_surface(self.project, object_of(self.project, name))

    def surface(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Save the vertices of likely contact of the object, for all of its sequences."""
        vertices = request["vertices"]
        if not isinstance(vertices, list) or not all(type(v) is int for v in vertices):
            raise UserError("vertices must be a list of vertex numbers")
        if any(not 0 <= v < _LARGEST for v in vertices):
            raise UserError("a vertex number is outside of the mesh")
        entry, digest = object_of(self.project, name), str(request["digest"])
        saved = objects.save_surface(self.project, entry, vertices, digest)
        self.project = load_project(self.settings)
        return saved

    def read_symmetry(self, name: str) -> dict[str, Any]:
        """Return the symmetry of the sequence's object."""
        return objects.read_symmetry(self.project, object_of(self.project, name))

    def symmetry(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Save the object's symmetry, for all of its sequences."""
        symmetry, digest = request["symmetry"], str(request["digest"])
        if not isinstance(symmetry, dict):
            raise UserError("symmetry must be discrete, continuous or sphere")
        entry = object_of(self.project, name)
        saved = objects.save_symmetry(self.project, entry, symmetry, digest)
        self.project = load_project(self.settings)
        return saved

    def run(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        """Start or stop a run; return its state."""
        if request.get("do") == "start":
            self.project.annotation(name)
            self.runs.start(self.project, name)
        elif request.get("do") == "stop":
            self.runs.stop()
        return self.run_state(name)

    def run_state(self, name: str) -> dict[str, Any]:
        """Return the run's progress, and the equivalent command."""
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
            return [{"where": "file", "message": now.problem}], now.text
        text = document.patched(now, changes)
        sections = document.parsed(text)
        faults = document.faults(sections)
        return faults or self._contradictions(name, Annotation.model_validate(sections)), text

    def _contradictions(self, name: str, annotation: Annotation) -> list[dict[str, str]]:
        """Return contradictions between an annotation and the recording.

        ``where`` is the section, which begins each message, such as "contact" of "contact[2].end".
        """
        recorded = self.project.recording_extent(name)
        messages = [
            annotation.check_object(self.project.sequences[name].object),
            annotation.check_recording(recorded)
            if recorded
            else fault_of_cameras(self.project, name, annotation),
        ]
        return [
            {"where": message.partition(".")[0].partition("[")[0].split(" ")[0], "message": message}
            for message in messages
            if message
        ]


def _number(request: dict[str, Any], key: str) -> float:
    value = request.get(key)
    if not isinstance(value, int | float) or not -_LARGEST < value < _LARGEST:
        raise UserError(f"{key} must be a number")
    return float(value)


def _changes(request: dict[str, Any]) -> dict[str, Any]:
    changes = request.get("changes")
    if not isinstance(changes, dict):
        raise UserError("changes must be sections by name")
    return changes


def _pose(request: dict[str, Any]) -> ObjectPose:
    faults = document.faults({"object_poses": [request]})
    if faults:
        raise UserError(f"{faults[0]['where']}: {faults[0]['message']}")
    return ObjectPose.model_validate(request)


def _check_frame(opened: Opened, frame: int) -> None:
    with opened.images() as images:
        if not 0 <= frame < images.num_sets:
            raise UserError(f"there is no frame {frame}")


def _read_summary(path: Path, stamp: str) -> SequenceMetrics | str:
    """Return a sequence's figures, or why there are none; the stamp is that of the file."""
    if stamp == NO_FILE:
        return "no result yet"
    try:
        with artefacts.read(path, SUMMARY) as artefact:
            return SequenceMetrics.of(artefact)
    except UserError as error:
        return str(error)
