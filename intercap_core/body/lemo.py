"""F_S of A.2: the motion encoder of LEMO (Zhang et al. 2021), from the user's own weights.

A step is the displacement of the 81 skin markers (:attr:`BodyModel.markers`) from one frame to the
next at 30 Hz. The encoder's input is an image: one column for each step, one row for each
coordinate (marker by marker; x, y, z). Coordinates are in the frame of the first body: x from the
left hip to the right, z up. Steps are divided by the standard deviation of the marker coordinates
in the training data. The image is padded by reflection, one row and eight columns at each side. Ten
convolutions of 3 x 3, each with a leaky ReLU, keep its size and end in 64 channels. A column of the
output is the latent vector of a step.

All this follows the release (github.com/sanweiliti/LEMO); the code is our own. The means of the
training data are not needed: they cancel in the displacements.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from intercap_core.body.checkpoint import read_tensors, tensor_fault
from intercap_core.body.maps import MARKER_NAMES
from intercap_core.errors import UserError
from intercap_core.inputs.arrays import read_arrays
from intercap_core.inputs.files import UnreadableFile

FRAMES_PER_SECOND = 30.0  # of the network's input (Zhang et al. 2021)
COORDINATES = 3 * len(MARKER_NAMES)
_ROWS, _COLUMNS = 1, 8  # of reflection, at each side (Zhang et al. 2021)
_CHANNELS = (1, 32, 64, 64, 64, 64)  # before and after each block (Zhang et al. 2021)
# F frames have F - 1 steps, and a reflection by _COLUMNS needs one column more than that
FEWEST_FRAMES = _COLUMNS + 2
_HINT = "take the release's file, or remove joint.lemo to penalise joint accelerations instead"


@dataclass(frozen=True)
class MotionEncoder:
    """LEMO's motion encoder."""

    blocks: tuple[tuple[Tensor, Tensor, Tensor, Tensor], ...]
    """Weight, bias, weight, bias of each of the five pairs of convolutions."""
    spread: Tensor
    """(243,) standard deviation of the coordinates, metres."""

    @classmethod
    def load(
        cls,
        weights: Path,
        statistics: Path,
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> MotionEncoder:
        """Read the encoder's state (`Enc_last_model.pkl`) and the statistics' `Xstd`.

        Raises UserError if a file is missing, damaged, or contains something else.
        """
        state, spread = _read_state(weights), _read_spread(statistics)
        blocks = []
        for number, (inner, outer) in enumerate(pairwise(_CHANNELS), 1):
            shapes = {
                f"enc_blc{number}.main.0.weight": (outer, inner, 3, 3),
                f"enc_blc{number}.main.0.bias": (outer,),
                f"enc_blc{number}.main.2.weight": (outer, outer, 3, 3),
                f"enc_blc{number}.main.2.bias": (outer,),
            }
            first, first_bias, second, second_bias = (
                _pick_tensor(weights, state, name, shape).to(device, dtype)
                for name, shape in shapes.items()
            )
            blocks.append((first, first_bias, second, second_bias))
        return cls(tuple(blocks), torch.as_tensor(spread, dtype=dtype, device=device))

    def latents(self, steps: Tensor) -> Tensor:
        """Return latent vectors (N, 15680), 64 channels x 245 rows, of N > 8 consecutive steps.

        steps (N, 243): marker displacements, metres.
        """
        image = (steps / self.spread).T[None, None]
        image = functional.pad(image, (_COLUMNS, _COLUMNS, _ROWS, _ROWS), mode="reflect")
        for block in self.blocks:
            if image.requires_grad:  # activations are computed again for the derivative
                image = checkpoint(_convolve, image, *block, use_reentrant=False)
            else:
                image = _convolve(image, *block)
        return image[0, :, :, _COLUMNS:-_COLUMNS].permute(2, 0, 1).flatten(1)


def _convolve(
    image: Tensor, first: Tensor, first_bias: Tensor, second: Tensor, second_bias: Tensor
) -> Tensor:
    """Return the image (1, C, H, W) after two convolutions, each with a leaky ReLU."""
    image = functional.leaky_relu(functional.conv2d(image, first, first_bias, padding=1), 0.2)
    return functional.leaky_relu(functional.conv2d(image, second, second_bias, padding=1), 0.2)


def _read_state(path: Path) -> dict[str, Tensor]:
    try:
        return read_tensors(path, advice=_HINT)
    except UnreadableFile as error:
        raise UserError(
            f"LEMO's encoder {path} {error.reason}, expected Enc_last_model.pkl; {_HINT}"
        ) from error


def _pick_tensor(path: Path, state: dict[str, Tensor], name: str, shape: tuple[int, ...]) -> Tensor:
    """Return a tensor of the state; raises UserError if it is missing or of another shape."""
    if name not in state:
        raise UserError(f"LEMO's encoder {path} has no {name}, expected one {shape}; {_HINT}")
    fault = tensor_fault(state[name], shape, largest=1e4)  # far beyond those of a trained network
    if fault is not None:
        raise UserError(f"LEMO's encoder {path}: {name} has {fault}, expected {shape}; {_HINT}")
    return state[name]


def _read_spread(path: Path) -> np.ndarray:
    """Read the standard deviation (243,) of the coordinates."""
    try:
        arrays = read_arrays(path, advice=_HINT)
    except UnreadableFile as error:
        raise UserError(
            f"LEMO's statistics: {path} {error.reason}, expected an .npz with Xstd; {_HINT}"
        ) from None
    if "Xstd" not in arrays:
        raise UserError(
            f"LEMO's statistics {path} contain {', '.join(arrays) or 'nothing'}, expected Xstd; "
            f"{_HINT}"
        )
    spread = arrays["Xstd"]
    fault = ""
    if spread.shape != (COORDINATES,):
        fault = f"{spread.shape}, expected ({COORDINATES},) for {len(MARKER_NAMES)} markers"
    elif spread.dtype.kind != "f":
        fault = f"{spread.dtype}, expected metres"
    # markers of a body that walks through a room: some decimetres
    elif (wrong := ~((spread > 1e-4) & (spread < 100.0))).any():
        fault = f"{spread[wrong][:1]}, expected metres above 0, 0.0001 to 100"
    if fault:
        raise UserError(f"LEMO's statistics {path}: Xstd has {fault}; {_HINT}")
    return spread
