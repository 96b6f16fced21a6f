"""The recording, read by the reader of rerun-sdk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.evaluation.contact import vertex_contact
from intercap_core.geometry.camera.transforms import apply, rigid
from intercap_core.output.export.registry import formats
from intercap_core.schemas import JOINT, METRICS, SCENE
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted

chunks = pytest.importorskip("rerun.chunk")
Table = dict[str, dict[str, dict[int | None, Any]]]  # by entity, component and frame; None = static


@pytest.fixture(scope="module")
def path(lively: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = exported.run(lively, tmp_path_factory.mktemp("rrd") / "out", formats=["rrd"])
    return out / "rrd" / f"{exported.NAME}.rrd"


@pytest.fixture(scope="module")
def table(path: Path) -> Table:
    """All values of the recording."""
    result: Table = {}
    for chunk in chunks.RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        frames: list[int | None] = [None] * chunk.num_rows
        if not chunk.is_static:
            frames = batch["frame"].to_pylist()
            seconds = batch["time"].cast("int64").to_numpy() / 1e9
            assert seconds == pytest.approx(np.array(frames) / fitted.FPS, abs=1e-6)
        entity = result.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            component = entity.setdefault(name, {})
            for frame, value in zip(frames, batch[name].to_pylist(), strict=True):
                if value is not None:
                    component[frame] = value
    return result


def _points(table: Table, entity: str, component: str) -> dict[int | None, np.ndarray]:
    values = table[entity][component]
    return {frame: np.array(value, float).reshape(-1, 3) for frame, value in values.items()}


def test_body_and_object_agree_with_the_joint_result(
    table: Table, bodies: np.ndarray, lively: fitted.Capture, zup_from_master: np.ndarray
) -> None:
    expected = apply(zup_from_master, bodies.astype(float))
    read = _points(table, "/world/body", "Mesh3D:vertex_positions")
    assert sorted(read) == list(range(len(bodies)))
    for t, vertices in read.items():
        assert np.abs(vertices - expected[t]).max() < 1e-5
    faces = np.array(table["/world/body"]["Mesh3D:triangle_indices"][None])
    assert (faces == lively.model.faces.numpy()).all()

    (mesh,) = _points(table, "/world/object/mesh", "Mesh3D:vertex_positions").values()
    assert np.abs(mesh - lively.mesh.vertices).max() < 1e-6
    shifts = _points(table, "/world/object", "Transform3D:translation")
    turns = table["/world/object"]["Transform3D:mat3x3"]
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        poses = zup_from_master @ rigid(joint["rotation"], joint["translation"])
    for t, pose in enumerate(poses):
        turn = np.array(turns[t]).reshape(3, 3).T  # columns one after the other
        assert np.abs(apply(pose, lively.mesh.vertices) - (mesh @ turn.T + shifts[t])).max() < 1e-5


def test_touching_vertices_are_marked(table: Table, lively: fitted.Capture) -> None:
    with artefacts.read(lively.paths["metrics"], METRICS) as metrics:
        touching = vertex_contact(metrics["object_contact_distance"])
    marked = _points(table, "/world/object/mesh/contact", "Points3D:positions")
    for t, expected in enumerate(touching):
        assert marked[t] == pytest.approx(lively.mesh.vertices[expected], abs=1e-6)
    bodies = _points(table, "/world/body/contact", "Points3D:positions")
    assert len(bodies) == len(touching)


def test_images_are_small_pinholes_that_show_the_body(
    table: Table, lively: fitted.Capture, zup_from_master: np.ndarray
) -> None:
    with artefacts.read(lively.paths["scene"], SCENE) as scene:
        image_of = scene["image_of"]
    for c, camera in enumerate(lively.rig):
        entity = f"/world/cameras/{camera.name}"
        pose = zup_from_master @ camera.master_from_colour
        shift = np.ravel(table[entity]["Transform3D:translation"][None])
        assert shift == pytest.approx(pose[:3, 3], abs=1e-5)
        matrix = np.array(table[entity]["Pinhole:image_from_camera"][None]).reshape(3, 3).T
        assert matrix == pytest.approx(camera.colour.matrix, abs=1e-3)  # 480 columns: as recorded
        images = table[f"{entity}/image"]["EncodedImage:blob"]
        assert len(images) == (image_of[:, c] >= 0).sum()
        for packet in images.values():
            data = np.array(packet, np.uint8).ravel()
            assert cv2.imdecode(data, cv2.IMREAD_COLOR).shape == (270, 480, 3)


def test_errors_and_facts_are_in_it(table: Table, path: Path) -> None:
    about = json.loads(np.ravel(table["/about"]["TextDocument:text"][None])[0])
    assert about["up_axis"] == "z" and about["units"].startswith("metres")
    for part, errors in about["by_frame"]["stated_error_mm"].items():
        read = table[f"/errors/{part}"]["Scalars:scalars"]
        stated = {t: error for t, error in enumerate(errors) if error is not None}
        assert {t: round(float(np.ravel(value)[0]), 2) for t, value in read.items()} == stated
    assert about["by_frame"]["stated_error_mm"]
    assert path.stat().st_size < 5e6
    assert len(chunks.RrdReader(path).blueprints()) == 1


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"'rrd' needs the package rerun.*intercap-core\[rerun\]"):
        formats()["rrd"].require_library()
