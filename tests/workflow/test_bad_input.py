"""Invalid input: one error message, no lost results, and the other sequences continue."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator

import pytest

from tests.helpers.flow import ONE, OTHER, Flow

STAGES = ("frames", "detections", "scene", "person", "object_track", "body_fit", "joint", "metrics")


@pytest.fixture
def lab(recorded: Flow) -> Iterator[Flow]:
    """The run of the unreadable recordings, put back as it was after each test."""
    folders = [recorded.folder / name for name in ("captures", "config", "results")]
    kept = recorded.folder / "kept"
    for folder in folders:
        shutil.copytree(folder, kept / folder.name)
    yield recorded
    for folder in folders:
        shutil.rmtree(folder)
        shutil.copytree(kept / folder.name, folder)
    shutil.rmtree(kept)


def computed(flow: Flow, sequence: str) -> dict[str, bytes]:
    return {stage: flow.artefact(sequence, stage).read_bytes() for stage in STAGES}


def test_unreadable_recording_fails_only_its_sequence(recorded: Flow, flow: Flow) -> None:
    printed = recorded.transcript.read_text()
    line = next(line for line in printed.splitlines() if line.startswith(f"{OTHER}: frames"))
    assert "no camera in captures/cup_drink_s04 can be used" in line
    assert "Traceback" not in printed
    assert not (recorded.results / OTHER / "frames.h5").exists()
    assert all(recorded.artefact(ONE, stage).exists() for stage in STAGES)


def test_the_report_is_made_of_the_others_and_says_so(recorded: Flow) -> None:
    printed = recorded.transcript.read_text()
    assert f"the report leaves out {OTHER}" in printed
    assert str(recorded.results / "site" / "index.html") in printed
    summary = json.loads((recorded.results / "summary.json").read_text())
    assert summary["sequences"] == 1
    page = (recorded.results / "site" / "index.html").read_text()
    assert OTHER in page
    assert "no camera in captures" in page


def test_a_wrong_table_stops_before_any_job(lab: Flow) -> None:
    path = lab.folder / "config" / "lab" / "sequences.tsv"
    path.write_text(path.read_text().replace("\tcup\t", "\tmug\t"))
    before = computed(lab, ONE)
    done = lab.ask()
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "config/lab/sequences.tsv" in line]
    assert "object 'mug'" in line
    assert "Job" not in done.stderr
    assert computed(lab, ONE) == before


def test_an_invalid_annotation_keeps_the_results(lab: Flow) -> None:
    path = lab.annotation(ONE)
    path.parent.mkdir(exist_ok=True)
    path.write_text("contact: [{part: seat, start: 4, end: 99}]\n")
    before = computed(lab, ONE)
    done = lab.ask(str(lab.artefact(ONE, "metrics").relative_to(lab.folder)))
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    line = next(line for line in done.stderr.splitlines() if line.startswith(f"{ONE}: annotation"))
    assert f"config/lab/annotations/{ONE}.yaml" in line
    assert "contact[0].end is 99, the recording has" in line
    assert computed(lab, ONE) == before
    path.unlink()
    assert {pending for pending in lab.pending() if pending[0] == ONE} == set()


def test_a_run_replaces_a_damaged_artefact(lab: Flow) -> None:
    path = lab.artefact(ONE, "person")
    whole = computed(lab, ONE)
    data = bytearray(path.read_bytes())
    for at in range(len(data) // 4, len(data), 97):  # behind the HDF5 metadata
        data[at] ^= 0x5A
    path.write_bytes(bytes(data))
    assert lab.intercap("verify", lab.settings).returncode == 1
    done = lab.run(str(lab.artefact(ONE, "metrics").relative_to(lab.folder)))
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert computed(lab, ONE) == whole
    assert not list(lab.results.rglob(".*.part")) and not list(lab.results.rglob(".*.lease"))


def test_a_failed_stage_keeps_the_outputs_of_its_process(lab: Flow) -> None:
    module = lab.folder / "intercap_core" / "stages" / "person.py"
    whole = module.read_text()
    for stage in ("detections", "scene"):
        lab.artefact(ONE, stage).unlink()
    try:
        module.write_text(f"{whole}\n\ndef run(**_):\n    raise ValueError('nobody')\n")
        done = lab.run(str(lab.artefact(ONE, "person").relative_to(lab.folder)))
        assert done.returncode == 1
        assert f"{ONE}: person failed: unexpected ValueError: nobody" in done.stderr
    finally:
        module.write_text(whole)
    pending = {stage for name, stage in lab.pending() if name == ONE}
    assert "person" in pending and not pending & {"frames", "detections", "scene"}
