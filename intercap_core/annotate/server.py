"""The page's server: what it shows as JSON, JPEG and arrays, and what it may ask to be done."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import shlex
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from intercap_core.annotate import (
    before,
    document,
    questions,
    rerun,
    result,
    sides,
    snap,
    surface,
    symmetry,
)
from intercap_core.annotate.guard import App, Guard
from intercap_core.annotate.images import Pictures
from intercap_core.annotate.opened import Opened
from intercap_core.annotate.sequences import SequenceList
from intercap_core.commands.check import fault_of_cameras
from intercap_core.config import Annotation, ObjectEntry, ObjectPose
from intercap_core.errors import UserError
from intercap_core.project import load_project
from intercap_core.schemas import CONTACT_REGIONS
from intercap_core.viewer.package import DATA as VIEWER

PAGE = Path(__file__).parent / "page"
_MOST = 1e9  # of a number that a page tells
OPEN_SEQUENCES = 3  # with their images and meshes in memory
_KEEP = {
    "cache-control": "private, max-age=86400, immutable"
}  # of what has its stamp in its address


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
        return _told(found)

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
        return _told(saved)

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
        return surface.read_surface(self.project, self._object(name))

    def surface(self, name: str, told: dict[str, Any]) -> dict[str, Any]:
        """Keep where people are likely to touch the object, for all sequences that have it."""
        vertices = told["vertices"]
        if not isinstance(vertices, list) or not all(type(v) is int for v in vertices):
            raise UserError("vertices are numbers of the mesh's")
        if any(not 0 <= v < _MOST for v in vertices):
            raise UserError("a vertex is not one of the mesh's")
        digest = str(told["digest"])
        saved = surface.save_surface(self.project, self._object(name), vertices, digest)
        self.project = load_project(self.settings)
        return saved

    def read_symmetry(self, name: str) -> dict[str, Any]:
        """How the sequence's object can be turned and look the same."""
        return symmetry.read_symmetry(self.project, self._object(name))

    def symmetry(self, name: str, told: dict[str, Any]) -> dict[str, Any]:
        """Keep the object's symmetry, for all sequences that have it."""
        wanted = told["symmetry"]
        if not isinstance(wanted, dict):
            raise UserError("symmetry is discrete, continuous or sphere")
        entry = self._object(name)
        saved = symmetry.save_symmetry(self.project, entry, wanted, str(told["digest"]))
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
        recorded = self.project.recorded(name)
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


def _told(found: document.Document) -> dict[str, Any]:
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


# --- routes ----------------------------------------------------------------------------------


def application(annotator: Annotator, token: str) -> App:
    """The server of a project; every request under /api/ carries the ``token``."""

    def page(_: Request) -> Response:
        return FileResponse(PAGE / "index.html", headers={"cache-control": "no-cache"})

    def image(request: Request) -> Response:
        at = request.path_params
        width = int(request.query_params.get("width", "0") or 0)
        opened = annotator.opened(at["name"])
        data = annotator.pictures.jpeg(opened, at["camera"], at["frame"], width or 1 << 20)
        if data is None:
            raise HTTPException(404, "there is no image")
        kind = "image/png" if data[:4] == b"\x89PNG" else "image/jpeg"
        return Response(data, media_type=kind, headers=_KEEP)

    def arrays(made: Callable[[Opened], str]) -> Callable[[Request], Response]:
        def endpoint(request: Request) -> Response:
            version = request.query_params.get("version", "now")
            data = base64.b64decode(made(annotator.opened(request.path_params["name"], version)))
            return Response(data, media_type="application/octet-stream", headers=_KEEP)

        return endpoint

    def look(function: Callable[[str], Any]) -> Callable[[Request], Response]:
        def endpoint(request: Request) -> Response:
            name = request.path_params["name"]
            annotator.opened(name)
            return _json(function(name))

        return endpoint

    def change(function: Callable[[str, dict[str, Any]], Any]) -> Callable[..., Any]:
        async def endpoint(request: Request) -> Response:
            from starlette.concurrency import run_in_threadpool

            name = request.path_params["name"]
            annotator.opened(name)
            try:
                told = json.loads(await request.body())
            except (ValueError, RecursionError):
                told = None
            if not isinstance(told, dict):
                raise HTTPException(400, "expected a JSON object")
            return _json(await run_in_threadpool(function, name, told))

        return endpoint

    def beside(name: str) -> dict[str, Any]:
        return before.beside(annotator.project, name)

    of = "/api/sequences/{name}"
    squeezed = [Middleware(GZipMiddleware, compresslevel=6)]
    routes = [
        Route("/", page),
        Route("/sequence/{name}", page),
        Mount("/page", GZipMiddleware(StaticFiles(directory=PAGE), compresslevel=6)),
        Mount("/viewer", GZipMiddleware(StaticFiles(directory=VIEWER), compresslevel=6)),
        Route("/api/sequences", lambda _: _json(annotator.sequences()), middleware=squeezed),
        Route(of, look(annotator.sequence), middleware=squeezed),
        Route(f"{of}/annotation", look(annotator.annotation)),
        Route(f"{of}/state", look(annotator.state)),
        Route(f"{of}/questions", look(annotator.questions)),
        Route(f"{of}/run", look(annotator.run_state), methods=["GET"]),
        Route(f"{of}/beside", look(beside)),
        Route(f"{of}/surface", look(annotator.read_surface), methods=["GET"]),
        Route(f"{of}/symmetry", look(annotator.read_symmetry), methods=["GET"]),
        Route(f"{of}/image/{{camera}}/{{frame:int}}", image),
        Route(f"{of}/viewer", arrays(result.viewer_payload)),
        Route(f"{of}/object", arrays(result.object_payload)),
        Route(f"{of}/sides", arrays(sides.sides_payload)),
        *(
            Route(f"{of}/{verb}", change(getattr(annotator, verb)), methods=["POST"])
            for verb in ("check", "save", "answer", "snap", "point", "surface", "symmetry", "run")
        ),
    ]
    handlers: Any = {
        document.Changed: _changed,
        UserError: lambda _, error: _json({"error": str(error)}, 422),
        HTTPException: lambda _, error: _json({"error": error.detail}, error.status_code),
        KeyError: lambda _, error: _json({"error": f"{error} is missing"}, 400),
        ValueError: lambda _, error: _json({"error": f"not a number: {error}"}, 400),
        OSError: lambda _, error: _json({"error": str(error)}, 500),
        Exception: lambda _, error: _json({"error": f"unexpected {type(error).__name__}"}, 500),
    }
    return Guard(Starlette(routes=routes, exception_handlers=handlers), token)


def _changed(_: Request, error: Any) -> Response:
    told = {"error": str(error), "now": _told(error.now), "difference": error.difference}
    return _json(told, 409)


def _json(value: Any, status: int = 200) -> Response:
    return JSONResponse(value, status, headers={"cache-control": "no-store"})
