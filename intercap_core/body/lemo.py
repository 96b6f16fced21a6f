"""F_S of A.2: the motion encoder of LEMO (Zhang et al. 2021), from the user's own weights.

It sees the steps of 81 markers of the skin (:attr:`BodyModel.markers`) from frame to frame at 30 a
second as an image: a row for each coordinate (marker by marker; x, y, z), a column for each step.
Coordinates are those of the first frame's body: x from the left hip to the right, z up; steps are
divided by the spread of marker coordinates in the data that it was trained on. The image is
continued by its reflection, one row and eight columns at each side; ten convolutions of 3 x 3, with
a leaky ReLU after each, keep its size and end in 64 channels. A column is the latent vector of a
step.

All this is as the release (github.com/sanweiliti/LEMO) states it; the code is our own. Only the
means of the training data are not needed: they cancel in steps.
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

from intercap_core.body.checkpoint import read_checkpoint
from intercap_core.body.maps import MARKER_NAMES
from intercap_core.errors import UserError

FRAMES_PER_SECOND = 30.0
COORDINATES = 3 * len(MARKER_NAMES)
_ROWS, _COLUMNS = 1, 8  # of reflection, at each side
_SLOPE = 0.2
_CHANNELS = (1, 32, 64, 64, 64, 64)
LATENT = _CHANNELS[-1] * (COORDINATES + 2 * _ROWS)
FEWEST_FRAMES = _COLUMNS + 2  # a reflection repeats other columns than the one at the border
_HINT = "take the release's file, or leave joint.lemo out for small accelerations of the joints"


@dataclass(frozen=True)
class MotionEncoder:
    """``blocks``: weights and biases of the five pairs of convolutions; ``spread`` (243,) of the
    coordinates, metres."""

    blocks: tuple[tuple[Tensor, Tensor, Tensor, Tensor], ...]
    spread: Tensor

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

        `UserError` where a file is missing, damaged, or holds something else.
        """
        state, spread = _state(weights), _spread(statistics)
        blocks = []
        for number, (inner, outer) in enumerate(pairwise(_CHANNELS), 1):
            shapes = {
                f"enc_blc{number}.main.0.weight": (outer, inner, 3, 3),
                f"enc_blc{number}.main.0.bias": (outer,),
                f"enc_blc{number}.main.2.weight": (outer, outer, 3, 3),
                f"enc_blc{number}.main.2.bias": (outer,),
            }
            first, first_bias, second, second_bias = (
                _tensor(weights, state, name, shape).to(device, dtype)
                for name, shape in shapes.items()
            )
            blocks.append((first, first_bias, second, second_bias))
        return cls(tuple(blocks), torch.as_tensor(spread, dtype=dtype, device=device))

    def latents(self, steps: Tensor) -> Tensor:
        """Latent vectors (N, 15680) of the steps (N, 243), metres, of N > 8 in a row."""
        image = (steps / self.spread).T[None, None]
        image = functional.pad(image, (_COLUMNS, _COLUMNS, _ROWS, _ROWS), mode="reflect")
        for block in self.blocks:
            if image.requires_grad:  # what is between is computed again for the derivative
                image = checkpoint(_convolve, image, *block, use_reentrant=False)
            else:
                image = _convolve(image, *block)
        return image[0, :, :, _COLUMNS:-_COLUMNS].permute(2, 0, 1).flatten(1)


def _convolve(
    image: Tensor, first: Tensor, first_bias: Tensor, second: Tensor, second_bias: Tensor
) -> Tensor:
    image = functional.leaky_relu(functional.conv2d(image, first, first_bias, padding=1), _SLOPE)
    return functional.leaky_relu(functional.conv2d(image, second, second_bias, padding=1), _SLOPE)


def _state(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise UserError(f"LEMO's encoder {path} does not exist; {_HINT}")
    try:
        read = read_checkpoint(path)
    except Exception as error:  # a damaged file can raise nearly anything
        raise UserError(
            f"LEMO's encoder {path} is damaged or none that torch.save wrote "
            f"({type(error).__name__}), expected Enc_last_model.pkl; {_HINT}"
        ) from error
    if not isinstance(read, dict):
        raise UserError(
            f"LEMO's encoder {path} holds a {type(read).__name__}, expected tensors by name; "
            f"{_HINT}"
        )
    return {str(name): value for name, value in read.items() if isinstance(value, Tensor)}


def _tensor(path: Path, state: dict[str, Tensor], name: str, shape: tuple[int, ...]) -> Tensor:
    if name not in state:
        raise UserError(f"LEMO's encoder {path} has no {name}, expected one {shape}; {_HINT}")
    value = state[name]
    if tuple(value.shape) != shape or not torch.isfinite(value).all():
        found = tuple(value.shape) if tuple(value.shape) != shape else "values that are no numbers"
        raise UserError(f"LEMO's encoder {path}: {name} has {found}, expected {shape}; {_HINT}")
    return value


def _spread(path: Path) -> np.ndarray:
    """Spread (243,) of the coordinates."""
    if not path.is_file():
        raise UserError(f"LEMO's statistics {path} do not exist; {_HINT}")
    try:
        with np.load(path) as read:
            found = {name: read[name] for name in read.files}
    except Exception as error:  # not an archive, cut short, or pickled objects
        raise UserError(
            f"LEMO's statistics {path} cannot be read ({type(error).__name__}: {error}), expected "
            f"an .npz with Xstd; {_HINT}"
        ) from None
    if "Xstd" not in found:
        raise UserError(
            f"LEMO's statistics {path} hold {', '.join(found) or 'nothing'}, expected Xstd; {_HINT}"
        )
    spread = found["Xstd"]
    if spread.shape != (COORDINATES,):
        raise UserError(
            f"LEMO's statistics {path}: Xstd has {spread.shape}, expected ({COORDINATES},) for "
            f"{len(MARKER_NAMES)} markers; {_HINT}"
        )
    if not (np.isfinite(spread) & (spread > 0)).all():
        raise UserError(
            f"LEMO's statistics {path}: Xstd has {spread[~(spread > 0)][:1]}, expected numbers "
            f"above 0; {_HINT}"
        )
    return spread
