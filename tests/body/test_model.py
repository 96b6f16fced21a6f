from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.loading import BodyArrays, load_body_file
from intercap_core.body.model import BodyModel, check_body, with_hand_mean
from intercap_core.errors import UserError

from .conftest import hand_pose, open_arrays, random_vector

if TYPE_CHECKING:
    from body_models.smplx.torch import SMPLX


@pytest.fixture(scope="module")
def peer(full_file: Path) -> SMPLX:
    """body-models' own reading of the file, in float32; sums over the vertices in float64."""
    from body_models.smplx.torch import SMPLX

    model = SMPLX(model_path=full_file, flat_hand_mean=True)
    assets, regressor = model._assets, np.load(full_file)["J_regressor"].astype(float)
    for joints, vertices in [
        ("j_template", "v_template"), ("j_shapedirs", "shapedirs"), ("j_exprdirs", "exprdirs"),
    ]:  # fmt: skip
        values = np.tensordot(regressor, getattr(assets, vertices).numpy().astype(float), 1)
        setattr(assets, joints, torch.from_numpy(values))
    return model


# The peer rounds the file to float32 before it computes in either type
@pytest.mark.parametrize(
    "columns, dtype, bound", [((10, 10), torch.float32, 2e-6), ((300, 100), torch.float64, 2e-7)]
)
def test_equals_the_peer_library_on_the_same_file(
    columns: tuple[int, int], dtype: torch.dtype, bound: float, full_file: Path, peer: SMPLX
) -> None:
    model = BodyModel.load(full_file, num_betas=columns[0], num_expression=columns[1], dtype=dtype)
    vector = random_vector(4, model.num_parameters, 1, dtype)
    vector[:, 168:] *= min(1, (20 / sum(columns)) ** 0.5)  # people, not giants, of 400 directions
    params = model.parameters(vector)
    peer.to(dtype)
    arguments = dict(
        body_pose=params.body_pose.reshape(4, 21, 3),
        head_pose=torch.stack([params.jaw_pose, params.leye_pose, params.reye_pose], 1),
        hand_pose=torch.cat([params.left_hand_pose, params.right_hand_pose], 1).reshape(4, 30, 3),
        pelvis_rotation=params.global_orient,
        shape=params.betas,
        expression=params.expression,
        global_translation=params.transl,
    )
    with torch.no_grad():
        vertices = peer.forward_vertices(**arguments)
        skeleton = peer.forward_skeleton(**arguments)
        out = model.forward(params)
    assert vertices.dtype == dtype
    assert (out.vertices - vertices).abs().max() < bound
    assert (out.joints - skeleton[..., :3, 3]).abs().max() < bound


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_gives_the_values_and_derivatives_of_the_cpu(full_file: Path) -> None:
    results = []
    for device in ("cpu", "cuda"):
        model = BodyModel.load(full_file, device=device, dtype=torch.float64)
        vector = random_vector(3, model.num_parameters, 1, torch.float64).to(device)
        params, ids = model.parameters(vector), torch.arange(0, model.num_vertices, 97)
        posed = model.forward(params)
        linear = model.linearise(params, vertex_ids=ids, joints=True).full()
        results.append((posed.vertices, posed.joints, model.keypoints_of(params), linear))
    for expected, found in zip(*results, strict=True):
        assert found.device.type == "cuda"
        assert (found.cpu() - expected).abs().max() < 1e-10


def test_parts_of_vertices_and_of_a_batch_equal_the_whole(body: BodyModel) -> None:
    """The shape has one row for all bodies."""
    vector = random_vector(3, body.num_parameters, 2, torch.float32)
    params, ids = body.parameters(vector), torch.tensor([13000, 4, 777, 777, 9001])
    assert torch.equal(params.vector(), vector)
    assert torch.equal(params.full_pose().reshape(3, -1), vector[:, :165])
    params.betas = params.betas[:1]
    full, part = body.forward(params), body.forward(params, vertex_ids=ids)
    assert torch.allclose(full.vertices[:, ids], part.vertices, atol=1e-6)
    assert torch.equal(full.joints, part.joints)
    last = body.forward(params.frames(slice(2, 3)))
    assert torch.allclose(full.vertices[2:], last.vertices, atol=1e-6)


