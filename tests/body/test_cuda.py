"""The body on a GPU: the same numbers as on the CPU. Skipped where there is none."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from intercap_core.body.model import BodyModel

from .conftest import random_vector

DEVICE = "cuda"
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


@pytest.mark.parametrize("file", ["open", "full"])
def test_values_and_derivatives_are_those_of_the_cpu(file: str, full_file: Path) -> None:
    path = None if file == "open" else full_file
    here = BodyModel.load(path, dtype=torch.float64)
    there = BodyModel.load(path, device=DEVICE, dtype=torch.float64)
    vector = random_vector(3, here.num_parameters, 1, torch.float64)
    params, far = here.parameters(vector), there.parameters(vector.to(DEVICE))
    ids = torch.arange(0, here.num_vertices, 97)
    ours, theirs = here.forward(params), there.forward(far)
    values = [
        (ours.vertices, theirs.vertices),
        (ours.joints, theirs.joints),
        (here.keypoints_of(params), there.keypoints_of(far)),
        tuple(
            model.linearise(own, vertex_ids=ids, joints=True).full()
            for model, own in ((here, params), (there, far))
        ),
    ]
    for expected, found in values:
        assert found.device.type == DEVICE
        assert (found.cpu() - expected).abs().max() < 1e-10
