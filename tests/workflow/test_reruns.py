"""Stages that an edit re-runs in a finished project.

Most tests ask a Snakemake process that is already running; some start one as a user does.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from intercap_core import artefacts
from intercap_core.pipeline.provenance import Manifest, write_manifest
from tests.helpers.flow import ONE, OTHER, Flow

AFTER_METRICS = {"summary", "page", "export"}
AFTER_SCENE = {"scene", "person", "object_track", "body_fit", "joint", "metrics", *AFTER_METRICS}
DATASET = ("", "dataset")
CONTACT = "contact:\n- {part: right_hand, start: 1, end: 4}\n"
FLOOR = "floor: [[0.0, 1.0, 2.0], [1.0, 1.0, 2.0], [0.0, 1.0, 3.0]]\n"


@contextmanager
def edited(path: Path, text: str) -> Iterator[None]:
    """Write ``text`` within the block; afterwards restore or delete the file."""
    before = path.read_bytes() if path.exists() else None
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    try:
        yield
    finally:
        if before is None:
            path.unlink()
        else:
            path.write_bytes(before)


@contextmanager
def replaced(path: Path, old: str, new: str) -> Iterator[None]:
    text = path.read_text()
    assert old in text, f"{path} has no {old!r}"
    with edited(path, text.replace(old, new)):
        yield


def test_running_again_does_nothing(flow: Flow) -> None:
    assert flow.pending(new_process=True) == set()
    assert flow.pending() == set()
    done = flow.run()
    assert done.returncode == 0
    assert "Nothing to be done" in done.stderr


def test_touching_reruns_nothing(flow: Flow) -> None:
    for path in [*flow.results.rglob("*.h5"), *(flow.folder / "config").rglob("*.*")]:
        os.utime(path)
    assert flow.pending() == set()


@pytest.mark.parametrize(
    ("text", "stages"),
    [
        (CONTACT, {"joint", "metrics", *AFTER_METRICS}),
        (FLOOR, AFTER_SCENE),
        (
            "object_pose: {rotation_vector: [0, 0, 0], translation: [0, 0, 2]}\n",
            {"object_track", "joint", "metrics", *AFTER_METRICS},
        ),
        ("drop_frames: [2]\n", {"frames", "detections", *AFTER_SCENE}),
        (
            "subject: [{camera: k1, frame: 0, x: 612, y: 340}]\n",
            {"person", "object_track", "body_fit", "joint", "metrics", *AFTER_METRICS},
        ),
        ("# nothing yet\ncontact:\n", set()),
    ],
)
def test_a_new_annotation_reruns_from_the_stage_that_reads_it(
    flow: Flow, text: str, stages: set[str]
) -> None:
    with edited(flow.annotation(OTHER), text):
        pending = flow.pending()
    assert pending == {(OTHER, stage) for stage in stages} | ({DATASET} if stages else set())


def test_several_targets_are_remade_after_an_edit(flow: Flow) -> None:
    targets = [
        str(flow.artefact(ONE, stage).relative_to(flow.folder)) for stage in ("joint", "summary")
    ]
    with edited(flow.annotation(ONE), CONTACT):
        done = flow.run("--dry-run", *targets)
    assert done.returncode == 0, done.stderr[-3000:]
    jobs = re.findall(r"^(\w+) +1$", done.stdout + done.stderr, re.MULTILINE)
    assert set(jobs) == {"joint", "metrics", "summary"}


def test_a_section_reruns_only_its_own_stages(flow: Flow) -> None:
    """Contact and floor are annotated; then one of them is edited, or both are reordered."""
    path = flow.annotation(OTHER)
    with edited(path, CONTACT + FLOOR):
        flow.rewrite_manifests()
        path.write_text("# a comment, and the same content\n" + FLOOR + CONTACT)
        assert flow.pending() == set()
        path.write_text(FLOOR + CONTACT.replace("end: 4", "end: 5"))
        contact = {(OTHER, stage) for stage in {"joint", "metrics", *AFTER_METRICS}}
        assert flow.pending() == contact | {DATASET}
        path.write_text(CONTACT + FLOOR.replace("2.0", "2.1"))
        assert flow.pending() == {(OTHER, stage) for stage in AFTER_SCENE} | {DATASET}
    flow.rewrite_manifests()  # back to no annotation
    assert flow.pending() == set()


@pytest.mark.parametrize(
    ("term", "stages"),
    [
        ("joint/terms/ground", {"joint"}),
        ("object_track/smooth", {"object_track", "joint"}),
        ("body_fit/problem", {"body_fit", "joint"}),
    ],
)
def test_editing_a_term_reruns_the_stages_that_reach_it(
    flow: Flow, term: str, stages: set[str]
) -> None:
    path = flow.folder / "intercap_core" / f"{term}.py"
    with edited(path, path.read_text() + "\nEDITED = 1\n"):
        pending = {rule for _, rule in flow.pending(new_process=term == "joint/terms/ground")}
    assert pending == stages | {"metrics", *AFTER_METRICS, "dataset"}


def test_rewording_a_docstring_reruns_nothing(flow: Flow) -> None:
    path = flow.folder / "intercap_core" / "joint" / "terms" / "ground.py"
    with edited(path, "# a comment\n" + path.read_text().replace('"""', '"""Reworded: ', 1)):
        assert flow.pending() == set()


def test_a_setting_reruns_its_own_stage(flow: Flow) -> None:
    path = flow.folder / flow.settings
    settings = yaml.safe_load(path.read_text())
    with edited(path, yaml.safe_dump({**settings, "page": {"frames": 2}})):
        # the site's first page lists settings that differ from the defaults
        assert flow.pending() == {(name, "page") for name in (ONE, OTHER)} | {DATASET}
    with edited(path, yaml.safe_dump({**settings, "joint": {"ground_weight": 2.0}})):
        rules = {"joint", "metrics", *AFTER_METRICS}
        after = {(name, rule) for name in (ONE, OTHER) for rule in rules}
        assert flow.pending() == after | {DATASET}


def test_another_model_reruns_the_detections(flow: Flow) -> None:
    """A model counts by its content, not by its path."""
    path, model = flow.folder / flow.settings, flow.folder / "config" / "test" / "model.onnx"
    settings = yaml.safe_load(path.read_text())
    text = yaml.safe_dump({**settings, "detections": {"segmentation_model": model.name}})
    expected = {(name, rule) for name in (ONE, OTHER) for rule in {"detections", *AFTER_SCENE}}
    with edited(model, "one"), edited(path, text):
        assert flow.pending() == expected | {DATASET}
        flow.rewrite_manifests()
        assert flow.pending() == set()
        model.write_text("another")
        assert flow.pending() == expected | {DATASET}
    flow.rewrite_manifests()


def test_moved_results_stay_up_to_date(flow: Flow) -> None:
    """Edits are found without Snakemake's bookkeeping and with other dates of files."""
    bookkeeping, aside = flow.folder / ".snakemake", flow.folder / "aside"
    bookkeeping.rename(aside)
    elsewhere = flow.folder / "elsewhere"
    shutil.copytree(flow.results, elsewhere, copy_function=shutil.copy)
    flow.results.rename(flow.folder / "here")
    elsewhere.rename(flow.results)
    try:
        assert flow.pending() == set()
        path = flow.folder / flow.settings
        settings = yaml.safe_load(path.read_text())
        with edited(path, yaml.safe_dump({**settings, "page": {"frames": 3}})):
            assert flow.pending() == {(name, "page") for name in (ONE, OTHER)} | {DATASET}
        with edited(flow.annotation(OTHER), CONTACT):
            stages = {"joint", "metrics", *AFTER_METRICS}
            assert flow.pending() == {(OTHER, stage) for stage in stages} | {DATASET}
    finally:
        shutil.rmtree(flow.results)
        shutil.rmtree(bookkeeping, ignore_errors=True)
        (flow.folder / "here").rename(flow.results)
        aside.rename(bookkeeping)