def test_rest_pose_axes_and_flexion_directions(body: BodyModel) -> None:
    """T-pose, y up, facing +z; the bending prior's signs: elbows and knees close as SMPL-X's do."""
    rest = body.forward(body.zeros()).joints[0].numpy()
    at = {n: rest[i] for n, i in JOINT_INDEX.items()}
    assert at["head"][1] > at["pelvis"][1] > at["left_ankle"][1]
    assert at["left_wrist"][0] > 0.5 > -0.5 > at["right_wrist"][0]
    assert at["left_foot"][2] > at["left_ankle"][2] + 0.08
    assert np.abs(rest[[16, 18, 20], 1] - rest[16, 1]).max() < 0.03
    assert np.abs(rest[JOINT_INDEX["pelvis"]] - [0, -0.35, 0.01]).max() < 1e-5

    for index, sign, moved, stays in ((55, -1, 20, 18), (58, 1, 21, 19)):
        params = body.zeros()
        params.body_pose[0, index - 3] = sign * 1.0
        posed = body.forward(params).joints[0].numpy()
        assert posed[moved, 2] > rest[moved, 2] + 0.15  # the wrist comes forward
        assert np.allclose(posed[stays], rest[stays], atol=1e-6)
    for index, moved in ((12, 7), (15, 8)):
        params = body.zeros()
        params.body_pose[0, index - 3] = 1.0
        posed = body.forward(params).joints[0].numpy()
        assert posed[moved, 2] < rest[moved, 2] - 0.25  # the ankle goes back


def test_mean_hands_curl_to_the_palm(body: BodyModel) -> None:
    params = with_hand_mean(body, body.zeros())
    joints = body.forward(params).joints[0].numpy()
    flat = body.forward(body.zeros()).joints[0].numpy()
    tips = [JOINT_INDEX[n] for n in ("left_middle3", "right_middle3", "left_ring3", "right_index3")]
    assert (joints[tips, 1] < flat[tips, 1] - 0.01).all()
    mirror = np.array([-1.0, 1, 1])
    left, right = joints[25:40], joints[40:55] * mirror
    assert np.abs(left - right).max() < 2e-3


def test_hand_components_are_orthonormal_and_mirrored(body64: BodyModel) -> None:
    for table in body64.hand_components:
        assert torch.allclose(table @ table.T, torch.eye(45, dtype=table.dtype), atol=1e-5)
    flip = torch.tensor([1.0, -1, -1] * 15, dtype=torch.float64)
    assert torch.allclose(body64.hand_components[0] * flip, body64.hand_components[1], atol=1e-6)
    pose = hand_pose(body64, torch.zeros(1, 12, dtype=torch.float64), 1)
    assert torch.equal(pose[0], body64.hand_mean[1])


@pytest.mark.parametrize("count", [6, 12])
def test_few_hand_components_are_those_of_all_with_zeros(count: int, body64: BodyModel) -> None:
    model = BodyModel.load(num_hand_components=count, dtype=torch.float64)
    assert model.hand_components.shape == (2, count, 45)
    assert model.hand_deviation.shape == (2, count)
    code = torch.linspace(-1, 1, 2 * count, dtype=torch.float64).reshape(2, count)
    for side in (0, 1):
        rest = code.new_zeros(2, 45 - count)
        expected = hand_pose(body64, torch.cat([code, rest], 1), side)
        assert torch.allclose(hand_pose(model, code, side), expected, atol=1e-14)


def test_flat_hand_mean_moves_the_origin_of_coefficients(body64: BodyModel) -> None:
    flat = BodyModel.load(flat_hand_mean=True, dtype=torch.float64)
    assert not flat.hand_mean.any()
    assert torch.equal(with_hand_mean(flat, flat.zeros()).vector(), flat.zeros().vector())
    for side in (0, 1):
        code = body64.hand_components[side] @ body64.hand_mean[side]
        mean = hand_pose(flat, code[None], side)[0]  # the components span all poses
        assert torch.allclose(mean, body64.hand_mean[side], atol=1e-5)
        usual = torch.hypot(body64.hand_deviation[side], code)
        assert torch.allclose(flat.hand_deviation[side], usual, atol=1e-12)


