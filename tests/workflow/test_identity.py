"""The same recordings give the same bytes, whoever brings them and whatever else is known."""

from __future__ import annotations

from pathlib import Path

import pytest

from intercap_core.pipeline.provenance import FILE
from tests.helpers.flow import ONE, Flow

BEFORE_METRICS = (
    "frames",
    "detections",
    "scene",
    "person",
    "object_track",
    "body_fit",
    "joint",
)


@pytest.mark.parametrize("stage", BEFORE_METRICS)
def test_without_studio_and_truth_the_bytes_are_the_same(
    flow: Flow, recorded: Flow, stage: str
) -> None:
    assert flow.folder != recorded.folder
    first, second = flow.artefact(ONE, stage), recorded.artefact(ONE, stage)
    assert first.read_bytes() == second.read_bytes()


def test_exports_are_the_same(flow: Flow, recorded: Flow) -> None:
    def content(folder: Path) -> dict[str, bytes]:
        return {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*")
            # the record says that metrics had the truth
            if path.is_file() and path.name not in (".snakemake_timestamp", FILE)
        }

    first = content(flow.results / ONE / "export")
    assert len(first) > 4
    assert first == content(recorded.results / ONE / "export")


def test_artefacts_name_no_place(flow: Flow) -> None:
    for path in (flow.results / ONE).glob("*.h5"):
        assert str(flow.folder).encode() not in path.read_bytes(), path