def test_a_deleted_output_is_remade_though_later_ones_exist(flow: Flow) -> None:
    path = flow.artefact(OTHER, "metrics")
    aside = path.with_name("aside")
    path.rename(aside)
    pending = flow.pending()
    aside.rename(path)
    assert (OTHER, "metrics") in pending
    assert pending <= {(OTHER, stage) for stage in {"metrics", *AFTER_METRICS}}
    assert flow.pending() == set()


def test_a_restored_result_of_other_settings_is_stale(flow: Flow) -> None:
    """The file is newer than all later outputs, as after a job that outlived its run."""
    path = flow.artefact(ONE, "scene")
    whole = path.read_bytes()
    text = artefacts.made_from(path)
    record = Manifest.from_text(text)
    assert record is not None
    settings = {**record.given["settings"], "voxel_mm": 0.5}
    write_manifest(path, replace(record, given={**record.given, "settings": settings}))
    assert (ONE, "scene") in flow.pending()
    output = flow.intercap("status", flow.settings).stdout
    assert f"scene out of date in {ONE}: settings: voxel_mm 0.5 → none" in output
    path.write_bytes(whole)
    assert flow.pending() == set()


def test_another_processor_is_reported_and_reruns_nothing(flow: Flow) -> None:
    path = flow.artefact(ONE, "joint")
    whole = path.read_bytes()
    record = Manifest.from_text(artefacts.made_from(path))
    assert record is not None
    write_manifest(path, replace(record, machine={"device": "cuda", "cpu": "another"}))
    assert flow.pending() == set()
    output = flow.intercap("status", flow.settings).stdout
    assert "2 done of 2 sequences" in output
    assert "1 results were computed on another machine or device (cuda, another)" in output
    path.write_bytes(whole)


def test_another_seed_makes_another_recording(flow: Flow) -> None:
    with replaced(flow.folder / flow.settings, "seed: 22", "seed: 23"):
        pending = flow.pending()
    assert {name for name, _ in pending} == {OTHER, ""}
    assert (OTHER, "studio") in pending
