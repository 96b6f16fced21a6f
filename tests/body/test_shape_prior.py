"""The prior of the shape by gender and height, and shapes in its units."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from intercap_core.body.loading import HEIGHT_SIGMA_M, BodyArrays, ShapePrior, load_body_file


@pytest.fixture(scope="module")
def file() -> BodyArrays:
    return load_body_file(None, 10, 10)


def _heights(prior: ShapePrior, file: BodyArrays) -> np.ndarray:
    """Of 400 people (400,), metres."""
    z = torch.as_tensor(np.random.default_rng(0).standard_normal((400, 10)))
    betas = prior.betas(z).numpy()
    crown, sole = file.template[:, 1].argmax(), file.template[:, 1].argmin()
    by_shape = file.shape_directions[crown, 1] - file.shape_directions[sole, 1]
    return np.ptp(file.template[:, 1]) + betas @ by_shape


def test_the_neutral_prior_is_the_files_own(file: BodyArrays) -> None:
    prior = ShapePrior.of(file, "neutral")
    np.testing.assert_array_equal(prior.mean, 0)
    np.testing.assert_array_equal(prior.root, np.eye(10))
    np.testing.assert_array_equal(prior.centred(file).template, file.template)


def test_heights_of_women_and_men_are_those_of_adults(file: BodyArrays) -> None:
    """About 1.64 +- 0.08 m and 1.76 +- 0.08 m."""
    women, men = (_heights(ShapePrior.of(file, who), file) for who in ("female", "male"))
    assert women.mean() == pytest.approx(1.63, abs=0.02)
    assert men.mean() == pytest.approx(1.745, abs=0.02)
    assert 0.06 < women.std() < 0.09 and 0.06 < men.std() < 0.09


@pytest.mark.parametrize("gender", ["female", "male", "neutral"])
@pytest.mark.parametrize("height", [1.52, 1.90])
def test_a_stated_height_narrows_one_direction(
    file: BodyArrays, gender: str, height: float
) -> None:
    before, after = ShapePrior.of(file, gender), ShapePrior.of(file, gender, height)
    heights = _heights(after, file)
    assert heights.mean() == pytest.approx(height, abs=0.02)
    assert heights.std() < HEIGHT_SIGMA_M
    # nine directions are as wide as before
    narrower = np.linalg.eigvals(
        np.linalg.solve(before.root @ before.root.T, after.root @ after.root.T)
    )
    assert (np.abs(narrower - 1) < 1e-6).sum() == 9


def test_shapes_in_units_of_the_prior_are_the_same_bodies(file: BodyArrays) -> None:
    prior = ShapePrior.of(file, "male", 1.9)
    z = np.random.default_rng(1).standard_normal(10)
    centred = prior.centred(file)
    ours = centred.template + centred.shape_directions @ z
    betas = prior.betas(torch.as_tensor(z)).numpy()
    np.testing.assert_allclose(ours, file.template + file.shape_directions @ betas, atol=1e-9)


def test_a_licensed_file_has_its_own_gender(file: BodyArrays) -> None:
    other = replace(file, path=Path("SMPLX_MALE.npz"))
    np.testing.assert_array_equal(ShapePrior.of(other, "male").mean, 0)
