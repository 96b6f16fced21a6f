"""LEMO's encoder, with random numbers in files of the release's names and shapes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from intercap_core.body.lemo import FEWEST_FRAMES, MotionEncoder
from intercap_core.errors import UserError
from tests.helpers.bodies import random_normal
from tests.helpers.lemo_release import (
    COORDINATES,
    SPREAD,
    random_encoder,
    random_state,
    write_release,
)


def _load(folder: Path) -> MotionEncoder:
    return MotionEncoder.load(*write_release(folder), dtype=torch.float64)


def _by_hand(state: dict[str, torch.Tensor], steps: np.ndarray) -> np.ndarray:
    """Latents (N, 64, 245) by sums over shifted images."""
    image = np.pad(steps.T, ((1, 1), (8, 8)), mode="reflect")[None]
    rows, columns = image.shape[1:]
    for block in range(1, 6):
        for layer in (0, 2):
            name = f"enc_blc{block}.main.{layer}"
            weight = state[f"{name}.weight"].double().numpy()
            bordered = np.pad(image, ((0, 0), (1, 1), (1, 1)))
            total = np.zeros((len(weight), rows, columns))
            for i in range(3):
                for j in range(3):
                    shifted = bordered[:, i : i + rows, j : j + columns]
                    total += np.einsum("oc,cij->oij", weight[:, :, i, j], shifted)
            total += state[f"{name}.bias"].double().numpy()[:, None, None]
            image = np.where(total > 0, total, 0.2 * total)
    return image[:, :, 8:-8].transpose(2, 0, 1)


def test_latents_equal_convolutions_in_numpy(tmp_path: Path) -> None:
    steps = random_normal(FEWEST_FRAMES - 1, COORDINATES) * 0.02
    found = _load(tmp_path).latents(steps)
    assert found.shape == (FEWEST_FRAMES - 1, 64 * 245)
    expected = _by_hand(random_state(), steps.numpy() / SPREAD)
    np.testing.assert_allclose(found.reshape(expected.shape), expected, atol=1e-9)


def test_derivative_with_recomputed_activations_is_exact() -> None:
    encoder, steps = random_encoder(), random_normal(12, COORDINATES) * 0.02
    along = random_normal(12, COORDINATES)
    _, forward = torch.func.jvp(encoder.latents, (steps,), (along,))
    weight = random_normal(*forward.shape, seed=1)
    (backward,) = torch.autograd.grad(encoder.latents(steps.requires_grad_()), steps, weight)
    torch.testing.assert_close((forward * weight).sum(), (backward * along).sum())


def _change(name: str, value: torch.Tensor | None) -> Callable[[Path, Path], None]:
    def write(weights: Path, _: Path) -> None:
        state = random_state()
        del state[name]
        torch.save(state if value is None else state | {name: value}, weights)

    return write


def _statistics(**values: np.ndarray) -> Callable[[Path, Path], None]:
    return lambda _, statistics: np.savez(statistics, **values)


_FIRST = "enc_blc1.main.0.weight"
MISTAKES: dict[str, tuple[Callable[[Path, Path], object], list[str]]] = {
    "no weights": (lambda weights, _: weights.unlink(), ["Enc_last_model.pkl", "No such file"]),
    "no statistics": (lambda _, statistics: statistics.unlink(), [".npz", "No such file"]),
    "damaged weights": (
        lambda weights, _: weights.write_bytes(b"PK\x03\x04 cut"),
        ["Enc_last_model.pkl", "damaged", "torch.save"],
    ),
    "a list": (lambda weights, _: torch.save([1, 2], weights), ["list", "tensors by name"]),
    "a layer missing": (_change("enc_blc5.main.2.bias", None), ["enc_blc5.main.2.bias", "(64,)"]),
    "the larger encoder": (
        _change("enc_blc3.main.0.weight", torch.zeros(128, 64, 3, 3)),
        ["enc_blc3.main.0.weight", "(128, 64, 3, 3)", "expected (64, 64, 3, 3)"],
    ),
    "not a number": (
        _change(_FIRST, torch.full((32, 1, 3, 3), torch.nan)),
        [_FIRST, "values that are not finite"],
    ),
    "no archive": (
        lambda _, statistics: statistics.write_text("Xstd"),
        [".npz", "not a readable .npz", "Xstd"],
    ),
    "other statistics": (_statistics(Xmean=np.zeros(3)), ["contain Xmean", "expected Xstd"]),
    "67 markers": (_statistics(Xstd=np.ones(201)), ["(201,)", "(243,)", "81 markers"]),
    "no spread": (_statistics(Xstd=np.zeros(243)), ["Xstd has [0.]", "above 0"]),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_wrong_files_are_reported(name: str, tmp_path: Path) -> None:
    files = write_release(tmp_path)
    spoil, expected = MISTAKES[name]
    spoil(*files)
    with pytest.raises(UserError) as caught:
        MotionEncoder.load(*files)
    for words in [*expected, "joint.lemo"]:
        assert words in str(caught.value)
