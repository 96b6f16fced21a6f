"""A small project with computed artefacts, and its page served on the loopback."""

from __future__ import annotations

import json
import shutil
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import uvicorn

from intercap_core.annotate.annotator import Annotator
from intercap_core.annotate.server import TOKEN_HEADER, LimitedProtocol, application
from intercap_core.person.sides import swap_sides
from tests.helpers import fitted_capture as fitted

NAME = "s01_o03"
TOKEN = "token-of-the-tests"


def small_project(folder: Path, total: int = 6) -> Path:
    """Settings of a project of one sequence, up to joint: a ball in the right hand."""
    (folder / "made").mkdir(parents=True)
    capture = fitted.make_capture(folder / "made", name=NAME, total=total)
    (folder / "project").mkdir()
    settings = fitted.write_project(folder / "project", capture, NAME)
    (folder / "project" / "annotations").mkdir()
    return settings


def copied(made: Path, folder: Path) -> Path:
    """Settings of a copy of the project in ``folder``, which a test may change."""
    shutil.copytree(made.parent, folder)
    path = folder / "config.yaml"
    path.write_text(f"dataset: trial\nresults: {folder / 'results'}\n")
    return path


def annotation(settings: Path) -> Path:
    """Where the sequence's annotation is, or would be."""
    return settings.parent / "annotations" / f"{NAME}.yaml"


def detect(settings: Path, exchanged: Mapping[str, Sequence[int]]) -> None:
    """Have the subject detected where it is, left for right in frames of some cameras; the stage
    person has exchanged them back."""
    with (
        h5py.File(artefact(settings, "person")) as person,
        h5py.File(artefact(settings, "detections"), "r+") as detections,
    ):
        for c, name in enumerate(person["camera_names"].asstr()):
            people = person["keypoints"][:, c]
            at = list(exchanged.get(name, ()))
            people[at] = swap_sides(people[at])
            detections[f"cameras/{name}/people"][...] = people


def artefact(settings: Path, stage: str) -> Path:
    """One of the sequence's artefacts."""
    return settings.parent / "results" / "trial" / NAME / f"{stage}.h5"


@dataclass
class Served:
    """A running server; requests carry what the page's own would."""

    annotator: Annotator
    port: int

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def get(self, path: str, **headers: str) -> tuple[int, bytes]:
        return self._ask(path, None, headers)

    def json(self, path: str) -> Any:
        status, body = self.get(f"/api/{path}")
        assert status == 200, body
        return json.loads(body)

    def post(self, path: str, content: Any) -> tuple[int, Any]:
        status, body = self._ask(f"/api/{path}", json.dumps(content).encode(), {})
        return status, json.loads(body)

    def _ask(self, path: str, data: bytes | None, headers: dict[str, str]) -> tuple[int, bytes]:
        own = {TOKEN_HEADER: TOKEN, "origin": self.address, **headers}
        request = urllib.request.Request(
            self.address + path, data, {k: v for k, v in own.items() if v}
        )
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            return error.code, error.read()


@contextmanager
def served(settings: Path, **options: Any) -> Iterator[Served]:
    """The page of a project, in a thread of its own."""
    annotator = Annotator(settings, **options)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        server = uvicorn.Server(
            uvicorn.Config(
                application(annotator, TOKEN), log_level="error", ws="none", http=LimitedProtocol
            )
        )
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.01)
        try:
            yield Served(annotator, listening.getsockname()[1])
        finally:
            server.should_exit = True
            thread.join(20)
