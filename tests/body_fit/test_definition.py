"""A detector's definition: written, read, and as the prior of the offsets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from intercap_core.body_fit.definition import POINTS, UNKNOWN_SIGMA_M, Definition
from intercap_core.body_fit.problem import ParameterLayout
from intercap_core.config import BodyFitSettings
from intercap_core.errors import UserError


def _some(seed: int = 0) -> Definition:
    random = np.random.default_rng(seed)
    return Definition(random.normal(0, 0.01, (25, 3)).round(4), np.full(25, 0.004))


def test_a_table_is_read_as_it_was_written(tmp_path: Path) -> None:
    given = _some()
    given.write(tmp_path / "own.tsv", "a lab")
    found = Definition.read(tmp_path / "own.tsv")
    np.testing.assert_allclose(found.offsets, given.offsets, atol=1e-9)
    np.testing.assert_allclose(found.sigma, given.sigma)
    assert (tmp_path / "own.tsv").read_text().startswith("# a lab\npoint\tx_mm")


def test_without_a_table_offsets_are_zero() -> None:
    found = Definition.read(None)
    assert not found.offsets.any() and (found.sigma == UNKNOWN_SIGMA_M).all()


def test_the_packaged_table_is_found_by_its_name() -> None:
    named = BodyFitSettings.model_validate({"keypoint_definition": "mediapipe"})
    offsets = dict(zip(POINTS, Definition.read(named.keypoint_definition).offsets, strict=True))
    # MediaPipe's ankles are above those of the model, and its ears are farther out
    assert offsets["left_ankle"][1] > 0.01 and offsets["right_ankle"][1] > 0.01
    assert offsets["left_ear"][0] < -0.02 < 0.02 < offsets["right_ear"][0]
    own = BodyFitSettings.model_validate({"keypoint_definition": "lab/own.tsv"})
    assert own.keypoint_definition == Path("lab/own.tsv")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("x_mm", "x"), "columns are"),
        (lambda text: text.replace(POINTS[3] + "\t", "shin\t"), "shin"),
        (lambda text: text + text.splitlines()[2] + "\n", "a point is repeated"),
        (lambda text: text.replace(POINTS[0] + "\t", POINTS[0] + "\tfar"), "three offsets"),
        (lambda text: text.replace("\t4.0\n", "\t0.0\n"), "deviation above 0"),
        (lambda text: text.replace("\t4.0\n", "\tnan\n"), "deviation above 0"),
        (lambda text: text.replace(POINTS[1] + "\t", POINTS[1] + "\t9"), "at most 100"),
        (lambda text: "", "columns are missing"),
    ],
)
def test_bad_tables_are_reported(tmp_path: Path, change, message: str) -> None:
    path = tmp_path / "own.tsv"
    replace(_some(), offsets=np.full((25, 3), 0.01)).write(path, "a lab")
    path.write_text(change(path.read_text().replace("\t10.0", "\t10.5")))
    with pytest.raises(UserError, match=message) as error:
        Definition.read(path)
    assert str(path) in str(error.value) and "keypoint-definition" in str(error.value)


def test_a_folder_or_missing_file_is_reported(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.tsv"):
        with pytest.raises(UserError, match="no readable text"):
            Definition.read(path)


def test_prior_of_offsets_is_centred_on_the_definition() -> None:
    known = _some(1)
    layout = ParameterLayout(torch.arange(3), 10, True, True, known)
    at = torch.as_tensor(known.offsets).reshape(-1)
    mean = torch.cat([torch.zeros(10).double(), at, torch.zeros(9).double()])
    assert layout.prior_cost(mean) == 0
    step = torch.as_tensor(np.random.default_rng(2).normal(0, 1e-3, len(mean)))
    wide = ParameterLayout(torch.arange(3), 10, True, True, Definition.unknown())
    assert layout.prior_cost(mean + step) > wide.prior_cost(step)
