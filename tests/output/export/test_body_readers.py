"""Bodies of an export, posed by the library body-models from the exported body file."""

from __future__ import annotations

import hashlib
import json
import shutil
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

FULL, SMALL = "open_body_300_100.npz", "open_body_10_10.npz"


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


def _by_the_rule(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Ten shape and ten expression columns where readers of the field look: expression from column
    10 of a file with fewer than 400 columns, from column 300 of any other."""
    with np.load(path) as file:
        table = file["shapedirs"]
    start = 10 if table.shape[2] < 400 else 300
    return table[..., :10], table[..., start : start + 10]


def test_expression_is_where_readers_look_for_it(upright: Path, capture: fitted.Capture) -> None:
    with np.load(OPEN_BODY) as file:
        table = file["shapedirs"]
    head = capture.model.skinning_weights[:, [12, 15, 22, 23, 24]].sum(1).numpy()
    for name, columns in ((SMALL, 20), (FULL, 400)):
        path = upright / "body" / name
        with np.load(path) as file:
            assert file["shapedirs"].shape[2] == columns
        shape, expression = _by_the_rule(path)
        np.testing.assert_array_equal(shape, table[..., :10])
        np.testing.assert_array_equal(expression, table[..., 30:40])
        moved = np.linalg.norm(expression.astype(float), axis=1)
        assert (moved.max(0) > 1e-4).all() and moved[head < 0.1].max() < 1e-6, "not of the face"
    # which is what a reader would have made of the file that was fitted with
    wrong = np.linalg.norm(_by_the_rule(OPEN_BODY)[1].astype(float), axis=1)
    assert wrong[head < 0.1].max() > 1e-3


@pytest.mark.parametrize("name", [SMALL, FULL, "open_body.npz"])
def test_each_body_file_loads_as_a_body_model(
    name: str, upright: Path, lively: fitted.Capture, bodies: np.ndarray, tmp_path: Path
) -> None:
    path = Path(shutil.copy(upright / "body" / name, tmp_path / name))
    shutil.copy(upright / "body" / "open_body_maps.json", path.with_name(path.stem + "_maps.json"))
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        vertices, _ = exported.posed(BodyModel.load(path), joint)
    assert np.abs(vertices - bodies).max() < 1e-7


def test_body_files_are_listed_with_digest_and_columns(upright: Path) -> None:
    content = json.loads((upright / "export.json").read_text())
    files = {path.name: path for path in (upright / "body").glob("*.npz")}
    assert set(content["body_files"]) == set(files) == {SMALL, FULL, "open_body.npz"}
    text = (upright / "README.txt").read_text()
    for name, path in files.items():
        entry = content["body_files"][name]
        assert entry["digest"] == hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        assert f"{name}, digest {entry['digest']}: betas {entry['betas']}" in text
        assert f"expression {entry['expression']}" in text
    assert content["body_files"][SMALL]["expression"] == "10:20"
    assert content["body_files"][FULL]["expression"] == "300:310"
    for name in (SMALL, FULL):
        with np.load(files[name]) as file:
            assert file["surface_model_type"] == "intercap-open-body"
            assert file_digest(OPEN_BODY) in str(file["fitted_with"])
            assert (str(file["up_axis"]), str(file["units"])) == ("y", "metres")


@pytest.mark.parametrize(
    ("betas", "expression", "names"),
    [(10, 10, ["10_10", "300_100"]), (4, 10, ["10_10", "300_100"]), (16, 10, ["300_100"])],
)
def test_layouts_need_enough_shape_columns(
    betas: int, expression: int, names: list[str], tmp_path: Path
) -> None:
    body = ExportBody(OPEN_BODY, "neutral", 13492, betas, expression)
    written = {file.name: file for file in body_files.write(tmp_path / "body", body)}
    assert list(written)[1:] == [f"{OPEN_BODY.stem}_{name}.npz" for name in names]
    with np.load(OPEN_BODY) as file:
        table = file["shapedirs"]
    with np.load(tmp_path / "body" / FULL) as file:
        columns = file["shapedirs"]
    np.testing.assert_array_equal(columns[..., :betas], table[..., :betas])
    assert not columns[..., betas:300].any() and not columns[..., 300 + expression :].any()
    assert written[FULL].betas == f"0:{betas}"


def test_a_licensed_body_file_is_not_exported(tmp_path: Path) -> None:
    licensed = ExportBody(tmp_path / "SMPLX_MALE.npz", "male", 10475, 10, 10)
    assert not body_files.write(tmp_path / "body", licensed)
    assert not (tmp_path / "body").exists()
