"""The decoder of VPoser (Pavlakos et al. 2019) from the user's own weights, both versions.

Version 1 (`TR00_E096.pt`) and version 2 (`V02_05`, a Lightning checkpoint) decode a 32-number code
to the 21 body rotations by three linear layers; they differ in key names and in the leaky ReLU's
slope, and their codes are not interchangeable. A code's prior is a standard normal.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from intercap_core.errors import UserError

LATENT = 32
_JOINTS = 21
_VERSIONS = {
    1: (("bodyprior_dec_fc1", "bodyprior_dec_fc2", "bodyprior_dec_out"), 0.2),
    2: (("decoder_net.0", "decoder_net.3", "decoder_net.5"), 0.01),
}
_PREFIXES = ("module.", "vp_model.")
_MATRIX_LOG_EPSILON = 1e-7


@dataclass(frozen=True)
class VPoser:
    """layers: weight and bias of the three linear layers; slope of the leaky ReLU between them."""

    version: int
    layers: tuple[tuple[Tensor, Tensor], ...]
    slope: float

    @classmethod
    def load(cls, path: Path, dtype: torch.dtype = torch.float32) -> VPoser:
        """Read either version; `UserError` if the file is missing or holds no decoder."""
        if not path.is_file():
            raise UserError(
                f"VPoser file {path} does not exist: expected TR00_E096.pt (version 1) or a V02_05 "
                ".ckpt (version 2); leave the setting out to use joint limits alone."
            )
        try:
            read = torch.load(path, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError) as error:
            raise UserError(
                f"VPoser file {path} holds more than plain tensors or is damaged "
                f"({type(error).__name__}): save its state_dict alone with torch.save and use that."
            ) from error
        state = read.get("state_dict", read) if isinstance(read, dict) else {}
        weights = {_bare(str(name)): value for name, value in state.items()}
        for version, (names, slope) in _VERSIONS.items():
            if all(f"{name}.weight" in weights for name in names):
                layers = tuple(
                    (weights[f"{name}.weight"].to(dtype), weights[f"{name}.bias"].to(dtype))
                    for name in names
                )
                _check(path, layers)
                return cls(version, layers, slope)
        raise UserError(
            f"VPoser file {path} has no decoder of version 1 or 2: expected keys such as "
            "bodyprior_dec_fc1.weight or vp_model.decoder_net.0.weight; take the published file."
        )

    def rotations(self, code: Tensor) -> Tensor:
        """(B,32) -> (B,21,3,3); the 6D output is two columns, made orthonormal."""
        x = code
        for weight, bias in self.layers[:-1]:
            x = functional.leaky_relu(functional.linear(x, weight, bias), self.slope)
        x = functional.linear(x, *self.layers[-1]).reshape(*code.shape[:-1], _JOINTS, 3, 2)
        first = functional.normalize(x[..., 0], dim=-1)
        second = x[..., 1] - (first * x[..., 1]).sum(-1, keepdim=True) * first
        second = functional.normalize(second, dim=-1)
        third = torch.linalg.cross(first, second, dim=-1)
        return torch.stack([first, second, third], -1)

    def decode(self, code: Tensor) -> Tensor:
        """(B,32) -> body_pose (B,63), axis-angle."""
        return axis_angle_from_rotation(self.rotations(code)).reshape(*code.shape[:-1], 63)

    def decode_with_jacobian(self, code: Tensor) -> tuple[Tensor, Tensor]:
        """(B,32) -> body_pose (B,63) and its derivative by the code (B,63,32)."""
        jacobian = torch.func.vmap(torch.func.jacfwd(self.decode))(code)
        return self.decode(code), jacobian


def axis_angle_from_rotation(rotation: Tensor) -> Tensor:
    """(...,3,3) -> (...,3); for angles up to just below pi, smooth through zero."""
    skewed = torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        -1,
    )
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    sine_squared = (skewed**2).sum(-1) / 4
    small = sine_squared < _MATRIX_LOG_EPSILON
    sine = torch.where(small, torch.ones_like(sine_squared), sine_squared).sqrt()
    angle = torch.atan2(sine, (trace - 1) / 2)
    factor = torch.where(small, 0.5 + sine_squared / 12, angle / (2 * sine))
    return factor[..., None] * skewed


def _bare(name: str) -> str:
    for prefix in _PREFIXES:
        name = name.removeprefix(prefix)
    return name


def _check(path: Path, layers: tuple[tuple[Tensor, Tensor], ...]) -> None:
    hidden = layers[0][0].shape[0]
    expected = ((hidden, LATENT), (hidden, hidden), (6 * _JOINTS, hidden))
    found = tuple(tuple(weight.shape) for weight, _ in layers)
    if found != expected:
        raise UserError(
            f"VPoser file {path} has decoder layers of shapes {found}; expected {expected}: take "
            "the published file."
        )
