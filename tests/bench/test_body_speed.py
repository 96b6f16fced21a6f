"""By which rules the body's fit and the paper's recipe are compared, and the peers' agreement."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from bench.body_forward import _body_models, _smplfitter, write_files
from bench.body_speed import moment
from intercap_core.body.model import BodyModel


def test_the_first_moment_as_good_as_wanted() -> None:
    assert moment(np.array([20.0, 9.0, 7.1, 6.0]), 7.0) == (2, True)


def test_the_first_moment_near_the_best_where_none_is_as_good() -> None:
    assert moment(np.array([20.0, 9.0, 8.3, 8.0, 8.1]), 7.0) == (2, False)


def test_the_peers_pose_the_same_file_as_we_do(tmp_path: Path) -> None:
    full, short = write_files(tmp_path)
    model = BodyModel.load(full)
    x = 0.3 * torch.randn(2, model.num_parameters, generator=torch.Generator().manual_seed(0))
    ours = model.forward(model.parameters(x)).vertices
    assert (_body_models(model, full)(x) - ours).abs().max() < 1e-5
    pytest.importorskip("smplfitter")
    assert (_smplfitter(model, short)(x) - ours).abs().max() < 1e-5
