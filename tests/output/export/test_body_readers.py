"""Bodies of an export, posed by the library body-models from the exported body file."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.body.artefact import file_digest
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel
from intercap_core.geometry.camera.transforms import apply
from intercap_core.inputs.arrays import read_pickle
from intercap_core.output.export import body_files
from intercap_core.output.export.about import ExportBody
from intercap_core.schemas import JOINT
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted

FULL = "open_body_300_100.npz"


def _peer(path: Path, *, flat_hand_mean: bool) -> Any:
    from body_models.smplx.torch import SMPLX

    return SMPLX(model_path=path, flat_hand_mean=flat_hand_mean)


def _posed(peer: Any, **values: np.ndarray) -> np.ndarray:
    """Vertices by the library's own names: it takes joints (T, K, 3) of body, head and hands."""
    tensors = {k: torch.as_tensor(np.array(v), dtype=torch.float32) for k, v in values.items()}
    with torch.no_grad():
        return peer.forward_vertices(**tensors).numpy()


def test_amass_parameters_reproduce_the_joint_result(
    upright: Path, bodies: np.ndarray, zup_from_master: np.ndarray
) -> None:
    with np.load(upright / "amass" / "body.npz") as content:
        total = len(content["trans"])
        assert content["poses"].shape == (total, 165) and str(content["gender"]) == "neutral"
        assert float(content["mocap_frame_rate"]) == fitted.FPS
        head = [content["pose_jaw"], *np.split(content["pose_eye"], 2, axis=1)]
        vertices = _posed(
            _peer(upright / "body" / FULL, flat_hand_mean=True),
            body_pose=content["pose_body"].reshape(total, 21, 3),
            head_pose=np.stack(head, 1),
            hand_pose=content["pose_hand"].reshape(total, 30, 3),
            pelvis_rotation=content["root_orient"],
            shape=np.tile(content["betas"], (total, 1)),
            expression=content["expression"],
            global_translation=content["trans"],
        )
    assert np.abs(vertices - apply(zup_from_master, bodies.astype(float))).max() < 1e-5


@pytest.mark.parametrize("hands", ["components over the mean hand", "full poses"])
def test_intercap_parameters_reproduce_the_joint_result(
    hands: str, upright: Path, bodies: np.ndarray
) -> None:
    content = read_pickle(upright / "intercap" / "res.pkl")
    total = len(content["transl"])
    by_components = hands.startswith("components")
    if by_components:
        with np.load(upright / "body" / FULL) as file:
            sides = [
                content[f"{side}_hand_pose"] @ file[f"hands_components{side[0]}"][:12]
                for side in ("left", "right")
            ]
    else:
        sides = [content[f"{side}_hand_pose_axis_angle"] for side in ("left", "right")]
    vertices = _posed(
        _peer(upright / "body" / FULL, flat_hand_mean=not by_components),
        body_pose=content["body_pose"].reshape(total, 21, 3),
        head_pose=np.stack([content[f"{name}_pose"] for name in ("jaw", "leye", "reye")], 1),
        hand_pose=np.concatenate(sides, 1).reshape(total, 30, 3),
        pelvis_rotation=content["global_orient"],
        shape=content["betas"],
        expression=content["expression"],
        global_translation=content["transl"],
    )
    assert np.abs(vertices - bodies).max() < 1e-5


def test_object_poses_of_both_formats_are_the_same_object(
    lively: fitted.Capture, upright: Path, zup_from_master: np.ndarray
) -> None:
    content = read_pickle(upright / "intercap" / "res.pkl")
    with np.load(upright / "amass" / "object.npz") as amass:
        for t, (turn, at) in enumerate(zip(content["ob_pose"], content["ob_trans"], strict=True)):
            placed = lively.mesh.vertices @ Rotation.from_rotvec(turn).as_matrix().T + at
            stood = lively.mesh.vertices @ amass["rotation"][t].T + amass["translation"][t]
            assert np.abs(stood - apply(zup_from_master, placed)).max() < 1e-6


def test_expression_is_where_readers_look_for_it(upright: Path, capture: fitted.Capture) -> None:
    with np.load(OPEN_BODY) as file:
        table = file["shapedirs"]
    head = capture.model.skinning_weights[:, [12, 15, 22, 23, 24]].sum(1).numpy()
    with np.load(upright / "body" / FULL) as file:
        columns = file["shapedirs"]
    assert columns.shape[2] == 400  # with fewer, readers take the expression from column 10
    shape, expression = columns[..., :10], columns[..., 300:310]
    np.testing.assert_array_equal(shape, table[..., :10])
    np.testing.assert_array_equal(expression, table[..., 30:40])
    moved = np.linalg.norm(expression.astype(float), axis=1)
    assert (moved.max(0) > 1e-4).all() and moved[head < 0.1].max() < 1e-6, "not of the face"


def test_the_body_file_loads_as_a_body_model(
    upright: Path, lively: fitted.Capture, bodies: np.ndarray
) -> None:
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        vertices, _ = exported.posed(BodyModel.load(upright / "body" / FULL), joint)
    assert np.abs(vertices - bodies).max() < 1e-7


def test_the_body_file_is_listed_with_digest_and_columns(upright: Path) -> None:
    content = json.loads((upright / "export.json").read_text())
    (path,) = (upright / "body").glob("*.npz")  # no reader has to choose
    assert list(content["body_files"]) == [path.name] == [FULL]
    text = (upright / "README.txt").read_text()
    entry = content["body_files"][FULL]
    assert entry["digest"] == hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    assert f"digest {entry['digest']}; columns of shapedirs: betas {entry['betas']}" in text
    assert (entry["betas"], entry["expression"]) == ("0:10", "300:310")
    with np.load(path) as file:
        assert file["surface_model_type"] == "intercap-open-body"
        assert file_digest(OPEN_BODY) in str(file["fitted_with"])
        assert (str(file["up_axis"]), str(file["units"])) == ("y", "metres")


@pytest.mark.parametrize(("betas", "expression"), [(10, 10), (4, 10), (16, 10)])
def test_columns_beyond_the_parameters_are_zero(
    betas: int, expression: int, tmp_path: Path
) -> None:
    body = ExportBody(OPEN_BODY, "neutral", 13492, betas, expression)
    written = body_files.write(tmp_path / "body", body)
    with np.load(OPEN_BODY) as file:
        table = file["shapedirs"]
    with np.load(tmp_path / "body" / FULL) as file:
        columns = file["shapedirs"]
    np.testing.assert_array_equal(columns[..., :betas], table[..., :betas])
    assert not columns[..., betas:300].any() and not columns[..., 300 + expression :].any()
    assert written[FULL]["betas"] == f"0:{betas}"


def test_a_licensed_body_file_is_not_exported(tmp_path: Path) -> None:
    licensed = ExportBody(tmp_path / "SMPLX_MALE.npz", "male", 10475, 10, 10)
    assert not body_files.write(tmp_path / "body", licensed)
    assert not (tmp_path / "body").exists()
