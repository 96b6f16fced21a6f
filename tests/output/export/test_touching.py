"""Contact by vertex, deviations and the verdict, in every format that holds them."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.flags import Flags
from intercap_core.schemas import BODY_FIT, JOINT, METRICS, OBJECT_TRACK
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted
from tests.helpers.reduced_capture import Reduction

LIMIT_M = 0.0045
WITHIN_M = 2e-4  # of the limit, the two ways to measure may disagree


def _by_frame(offsets: np.ndarray, vertices: np.ndarray) -> list[set[int]]:
    return [set(np.asarray(vertices[a:b]).tolist()) for a, b in pairwise(offsets)]


@pytest.fixture(scope="module")
def touching(everything: Path) -> dict[str, list[set[int]]]:
    with np.load(everything / "contact" / "contact_vertices.npz") as content:
        return {
            name: _by_frame(content[f"{name}_contact_offsets"], content[f"{name}_contact_vertices"])
            for name in ("body", "object")
        }


def test_contact_vertices_agree_with_trimesh(
    capture: fitted.Capture, touching: dict[str, list[set[int]]], everything: Path
) -> None:
    with artefacts.read(capture.paths["joint"], JOINT) as joint:
        bodies, _ = exported.posed(capture.model, joint)
        rotation, translation = joint["rotation"], joint["translation"]
    with np.load(everything / "contact" / "contact_vertices.npz") as content:
        assert float(content["contact_threshold_m"]) == LIMIT_M
        distance = content["body_contact_distance"]
    assert min(len(entries) for entries in touching["body"]) > 5
    for t, body in enumerate(bodies):
        cup = trimesh.Trimesh(
            capture.mesh.vertices @ rotation[t].T + translation[t], capture.mesh.faces
        )
        near = np.flatnonzero(np.linalg.norm(body - cup.centroid, axis=1) < 0.15)
        signed = -trimesh.proximity.signed_distance(cup, body[near])  # trimesh: positive inside
        # skin also has to face the cup: the distance falls along its normal, outside and inside
        person = trimesh.Trimesh(body, capture.model.faces.numpy(), process=False)
        ahead = trimesh.proximity.closest_point(cup, body[near])[0] - body[near]
        ahead *= np.sign(signed)[:, None] / np.linalg.norm(ahead, axis=1, keepdims=True)
        facing = (person.vertex_normals[near] * ahead).sum(1)
        sure = set(near[(signed < LIMIT_M - WITHIN_M) & (facing > 0.35)].tolist())
        maybe = set(near[signed < LIMIT_M + WITHIN_M].tolist())
        assert sure <= touching["body"][t] <= maybe
        start = sum(len(entries) for entries in touching["body"][:t])
        own = dict(zip(near.tolist(), signed.tolist(), strict=True))
        for place, vertex in enumerate(sorted(touching["body"][t])):
            if vertex in sure:  # others may face a point that is not the nearest
                assert distance[start + place] == pytest.approx(own[vertex], abs=WITHIN_M)


def _per_frame(folder: Path) -> dict[str, dict[str, Any]]:
    """What each format says of every frame, by the name of its file."""
    return {name: about.get("by_frame", about) for name, about in exported.stated(folder).items()}


def _is_json(content: Any) -> bool:
    return isinstance(content["contact_probability"], list)


def test_contact_is_in_every_format(
    capture: fitted.Capture, everything: Path, touching: dict[str, list[set[int]]]
) -> None:
    with artefacts.read(capture.paths["joint"], JOINT) as joint:
        regions, probability = joint.text("region_names"), joint["contact_probability"]
    with artefacts.read(capture.paths["metrics"], METRICS) as measured:
        reasons = measured.text("flag_reason")
    content = _per_frame(everything)
    assert len(content) == 8
    for name, entries in content.items():
        for surface in ("body", "object"):
            vertices = _by_frame(
                np.array(entries[f"{surface}_contact_offsets"]),
                np.array(entries[f"{surface}_contact_vertices"]),
            )
            assert vertices == touching[surface], (name, surface)
        assert list(entries["contact_region"]) == regions, name
        exported_values = np.array(entries["contact_probability"])
        assert exported_values == pytest.approx(probability, abs=1e-4), name
        assert np.shape(entries["contact_annotated"]) == probability.shape
        if not _is_json(entries):
            assert list(entries["flag_reason"]) == reasons, name
            assert list(entries["flag_part"][entries["flagged"][0]]) == ["object", "contact"]


def test_deviations_and_stated_errors_are_in_every_format(
    capture: fitted.Capture, everything: Path
) -> None:
    with artefacts.read(capture.paths["body_fit"], BODY_FIT) as fit:
        joint = fit["joint_sigma"]
    with artefacts.read(capture.paths["object_track"], OBJECT_TRACK) as track:
        lost = track["lost"]
    with artefacts.read(capture.paths["metrics"], METRICS) as measured:
        parts = measured.text("verdict/part_names")
        errors = dict(zip(parts, 1e3 * measured["verdict/error_frame"], strict=True))
        silent = dict(zip(parts, measured.text("verdict/silent"), strict=True))
    assert lost.tolist() == [True, False, False, False]
    for name, entries in _per_frame(everything).items():
        if _is_json(entries):
            sigma = np.array(entries["joint_sigma_mm"]) / 1e3
            at = [None if v is None else v / 1e3 for v in entries["object_position_sigma_mm"]]
            turn = entries["object_rotation_sigma_deg"]
            stated = entries["stated_error_mm"]
            assert at[0] is turn[0] is None
            turn = np.radians(turn[1:])
        else:
            sigma, at = entries["joint_sigma"], entries["object_position_sigma"]
            turn = entries["object_rotation_sigma"]
            rows = zip(
                entries["stated_error_part"], entries["stated_error_by_frame_mm"], strict=True
            )
            stated = {str(part): row for part, row in rows}
            assert np.isnan(at[0]) and np.isnan(turn[0])
            turn = turn[1:]
        assert sigma == pytest.approx(joint, abs=1e-4), name
        assert len(entries["joint_name"]) == 55
        # the fixture's covariance is that of 4 mm and 4 mrad along each axis
        assert np.array(at[1:], float) == pytest.approx(0.004, abs=1e-5)
        assert turn == pytest.approx(0.004, abs=1e-5)
        assert set(stated) == {part for part in parts if not silent[part]} and stated, name
        for part, row in stated.items():
            expected = errors[part]
            known = np.isfinite(expected)
            assert known.any()
            exported_values = np.array(row, dtype=float)
            assert exported_values[known] == pytest.approx(expected[known], abs=0.006), (name, part)
            assert np.isnan(exported_values[~known]).all()


def test_the_verdict_of_each_camera_is_exported(capture: fitted.Capture, everything: Path) -> None:
    content = json.loads((everything / "verdict.json").read_text())
    manifest = json.loads((everything / "export.json").read_text())
    assert manifest["verdict_by_camera"] == content["verdict_by_camera"]
    cameras = {one["camera"]: one for one in content["verdict_by_camera"]}
    assert set(cameras) == {"k1", "k2", "k3"} and "held_out" in content["meaning"]
    with artefacts.read(capture.paths["metrics"], METRICS) as measured:
        held_camera = measured["verdict/held_camera"]
        for c, name in enumerate(measured.text("verdict/camera_names")):
            for key, dataset, scale in (
                ("keypoint", "keypoint_px", 1.0),
                ("person", "person_m", 1e3),
                ("overlap", "overlap", 1.0),
                ("object_depth", "object_depth_m", 1e3),
            ):
                for exported_values, end in (("held_in", ""), ("held_out", "_held_out")):
                    entries = cameras[name][key][exported_values]
                    values = measured[f"verdict/{dataset}{end}"][held_camera == c, c]
                    values = values[np.isfinite(values)]
                    if not len(values):
                        assert entries is None
                        continue
                    assert entries == pytest.approx(scale * np.median(values), abs=1e-3)
            for p, part in enumerate(measured.text("verdict/part_names")):
                shift = measured["verdict/shift"][p, c]
                expected = 1e3 * np.sqrt(np.nanmean(shift**2))
                assert cameras[name]["shift_mm"][part] == pytest.approx(expected, abs=0.01)
    with np.load(everything / "amass" / "body.npz") as file:
        assert file["verdict_camera"].tolist() == ["k1", "k2", "k3"]
        exported_values = [cameras[name]["keypoint"]["held_out"] for name in file["verdict_camera"]]
        known = [value is not None for value in exported_values]
        assert any(known)
        assert file["verdict_held_out"][known, 0] == pytest.approx(
            [value for value in exported_values if value is not None], abs=1e-3
        )
    for where in ("bop/about.json", "meshes/about.json"):
        there = json.loads((everything / where).read_text())
        assert there["verdict_by_camera"] == content["verdict_by_camera"]


def test_bop_images_name_their_frame(capture: fitted.Capture, everything: Path) -> None:
    with artefacts.read(capture.paths["metrics"], METRICS) as measured:
        flags = Flags.read(measured)
    assert flags.at(0) == {"flagged": ["object", "contact"], "flag_reason": fitted.FLAG_REASON}
    for number, camera in enumerate(capture.rig):
        scene = everything / "bop" / "test" / f"{number:06d}"
        content = json.loads((scene / "scene_about.json").read_text())
        assert content["camera"] == camera.name
        assert content["images"].keys() == json.loads((scene / "scene_gt.json").read_text()).keys()
        for image, exported_values in content["images"].items():
            assert exported_values == {"frame": int(image), **flags.at(int(image))}


def test_imported_results_have_no_deviations(capture: fitted.Capture, tmp_path: Path) -> None:
    made = capture.copied(tmp_path, "joint")
    with made.edit("joint") as file:
        file.attrs["made_by"] = "another program: res.pkl"
    out = exported.run(made, tmp_path / "out", formats=("amass", "intercap"))
    with np.load(out / "amass" / "body.npz") as content:
        assert str(content["made_by"]) == "another program: res.pkl"
        assert "joint_sigma" not in content and "object_position_sigma" not in content
        assert "body_contact_vertices" in content
    assert "joint_sigma" not in (out / "README.txt").read_text()


@pytest.mark.parametrize(
    ("key", "shape", "parts"),
    [
        (
            "body_contact_distance",
            (4, 10475),
            ["4 frames of 10475", "open_body.npz", "13492 vertices"],
        ),
        ("object_contact_distance", (4, 12), ["4 frames of 12", "mesh of object 'cup'"]),
        (
            "body_contact_distance",
            None,
            ["has no body_contact_distance, although sequence 's01_o09' has"],
        ),
    ],
)
def test_metrics_of_another_body_or_object_are_refused(
    key: str, shape: tuple | None, parts: list[str], capture: fitted.Capture, tmp_path: Path
) -> None:
    made = capture.copied(tmp_path, "metrics")
    with made.edit("metrics") as file:
        other = "body_to_object" if key.startswith("body") else "object_to_body"
        for name in (key, other):  # both have the vertices of the same surface
            attributes = dict(file[name].attrs)
            del file[name]
            if shape is not None:
                values = np.zeros(shape, np.float32)
                data = file.create_dataset(name, data=values, fletcher32=True, chunks=True)
                data.attrs.update(attributes)
    with pytest.raises(UserError) as caught:
        exported.run(made, tmp_path / "out")
    for part in [
        str(made.paths["metrics"]),
        f"sequence {exported.NAME!r}",
        "re-run stage 'metrics'",
        *parts,
    ]:
        assert part in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_fits_with_other_frames_are_refused(capture: fitted.Capture, tmp_path: Path) -> None:
    shorter = Reduction(sets=3).apply(
        {stage: capture.paths[stage] for stage in ("frames", "body_fit", "object_track")}, tmp_path
    )
    for stage in ("body_fit", "object_track"):
        made = replace(capture, paths=capture.paths | {stage: shorter[stage]})
        with pytest.raises(UserError, match=f"3 frames.* has 4; re-run stage '{stage}'"):
            exported.run(made, tmp_path / "out")
