"""How far keypoints are trusted by their confidence."""

from __future__ import annotations

import pytest
import torch

from intercap_core.body_fit.evidence import measured_doubt


def _errors(power: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Confidences (4000,) and lengths of errors that grow with a power of them, a tenth wild."""
    random = torch.Generator().manual_seed(0)
    confidence = 0.2 + 0.75 * torch.rand(4000, generator=random)
    error = 0.005 * confidence**-power * torch.randn(4000, generator=random).abs()
    error[::10] = 0.3
    return confidence, error


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 1.7])
def test_the_power_is_found_among_outliers(power):
    assert measured_doubt(*_errors(power)) == pytest.approx(power, abs=0.15)


def test_one_confidence_for_all_or_few_keypoints_say_nothing():
    _, error = _errors(1.0)
    assert measured_doubt(torch.full_like(error, 0.9), error) == 0
    assert measured_doubt(*(x[:100] for x in _errors(1.0))) == 0


def test_surer_keypoints_are_never_trusted_less():
    confidence, error = _errors(1.0)
    assert measured_doubt(1.2 - confidence, error) == 0
