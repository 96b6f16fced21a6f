"""The weights are licensed, so the tests use random numbers under the published names."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
import torch

from intercap_core.body.kinematics import rotation_from_axis_angle
from intercap_core.body.vposer import VPoser, axis_angle_from_rotation
from intercap_core.errors import UserError

_NAMES = {
    1: ["bodyprior_dec_fc1", "bodyprior_dec_fc2", "bodyprior_dec_out"],
    2: ["vp_model.decoder_net.0", "vp_model.decoder_net.3", "vp_model.decoder_net.5"],
}


def _state(version: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(version)
    shapes = [(512, 32), (512, 512), (126, 512)]
    state = {}
    for name, shape in zip(_NAMES[version], shapes, strict=True):
        scale = shape[1] ** -0.5
        state[f"{name}.weight"] = torch.randn(shape, generator=generator) * scale
        state[f"{name}.bias"] = torch.randn(shape[0], generator=generator) * 0.1
    return state


def _save(folder: Path, version: int) -> Path:
    path = folder / ("TR00_E096.pt" if version == 1 else "V02_05.ckpt")
    torch.save(_state(1) if version == 1 else {"state_dict": _state(2), "epoch": 8}, path)
    return path


@pytest.mark.parametrize("version", [1, 2])
def test_decoder_equals_its_layers(version: int, tmp_path: Path) -> None:
    prior = VPoser.load(_save(tmp_path, version))
    assert prior.version == version
    code = torch.randn(4, 32, generator=torch.Generator().manual_seed(5))
    slope = 0.2 if version == 1 else 0.01
    state, x = _state(version), code
    for name in _NAMES[version][:2]:
        x = x @ state[f"{name}.weight"].T + state[f"{name}.bias"]
        x = torch.where(x > 0, x, slope * x)
    name = _NAMES[version][2]
    six = (x @ state[f"{name}.weight"].T + state[f"{name}.bias"]).reshape(4, 21, 3, 2)
    rotations = prior.rotations(code)
    eye = torch.eye(3).expand(4, 21, 3, 3)
    assert torch.allclose(rotations @ rotations.transpose(-1, -2), eye, atol=1e-5)
    assert torch.allclose(torch.linalg.det(rotations), torch.ones(4, 21), atol=1e-5)
    first = six[..., 0] / six[..., 0].norm(dim=-1, keepdim=True)
    assert torch.allclose(rotations[..., 0], first, atol=1e-5)
    assert ((rotations[..., 1] * six[..., 1]).sum(-1) > 0).all()
    again = rotation_from_axis_angle(prior.decode(code).reshape(4, 21, 3))
    assert torch.allclose(again, rotations, atol=1e-4)


def test_jacobian_equals_finite_differences(tmp_path: Path) -> None:
    prior = VPoser.load(_save(tmp_path, 2), dtype=torch.float64)
    code = torch.randn(2, 32, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    _, jacobian = prior.decode_with_jacobian(code)
    step = 1e-6
    for k in (0, 13, 31):
        move = torch.zeros(32, dtype=torch.float64)
        move[k] = step
        numeric = (prior.decode(code + move) - prior.decode(code - move)) / (2 * step)
        assert torch.allclose(jacobian[:, :, k], numeric, atol=1e-6)


@pytest.mark.parametrize(("stored", "named"), [(1, 2), (2, 1)])
def test_weights_of_the_other_version_are_reported(stored: int, named: int, tmp_path: Path) -> None:
    path = _save(tmp_path, stored)
    with pytest.raises(
        UserError, match=f"weights of version {stored}, and version {named}"
    ) as caught:
        VPoser.load(path, named)
    assert str(path) in str(caught.value)
    assert VPoser.load(path, stored).version == stored


def test_prior_around_a_pose_has_the_cost_of_the_best_code(tmp_path: Path) -> None:
    """The best code is found by another optimiser."""
    state = _state(1)
    state["bodyprior_dec_out.weight"] *= 0.2  # turns well below a half, about none
    state["bodyprior_dec_out.bias"] = torch.tensor([1.0, 0, 0, 1, 0, 0]).repeat(21)
    torch.save(state, tmp_path / "tame.pt")
    prior = VPoser.load(tmp_path / "tame.pt", dtype=torch.float64)
    generator = torch.Generator().manual_seed(7)
    pose = prior.decode(0.7 * torch.randn(2, 32, generator=generator, dtype=torch.float64))
    pose = pose + 0.05 * torch.randn(pose.shape, generator=generator, dtype=torch.float64)

    code = torch.zeros(2, 32, dtype=torch.float64, requires_grad=True)
    search = torch.optim.LBFGS([code], max_iter=400, line_search_fn="strong_wolfe")

    def energy() -> torch.Tensor:
        away = (pose - prior.decode(code)) / 0.1
        return 0.5 * ((code**2).sum(1) + (away**2).sum(1))

    def closure() -> torch.Tensor:
        search.zero_grad()
        total = energy().sum()
        total.backward()
        return total

    search.step(closure)
    gaussian = prior.linearise(pose)
    away = pose - gaussian.mean
    cost = 0.5 * torch.einsum("bi,bij,bj->b", away, gaussian.precision, away)
    torch.testing.assert_close(cost, energy().detach(), rtol=0.02, atol=0.02)


def test_matrix_logarithm_inverts_rodrigues() -> None:
    axis = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)
    angles = torch.tensor([0.0, 1e-6, 1e-3, 0.5, 2.0, 3.1], dtype=torch.float64)
    vectors = angles[:, None] * axis
    assert torch.allclose(
        axis_angle_from_rotation(rotation_from_axis_angle(vectors)), vectors, atol=1e-8
    )


class Callback:
    """Of a training framework, as a checkpoint names it."""


class Hyperparameters(dict):
    pass


class Malicious:
    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple:
        return Path.touch, (self.trace,)


@pytest.mark.parametrize("zipped", [True, False])
def test_other_objects_of_a_checkpoint_are_not_executed(zipped: bool, tmp_path: Path) -> None:
    trace = tmp_path / "run"
    content = {
        "callbacks": {Callback: {"best": Callback()}},
        "hyper_parameters": Hyperparameters(rate=1e-3),
        "other": [Malicious(trace), {1, 2}],
        "state_dict": _state(2),
    }
    path = tmp_path / "V02_05.ckpt"
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    prior = VPoser.load(path)
    assert prior.version == 2 and not trace.exists()
    weight, _ = prior.layers[0]
    assert torch.equal(weight, _state(2)["vp_model.decoder_net.0.weight"])


_WEIGHT, _BIAS = "bodyprior_dec_out.weight", "bodyprior_dec_fc1.bias"
WRONG: dict[str, tuple[object, str]] = {
    "no state": ({"state_dict": None}, "no decoder"),
    "other names": ({"a.weight": torch.zeros(2)}, "no decoder"),
    "scalars": ({name: torch.tensor(1.0) for name in _state(1)}, r"\(\), expected \(1, 32\)"),
    "short layer": (_state(1) | {_WEIGHT: torch.zeros(10, 512)}, r"expected \(126, 512\)"),
    "short bias": (_state(1) | {_BIAS: torch.zeros(5)}, r"expected \(512,\)"),
    "sparse": (_state(1) | {_WEIGHT: _state(1)[_WEIGHT].to_sparse()}, "no numbers"),
    "not finite": (_state(1) | {_BIAS: torch.full((512,), torch.nan)}, "not finite"),
    "on no device": (_state(1) | {_WEIGHT: torch.zeros(126, 512, device="meta")}, "meta"),
    "zeros": (_state(1) | {_WEIGHT: torch.zeros(126, 512)}, "is zero, so that every"),
    "huge": (_state(1) | {_WEIGHT: torch.full((126, 512), 1e30)}, "expected at most 1000"),
}


@pytest.mark.parametrize("name", WRONG)
def test_checkpoints_without_a_decoder_are_reported(name: str, tmp_path: Path) -> None:
    content, words = WRONG[name]
    path = tmp_path / "other.pt"
    torch.save(content, path)
    with pytest.raises(UserError, match=words) as caught:
        VPoser.load(path)
    assert str(path) in str(caught.value)


def test_packed_weights_are_refused_unread(tmp_path: Path) -> None:
    """torch.save does not compress; zeros unpack to a thousand times their size."""
    path = _save(tmp_path, 1)
    packed = tmp_path / "packed.pt"
    with (
        zipfile.ZipFile(path) as stored,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for name in stored.namelist():
            content = stored.read(name)
            archive.writestr(name, bytes(len(content)) if "/data/" in name else content)
    with pytest.raises(UserError, match=r"packed\.pt unpacks from 0\.0 MB to 1 MB"):
        VPoser.load(packed)


def test_missing_and_damaged_files_are_reported(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="No such file"):
        VPoser.load(tmp_path / "none.pt")
    cut = tmp_path / "cut.pt"
    cut.write_bytes(_save(tmp_path, 1).read_bytes()[:-1000])
    with pytest.raises(UserError, match="damaged"):
        VPoser.load(cut)
