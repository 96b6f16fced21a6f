"""E_theta_b of equation 2 by VPoser (Pavlakos et al. 2019), from the user's own weights.

Version 1 (`TR00_E096.pt`) and version 2 (`V02_05`, a Lightning checkpoint) decode a code of 32
numbers to the 21 body rotations by three linear layers. They differ in key names and in the slope
of the leaky ReLU, and their codes are not interchangeable. The prior of a code is standard normal.

The paper fits the code z. Here the parameter of the fit remains the pose theta, which may differ
from a decoded pose by some degrees. Observations can then determine poses that the network does not
reconstruct exactly:

    E_theta_b(theta) = min over z of |z|^2 / 2 + |theta - decode(z)|^2 / (2 s^2),

with the standard deviation s of the difference. For s = 0 this is the paper's |z|^2, up to its
weight. Linearised at the best code, it is a Gaussian over theta (:class:`PoseGaussian`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from intercap_core.body.checkpoint import read_tensors, tensor_fault
from intercap_core.body.parameters import POSE_BLOCKS
from intercap_core.errors import UserError
from intercap_core.inputs.files import UnreadableFile

LATENT = 32  # length of a code (Pavlakos et al. 2019)
# Version: names of the three layers, slope of the leaky ReLU (published code).
_VERSIONS = {
    1: (("bodyprior_dec_fc1", "bodyprior_dec_fc2", "bodyprior_dec_out"), 0.2),
    2: (("decoder_net.0", "decoder_net.3", "decoder_net.5"), 0.01),
}
_PREFIXES = ("module.", "vp_model.")
_SPREAD = 0.1  # s, rad; poses of AMASS are reconstructed to about 5 degrees (paper)
_ADVICE = (
    "expected TR00_E096.pt (version 1) or a V02_05 .ckpt (version 2): take the published file, or "
    "leave the setting out to use joint limits only"
)


class PoseGaussian(NamedTuple):
    """A Gaussian prior of the body pose, for each of B bodies."""

    mean: Tensor
    """(B, 63) axis-angles of the 21 body joints, rad."""
    precision: Tensor
    """(B, 63, 63) inverse covariance, 1/rad^2."""

    def of_frames(self, index: Tensor) -> PoseGaussian:
        """Return the prior of the frames ``index``."""
        return PoseGaussian(self.mean[index], self.precision[index])


@dataclass(frozen=True)
class VPoser:
    """The decoder of VPoser."""

    version: int
    layers: tuple[tuple[Tensor, Tensor], ...]
    """Weight and bias of the three linear layers."""
    slope: float
    """Slope of the leaky ReLU between them."""

    @classmethod
    def load(
        cls,
        path: Path,
        version: Literal[1, 2] | None = None,
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> VPoser:
        """Read the weights. Without ``version``, their names determine it.

        Raises UserError if the file is missing, or contains no decoder of this version.
        """
        try:
            tensors = read_tensors(path, advice=_ADVICE)
        except UnreadableFile as error:
            raise UserError(f"VPoser file {path} {error.reason}: {_ADVICE}.") from error
        weights = {_bare(name): value for name, value in tensors.items()}
        for stored, (names, slope) in _VERSIONS.items():
            parts = [(f"{name}.weight", f"{name}.bias") for name in names]
            if all(part in weights for pair in parts for part in pair):
                if version not in (None, stored):
                    raise UserError(
                        f"VPoser file {path} contains the weights of version {stored}, and version "
                        f"{version} is named: codes of the two mean different poses; name version "
                        f"{stored}, or take the file of version {version}."
                    )
                _check(path, weights, parts)
                layers = tuple(
                    (weights[w].to(device, dtype), weights[b].to(device, dtype)) for w, b in parts
                )
                return cls(stored, layers, slope)
        raise UserError(
            f"VPoser file {path} has no decoder of version 1 or 2: expected keys such as "
            "bodyprior_dec_fc1.weight or vp_model.decoder_net.0.weight; take the published file."
        )

    def rotations(self, code: Tensor) -> Tensor:
        """Decode codes (B,32) to rotations (B,21,3,3).

        The network outputs two columns of each rotation, which are orthonormalised (Gram-Schmidt).
        """
        x = code
        for weight, bias in self.layers[:-1]:
            x = functional.leaky_relu(functional.linear(x, weight, bias), self.slope)
        x = functional.linear(x, *self.layers[-1]).reshape(*code.shape[:-1], -1, 3, 2)
        first = functional.normalize(x[..., 0], dim=-1)
        second = x[..., 1] - (first * x[..., 1]).sum(-1, keepdim=True) * first
        second = functional.normalize(second, dim=-1)
        third = torch.linalg.cross(first, second, dim=-1)
        return torch.stack([first, second, third], -1)

    def decode(self, code: Tensor) -> Tensor:
        """Decode codes (B,32) to body_pose (B,63), axis-angle."""
        return axis_angle_from_rotation(self.rotations(code)).reshape(*code.shape[:-1], 63)

    def linearise(self, body_pose: Tensor) -> PoseGaussian:
        """Return the prior at poses (B,63), linearised at their most likely codes.

        Twelve Levenberg-Marquardt steps, batched over the poses, find the codes.
        """
        code = body_pose.new_zeros(len(body_pose), LATENT)
        eye = torch.eye(LATENT, dtype=code.dtype, device=code.device)
        decoded, by_code = self.decode_with_jacobian(code)
        cost = self._cost(code, decoded, body_pose)
        # in units of the prior's precision; it starts above 0, since the decoder is not linear
        damping = torch.full_like(cost, 0.3)
        for _ in range(12):
            gradient = code - (by_code.mT @ (body_pose - decoded)[..., None])[..., 0] / _SPREAD**2
            hessian = by_code.mT @ by_code / _SPREAD**2 + (1 + damping)[:, None, None] * eye
            trial = code - torch.linalg.solve(hessian, gradient)
            trial_decoded, trial_by = self.decode_with_jacobian(trial)
            trial_cost = self._cost(trial, trial_decoded, body_pose)
            better = trial_cost <= cost
            code = torch.where(better[:, None], trial, code)
            decoded = torch.where(better[:, None], trial_decoded, decoded)
            by_code = torch.where(better[:, None, None], trial_by, by_code)
            cost = torch.where(better, trial_cost, cost)
            damping = torch.where(better, 0.3 * damping, 10 * damping + 1)
        # theta = decoded + J (z - code) + noise with z standard normal and noise of deviation s, so
        # theta has the covariance J J^T + s^2 I
        mean = decoded - (by_code @ code[..., None])[..., 0]
        pose_eye = torch.eye(body_pose.shape[1], dtype=code.dtype, device=code.device)
        covariance = by_code @ by_code.mT + _SPREAD**2 * pose_eye
        precision = torch.linalg.inv(covariance)
        return PoseGaussian(mean, 0.5 * (precision + precision.mT))

    def _cost(self, code: Tensor, decoded: Tensor, body_pose: Tensor) -> Tensor:
        """Return the cost (B,) of codes (B,32) that decode to ``decoded`` (B,63)."""
        away = (body_pose - decoded) / _SPREAD
        return 0.5 * ((code**2).sum(1) + (away**2).sum(1))

    def decode_with_jacobian(self, code: Tensor) -> tuple[Tensor, Tensor]:
        """Return body_pose (B,63) and its derivative by the code (B,63,32)."""
        jacobian = torch.func.vmap(torch.func.jacfwd(self.decode))(code)
        return self.decode(code), jacobian


def axis_angle_from_rotation(rotation: Tensor) -> Tensor:
    """Return axis-angles (...,3) of rotations (...,3,3) by less than pi, smooth through zero."""
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
    small = sine_squared < 1e-7
    sine = torch.where(small, torch.ones_like(sine_squared), sine_squared).sqrt()
    angle = torch.atan2(sine, (trace - 1) / 2)
    factor = torch.where(small, 0.5 + sine_squared / 12, angle / (2 * sine))
    return factor[..., None] * skewed


def _bare(name: str) -> str:
    """Return the name of a weight without the prefixes of training frameworks."""
    for prefix in _PREFIXES:
        name = name.removeprefix(prefix)
    return name


def _check(path: Path, weights: dict[str, Tensor], layers: list[tuple[str, str]]) -> None:
    """Raise UserError if the weights and biases cannot be those of a decoder."""
    first = weights[layers[0][0]]
    hidden = min(max(len(first) if first.ndim else 0, 1), 4096)  # the published files have 512
    # the last layer outputs two columns of each rotation
    sizes = ((hidden, LATENT), (hidden, hidden), (2 * dict(POSE_BLOCKS)["body_pose"], hidden))
    for (weight, bias), size in zip(layers, sizes, strict=True):
        for name, shape in ((weight, size), (bias, size[:1])):
            # weights of the published files are below 10
            fault = tensor_fault(weights[name], shape, largest=1e3)
            if fault is not None:
                raise UserError(f"VPoser file {path}: {name} has {fault}: take the published file.")
        if not bool(weights[weight].any()):
            raise UserError(
                f"VPoser file {path}: {weight} is zero, so that every code decodes to one pose: "
                "take the published file."
            )