@pytest.mark.parametrize("count", [5, 46])
def test_wrong_numbers_of_hand_components_are_reported(count: int) -> None:
    with pytest.raises(UserError, match=f"{count} hand components were requested; expected 6 to"):
        BodyModel.load(num_hand_components=count)


@pytest.mark.parametrize(
    "count, skin, mean, p95, worst", [(10, 2.0, 1.5, 3.0, 8.0), (30, 0.4, 0.3, 1.0, 3.0)]
)
def test_joints_of_adults_outside_the_training_set(
    count: int, skin: float, mean: float, p95: float, worst: float
) -> None:
    """Fit the shape numbers to the skin; the joints land where the source's rig has them, mm."""
    body = BodyModel.load(num_betas=count, dtype=torch.float64)
    with np.load(Path(__file__).parent / "data" / "unseen_adults.npz") as file:
        ids, vertices, joints = (file[n] for n in ("vertex_ids", "vertices", "joints"))
    params = body.zeros(count + 1)
    params.betas = torch.cat([torch.zeros(1, count), torch.eye(count)]).double()
    basis = body.forward(params, vertex_ids=ids).vertices.numpy()
    columns = (basis[1:] - basis[0]).reshape(count, -1).T
    betas, *_ = np.linalg.lstsq(columns, (vertices - basis[0]).reshape(10, -1).T, rcond=None)
    params = body.zeros(10)
    params.betas = torch.as_tensor(betas.T)
    out = body.forward(params, vertex_ids=ids)
    error = 1e3 * np.linalg.norm(out.joints.numpy() - joints, axis=2)
    assert error.mean() < mean
    assert np.percentile(error, 95) < p95
    assert error.max() < worst
    assert 1e3 * np.linalg.norm(out.vertices.numpy() - vertices, axis=2).mean() < skin


def test_expression_moves_the_face_alone(body: BodyModel) -> None:
    params = body.zeros()
    params.expression[:] = 2.0
    out, rest = body.forward(params), body.forward(body.zeros())
    moved = (out.vertices - rest.vertices)[0].norm(dim=1).numpy()
    head = body.skinning_weights[:, [12, 15, 22, 23, 24]].sum(1).numpy()
    assert moved[head > 0.9].max() > 0.005
    assert moved[head < 0.1].max() < 1e-6
    assert (out.joints - rest.joints).abs().max() < 2e-4


Change = Callable[[dict], dict]


def _tree(joints: int) -> Change:
    return lambda a: {"kintree_table": np.zeros((2, joints), np.int64)}


