"""Bodies of an export, posed by a library of others: body-models on the file that goes along."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
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
from intercap_core.output.export.about import BodyFile
from intercap_core.schemas import JOINT
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted

FULL, SMALL = "open_body_300_100.npz", "open_body_10_10.npz"


@pytest.fixture(scope="module")
def folder(lively: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "out"
    return exported.run(lively, out, formats=("intercap", "amass"))


@pytest.fixture(scope="module")
def expected(lively: fitted.Capture) -> Iterator[np.ndarray]:
    """Vertices (T, V, 3) of the joint artefact, master frame."""
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        assert np.abs(joint["expression"]).min() > 0
        vertices, joints = exported.posed(lively.model, joint)
        assert joints == pytest.approx(joint["joints"], abs=1e-6)
        yield vertices


def _peer(path: Path, *, flat_hand_mean: bool) -> Any:
    from body_models.smplx.torch import SMPLX

    return SMPLX(model_path=path, flat_hand_mean=flat_hand_mean)


def _posed(peer: Any, **values: np.ndarray) -> np.ndarray:
    """Vertices by the library's own names: it takes joints (T, K, 3) of body, head and hands."""
    tensors = {k: torch.as_tensor(np.array(v), dtype=torch.float32) for k, v in values.items()}
    with torch.no_grad():
        return peer.forward_vertices(**tensors).numpy()


def test_amass_parameters_move_the_exported_body_as_the_joint_result_does(
    folder: Path, expected: np.ndarray, zup_from_master: np.ndarray
) -> None:
    with np.load(folder / "amass" / "body.npz") as told:
        total = len(told["trans"])
        head = [told["pose_jaw"], *np.split(told["pose_eye"], 2, axis=1)]
        found = _posed(
            _peer(folder / "body" / FULL, flat_hand_mean=True),
            body_pose=told["pose_body"].reshape(total, 21, 3),
            head_pose=np.stack(head, 1),
            hand_pose=told["pose_hand"].reshape(total, 30, 3),
            pelvis_rotation=told["root_orient"],
            shape=np.tile(told["betas"], (total, 1)),
            expression=told["expression"],
            global_translation=told["trans"],
        )
    assert np.abs(found - apply(zup_from_master, expected.astype(float))).max() < 1e-5


@pytest.mark.parametrize("hands", ["components over the mean hand", "full poses"])
def test_intercap_parameters_move_the_exported_body_as_the_joint_result_does(
    hands: str, folder: Path, expected: np.ndarray
) -> None:
    told = read_pickle(folder / "intercap" / "res.pkl")
    total = len(told["transl"])
    by_components = hands.startswith("components")
    if by_components:
        with np.load(folder / "body" / FULL) as file:
            sides = [
                told[f"{side}_hand_pose"] @ file[f"hands_components{side[0]}"][:12]
                for side in ("left", "right")
            ]
    else:
        sides = [told[f"{side}_hand_pose_axis_angle"] for side in ("left", "right")]
    found = _posed(
        _peer(folder / "body" / FULL, flat_hand_mean=not by_components),
        body_pose=told["body_pose"].reshape(total, 21, 3),
        head_pose=np.stack([told[f"{name}_pose"] for name in ("jaw", "leye", "reye")], 1),
        hand_pose=np.concatenate(sides, 1).reshape(total, 30, 3),
        pelvis_rotation=told["global_orient"],
        shape=told["betas"],
        expression=told["expression"],
        global_translation=told["transl"],
    )
    assert np.abs(found - expected).max() < 1e-5


def test_object_poses_of_both_formats_are_the_same_object(
    lively: fitted.Capture, folder: Path, zup_from_master: np.ndarray
) -> None:
    told = read_pickle(folder / "intercap" / "res.pkl")
    with np.load(folder / "amass" / "object.npz") as amass:
        for t, (turn, at) in enumerate(zip(told["ob_pose"], told["ob_trans"], strict=True)):
            placed = lively.mesh.vertices @ Rotation.from_rotvec(turn).as_matrix().T + at
            upright = lively.mesh.vertices @ amass["rotation"][t].T + amass["translation"][t]
            assert np.abs(upright - apply(zup_from_master, placed)).max() < 1e-6


