"""Manifests: stored with the output, compared in words, damage detected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.artefact_schema import Field, Schema
from intercap_core.pipeline import stage_inputs
from intercap_core.pipeline.checksums import InputChecksums
from intercap_core.pipeline.provenance import (
    Manifest,
    file_digest,
    library_versions,
    read_manifest,
    write_manifest,
)
from intercap_core.project import load_project
from tests.conftest import PROJECT_ROOT

SCHEMA = Schema("x", 1, "x", {"a": Field(("T",), "float64", "numbers")}, {"gender": "of whom"})
MADE = Manifest(
    "joint", "s01", {"settings": {"weight": 1.0, "steps": 30}, "contact": None},
    {"object_": {"mesh/cup.ply": "ab:12"}}, {"frames": "f", "scene": "s"},
    {"energy": "e", "joint": "j"}, {"numpy": "2.1"}, {"cpu": "one", "device": "cpu"},
)  # fmt: skip


def _artefact(path: Path) -> Path:
    with artefacts.write(path, SCHEMA, gender="male") as writer:
        writer.put("a", np.arange(3.0))
    return path


def test_manifest_round_trip_keeps_the_artefact(tmp_path: Path) -> None:
    path = _artefact(tmp_path / "x.h5")
    assert read_manifest(path) is None
    write_manifest(path, MADE)
    assert read_manifest(path) == MADE
    with artefacts.read(path, SCHEMA) as artefact:
        assert "made_from" not in artefact.attributes and artefact["a"].tolist() == [0, 1, 2]
    write_manifest(path, replace(MADE, stage="other"))  # in place of the first
    found = read_manifest(path)
    assert found is not None and found.stage == "other"
    folder = tmp_path / "page"
    folder.mkdir()
    write_manifest(folder, MADE)
    assert read_manifest(folder) == MADE


def test_equal_inputs_give_equal_bytes(tmp_path: Path) -> None:
    one, two = (_artefact(tmp_path / name) for name in ("one.h5", "two.h5"))
    for path in (one, two):
        write_manifest(path, MADE)
    assert one.read_bytes() == two.read_bytes()


def test_machine_does_not_change_the_fingerprint() -> None:
    other = replace(MADE, machine={"cpu": "two", "device": "cuda"})
    assert other.fingerprint == MADE.fingerprint and other.to_text() != MADE.to_text()
    assert other.differences(MADE) == []


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"given": {"settings": {"weight": 2.0, "steps": 30}, "contact": None}},
         "settings: weight 1.0 → 2.0"),
        ({"given": {"settings": {"weight": 1.0, "steps": 30}, "contact": [{"part": "any"}]}},
         'annotation, contact: none → [{"part":"any"}]'),
        ({"files": {"object_": {"mesh/cup.ply": "cd:12"}}},
         "object's entry: mesh/cup.ply has another content"),
        ({"files": {"object_": {"mesh/cup.ply": "missing"}}},
         "object's entry: mesh/cup.ply is gone"),
        ({"code": {"energy": "E", "joint": "j"}}, "code of energy"),
        ({"libraries": {"numpy": "2.2"}}, "library numpy 2.1 → 2.2"),
        ({"artefacts": {"frames": "F", "scene": "s"}}, "frames changed"),
    ],
)  # fmt: skip
def test_differences_are_named(changed: dict, words: str) -> None:
    now = replace(MADE, **changed)
    assert now.fingerprint != MADE.fingerprint
    assert now.differences(MADE) == [words]


def test_changed_bytes_of_an_artefact_are_found_or_harmless(tmp_path: Path) -> None:
    """Attributes, records and values: no flipped bit gives another content without a word."""
    path = _artefact(tmp_path / "x.h5")
    long = replace(MADE, code={f"room{i}": "0123456789abcdef" for i in range(200)})
    write_manifest(path, long)
    whole = path.read_bytes()
    found = {"refused": 0, "same": 0}
    rng = np.random.default_rng(0)
    for place in range(0, len(whole), 17):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        try:
            with artefacts.read(path, SCHEMA) as artefact:
                content = (artefact.attributes["gender"], artefact["a"].tolist())
                units = artefact.describe("a")[2]
        except artefacts.Unreadable:
            found["refused"] += 1
            continue
        assert content == ("male", [0, 1, 2]) and units == "1", place
        assert read_manifest(path) in (None, long), place
        found["same"] += 1
    assert found["refused"] > 60


def test_a_damaged_record_is_none(tmp_path: Path) -> None:
    """Of long attributes HDF5 has no checksum."""
    path = _artefact(tmp_path / "x.h5")
    long = replace(MADE, code={f"room{i}": "0123456789abcdef" for i in range(5000)})
    write_manifest(path, long)
    whole = path.read_bytes()
    place = whole.index(b"0123456789abcdef", len(whole) // 2)
    path.write_bytes(whole[:place] + b"1" + whole[place + 1 :])
    assert read_manifest(path) is None
    path.write_bytes(whole)
    assert read_manifest(path) == long


def test_texts_lie_in_no_heap(tmp_path: Path) -> None:
    with h5py.File(_artefact(tmp_path / "x.h5"), "r") as file:
        for item in (file, file["a"]):
            for name in item.attrs:
                info = h5py.check_string_dtype(item.attrs.get_id(name).dtype)
                assert info is None or info.length is not None, name


def test_links_to_listed_files_are_not_read_again(tmp_path: Path) -> None:
    """The merged exports of a dataset link gigabytes of images that the exports' manifests list."""
    own, merged = tmp_path / "s01" / "export", tmp_path / "export"
    for folder in (own, merged):
        folder.mkdir(parents=True)
    for name in ("rgb.jpg", "same.jpg"):
        (own / name).write_text("as recorded")
    write_manifest(own, replace(MADE, stage="export"))
    listed = read_manifest(own)
    assert listed is not None and len(set(listed.outputs.values())) == 1
    (merged / "rgb.jpg").hardlink_to(own / "rgb.jpg")
    (merged / "copy.jpg").write_text("a copy")
    (own / "rgb.jpg").write_text("as damaged")  # verify finds it by either manifest
    write_manifest(tmp_path, replace(MADE, stage="dataset"))
    made = read_manifest(tmp_path)
    assert made is not None and made.outputs.keys() == {"export/rgb.jpg", "export/copy.jpg"}
    assert made.outputs["export/rgb.jpg"] == listed.outputs["rgb.jpg"]
    assert made.outputs["export/copy.jpg"] == f"{file_digest(merged / 'copy.jpg')}:6"


def test_libraries_that_decide_numbers_are_named() -> None:
    assert {"numpy", "numba", "torch"} <= set(library_versions())
    assert "+" not in "".join(library_versions().values())


@pytest.mark.parametrize(("settings", "stale"), [("detector/config", True), ("demo/config", False)])
def test_an_edited_detector_makes_its_recordings_stale(
    settings: str, stale: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "mediapipe_keypoints.py"
    monkeypatch.setattr(stage_inputs, "DETECTOR_SCRIPT", script)
    project = load_project(PROJECT_ROOT / f"config/{settings}.yaml")
    made = []
    for version in ("first", "second"):
        script.write_text(f"# {version}")
        checksums = InputChecksums(tmp_path / version)
        made.append(stage_inputs.studio_manifest(project, next(iter(project.sequences)), checksums))
    assert (made[0].fingerprint != made[1].fingerprint) == stale
    assert ("mediapipe_keypoints.py" in "".join(made[1].differences(made[0]))) == stale