BAD_FILES: dict[str, tuple[Change, str]] = {
    "SMPL": (_tree(24), "SMPL model with 24 joints"),
    "other": (_tree(54), "54 joints"),
    "no hands": (lambda a: {"hands_componentsl": None}, "lacks the hands"),
    "short regressor": (lambda a: {"J_regressor": a["J_regressor"][:54]}, "J_regressor"),
    "posedirs": (lambda a: {"posedirs": np.ones((len(a["weights"]), 3, 207))}, "486"),
    "order": (lambda a: {"kintree_table": np.stack([np.arange(55) - 1, np.arange(55)])},
              "another joint tree"),
    "nan": (lambda a: {"v_template": a["v_template"] * np.nan}, "not finite"),
    "columns": (lambda a: {"shapedirs": a["shapedirs"][:, :, :12]}, "6 shape"),
    "millimetres": (lambda a: {"v_template": a["v_template"] * 1000}, "millimetres"),
    "scalar template": (lambda a: {"v_template": np.array(1.0)}, "v_template of shape"),
    "no vertices": (lambda a: {"J_regressor": a["J_regressor"][:, :0]} | {
        name: a[name][:0] for name in ("v_template", "shapedirs", "weights")}, "0 vertices"),
    "no faces": (lambda a: {"f": a["f"][:0]}, "0 faces"),
    "text": (lambda a: {"weights": np.full(a["weights"].shape, "a")}, "weights of type"),
    "objects": (lambda a: {"weights": np.array([None])}, "no readable array 'weights'"),
    "scalar tree": (lambda a: {"kintree_table": np.array(3)}, "kintree_table of shape"),
    "face": (lambda a: {"f": a["f"] + np.uint32(1)}, "names number 13492 in f"),
    "negative face": (lambda a: {"f": a["f"].astype(np.int64) - 1}, "names number -1 in f"),
    "landmark": (lambda a: {"lmk_faces_idx": a["lmk_faces_idx"] + 10**6}, "lmk_faces_idx"),
    "infinite tree": (lambda a: {"kintree_table": np.full((2, 55), np.inf)}, "kintree_table"),
    "no weight": (lambda a: {"weights": a["weights"] * 0}, "sum of 1"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_file_of_another_kind_is_reported(name: str, tmp_path: Path) -> None:
    change, words = BAD_FILES[name]
    path = tmp_path / "body.npz"
    arrays = open_arrays() | {"posedirs": None} | change(open_arrays())
    np.savez(path, **{name: values for name, values in arrays.items() if values is not None})
    with pytest.raises(UserError, match=words) as caught:
        BodyModel.load(path)
    assert str(path) in str(caught.value)


def test_files_that_are_not_npz_are_reported(tmp_path: Path) -> None:
    broken = tmp_path / "broken.npz"
    broken.write_bytes(b"PK\x03\x04 not a zip")
    pickle = tmp_path / "SMPLX_MALE.pkl"
    pickle.write_bytes(b"\x80\x04.")
    for path, words in ((tmp_path / "none.npz", "No such file"), (pickle, "pickle"),
                        (broken, "not a readable .npz")):  # fmt: skip
        with pytest.raises(UserError, match=words):
            BodyModel.load(path)


def test_a_mesh_without_its_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "body.npz"
    np.savez(path, **open_arrays())
    with pytest.raises(UserError, match=r"body_maps\.json"):
        BodyModel.load(path)
    path.with_name("body_maps.json").write_text('{"points": {}}')
    with pytest.raises(UserError, match=r"body_maps\.json"):
        BodyModel.load(path)


WRONG: dict[str, tuple[Callable[[BodyArrays], dict], str]] = {
    "wide": (lambda f: {"template": f.template * [4, 1, 1]}, "m wide"),
    "no skin": (lambda f: {"faces": 0 * f.faces}, "0 m2 of skin"),
    "joints elsewhere": (lambda f: {"joint_regressor": 1.5 * f.joint_regressor},
                         "a joint .* outside of its skin"),
    "joints in one place": (
        lambda f: {"joint_regressor": np.full((55, len(f.template)), 1 / len(f.template))},
        "joints over 0% of its skin's",
    ),
    "negative weights": (lambda f: {"weights": f.weights - 0.01}, "skinning weight of -0"),
    "one shape": (lambda f: {"shape_directions": 0 * f.shape_directions,
                             "expression_directions": 0 * f.expression_directions}, "shapedirs"),
    "shapes in millimetres": (lambda f: {"shape_directions": 1000 * f.shape_directions},
                              "move the skin by up to"),
    "hand without components": (lambda f: {"hand_components": np.zeros((2, 45, 45))}, "length 0"),
    "stiff hand": (lambda f: {"hand_deviation": np.zeros((2, 45))}, "never varies"),
    "landmarks": (lambda f: {"landmark_barycentric": 3 * f.landmark_barycentric},
                  "lmk_bary_coords"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_numbers_that_are_not_a_persons_are_reported(name: str) -> None:
    change, words = WRONG[name]
    file = load_body_file(None, 10, 10)
    model = BodyModel(replace(file, **change(file)), torch.device("cpu"), torch.float32)
    with pytest.raises(UserError, match=words) as caught:
        check_body(model)
    assert str(file.path) in str(caught.value)


def test_persons_are_accepted(body: BodyModel, full_file: Path) -> None:
    check_body(body)
    check_body(BodyModel.load(full_file))
