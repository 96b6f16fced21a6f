"""Invalid input: one error message, no lost results, and the other sequences continue."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from intercap_core import artefacts
from intercap_core.schemas import FRAMES
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


def good_recordings(lab: Flow, flow: Flow) -> Path:
    """Put readable recordings in the place of the unreadable ones."""
    folder = lab.folder / "captures" / OTHER
    for path in folder.glob("*.mkv"):
        shutil.copy2(flow.results / "recordings" / OTHER / path.name, path)
    return folder


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


Break = Callable[[Path], object]


def cut_in_half(folder: Path) -> None:
    path = folder / "k2.mkv"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def without_calibration(*cameras: str) -> Break:
    def rename_attachment(folder: Path) -> None:
        for camera in cameras:
            path = folder / f"{camera}.mkv"
            data = path.read_bytes()
            for name in (b"calibration.json", b"K4A_CALIBRATION_FILE"):
                assert name in data
                data = data.replace(name, name[:-1] + b"X")
            path.write_bytes(data)

    return rename_attachment


@pytest.mark.parametrize(
    ("damage", "camera", "present", "note"),
    [
        (cut_in_half, "k2", True, "cut off"),
        (lambda folder: (folder / "k1.mkv").unlink(), "k1", False, "no recording of k1"),
    ],
)
def test_one_bad_camera_is_survived_and_flagged(
    lab: Flow, flow: Flow, damage: Break, camera: str, present: bool, note: str
) -> None:
    damage(good_recordings(lab, flow))
    done = lab.intercap("frames", lab.settings, OTHER)
    assert done.returncode == 0, done.stderr
    with artefacts.read(lab.artefact(OTHER, "frames"), FRAMES) as source:
        index = source.text("camera_names").index(camera)
        assert source["present"][index] == present
        assert note in source.text("note")[index]
        assert (source["colour_index"] >= 0).any(axis=0).sum() >= 2


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (without_calibration("k1", "k2", "k3"), ["no camera in", "calibration"]),
        (lambda folder: (folder / "calibration.json").unlink(), ["calibration.json"]),
    ],
)
def test_recordings_that_cannot_be_used(
    lab: Flow, flow: Flow, damage: Break, says: list[str]
) -> None:
    damage(good_recordings(lab, flow))
    done = lab.intercap("frames", lab.settings, OTHER)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    for part in says:
        assert part in done.stderr
    assert not lab.artefact(OTHER, "frames").exists()


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("sequences.tsv", "\tcup\t", "\tmug\t", ["object 'mug'"]),
        ("sequences.tsv", "\ts04\t", "\ts99\t", ["subject 's99'"]),
        ("sequences.tsv", f"{OTHER}\t", "../x\t", ["line 3", "'../x'"]),
        ("sequences.tsv", f"{OTHER}\t", "a/b\t", ["line 3", "'a/b'"]),
        ("config.yaml", "dataset", "joint: {weight: 1}\ndataset", ["joint.weight"]),
        ("config.yaml", "dataset", "body_models: {female: X.npz}\ndataset", ["X.npz", "no such"]),
    ],
)
def test_a_wrong_table_stops_before_any_job(
    lab: Flow, file: str, old: str, new: str, says: list[str]
) -> None:
    path = lab.folder / "config" / "lab" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    before = computed(lab, ONE)
    done = lab.run() if says == ["object 'mug'"] else lab.ask()
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if f"config/lab/{file}" in line]
    assert len(lines) == 1
    for part in says:
        assert part in lines[0]
    assert "Job" not in done.stderr
    assert computed(lab, ONE) == before


def test_an_invalid_annotation_keeps_the_results(lab: Flow) -> None:
    path = lab.annotation(ONE)
    path.parent.mkdir(exist_ok=True)
    path.write_text("contact: [{part: seat, start: 4, end: 99}]\n")
    before = computed(lab, ONE)
    done = lab.run(str(lab.artefact(ONE, "metrics").relative_to(lab.folder)))
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
    whole = {stage: lab.artefact(ONE, stage).read_bytes() for stage in STAGES}
    data = bytearray(path.read_bytes())
    for at in range(len(data) // 4, len(data), 97):  # behind the HDF5 metadata
        data[at] ^= 0x5A
    path.write_bytes(bytes(data))
    failed = lab.intercap("body-fit", lab.settings, ONE)
    assert failed.returncode == 1 and "Traceback" not in failed.stderr
    assert "person.h5" in failed.stderr and "re-run stage 'person'" in failed.stderr
    status = lab.intercap("status", lab.settings).stdout
    assert f"person out of date in {ONE}: what it was made from is not recorded, or" in status
    assert lab.intercap("verify", lab.settings).returncode == 1
    done = lab.run(str(lab.artefact(ONE, "metrics").relative_to(lab.folder)))
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert {stage: lab.artefact(ONE, stage).read_bytes() for stage in whole} == whole
    assert not list(lab.results.rglob(".*.part")) and not list(lab.results.rglob(".*.lease"))