def _by_the_rule(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Ten shape and ten expression columns where readers of the field look: expression from column
    10 of a file with fewer than 400 columns, from column 300 of any other."""
    with np.load(path) as file:
        table = file["shapedirs"]
    start = 10 if table.shape[2] < 400 else 300
    return table[..., :10], table[..., start : start + 10]


def test_expression_is_where_readers_look_for_it(folder: Path, capture: fitted.Capture) -> None:
    with np.load(OPEN_BODY) as file:
        table = file["shapedirs"]
    head = capture.model.skinning_weights[:, [12, 15, 22, 23, 24]].sum(1).numpy()
    for name, columns in ((SMALL, 20), (FULL, 400)):
        path = folder / "body" / name
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
def test_each_body_file_serves_as_this_projects_body_model(
    name: str, folder: Path, lively: fitted.Capture, expected: np.ndarray, tmp_path: Path
) -> None:
    path = Path(shutil.copy(folder / "body" / name, tmp_path / name))
    shutil.copy(folder / "body" / "open_body_maps.json", path.with_name(path.stem + "_maps.json"))
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        vertices, _ = exported.posed(BodyModel.load(path), joint)
    assert np.abs(vertices - expected).max() < 1e-7


def test_each_body_file_is_named_with_its_digest_and_columns(folder: Path) -> None:
    told = json.loads((folder / "export.json").read_text())
    files = {path.name: path for path in (folder / "body").glob("*.npz")}
    assert set(told["body_files"]) == set(files) == {SMALL, FULL, "open_body.npz"}
    text = (folder / "README.txt").read_text()
    for name, path in files.items():
        said = told["body_files"][name]
        assert said["digest"] == hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        assert f"{name}, digest {said['digest']}: betas {said['betas']}" in text
        assert f"expression {said['expression']}" in text
    assert told["body"]["body_file_digest"] == file_digest(OPEN_BODY)
    assert told["body_files"][SMALL]["expression"] == "10:20"
    assert told["body_files"][FULL]["expression"] == "300:310"
    for name in (SMALL, FULL):
        with np.load(files[name]) as file:
            assert file["surface_model_type"] == "intercap-open-body"
            assert file_digest(OPEN_BODY) in str(file["fitted_with"])
            assert (str(file["up_axis"]), str(file["units"])) == ("y", "metres")


def test_same_files_of_the_same_body(folder: Path, tmp_path: Path) -> None:
    body = BodyFile(OPEN_BODY, "neutral", 13492, 10, 10)
    body_files.write(tmp_path / "body", body)
    names = sorted(path.name for path in (folder / "body").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "body").iterdir())
    for name in names:
        same = (tmp_path / "body" / name).read_bytes() == (folder / "body" / name).read_bytes()
        assert same, name


@pytest.mark.parametrize(
    ("betas", "expression", "names"),
    [(10, 10, ["10_10", "300_100"]), (4, 10, ["10_10", "300_100"]), (16, 10, ["300_100"])],
)
def test_more_numbers_of_shape_than_the_small_layout_has(
    betas: int, expression: int, names: list[str], tmp_path: Path
) -> None:
    body = BodyFile(OPEN_BODY, "neutral", 13492, betas, expression)
    assert [layout.name for layout in body_files.layouts(body)] == names
    written = {file.name: file for file in body_files.write(tmp_path / "body", body)}
    with np.load(OPEN_BODY) as file:
        table = file["shapedirs"]
    with np.load(tmp_path / "body" / FULL) as file:
        columns = file["shapedirs"]
    np.testing.assert_array_equal(columns[..., :betas], table[..., :betas])
    assert not columns[..., betas:300].any() and not columns[..., 300 + expression :].any()
    assert written[FULL].betas == f"0:{betas}"


def test_a_licensed_file_is_named_and_not_given_away(tmp_path: Path) -> None:
    licensed = BodyFile(tmp_path / "SMPLX_MALE.npz", "male", 10475, 10, 10)
    assert not body_files.write(tmp_path / "body", licensed)
    assert not (tmp_path / "body").exists()
