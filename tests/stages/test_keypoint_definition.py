"""The definition of a detector's keypoints, averaged over people with depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.body_fit.definition import FITTED_SIGMA_M, average_offsets
from intercap_core.errors import UserError
from intercap_core.schemas import BODY_FIT
from tests.helpers.synthetic_capture import fill

OFFSETS = np.random.default_rng(0).normal(0, 0.02, (4, 25, 3))


def _fit(path: Path, subject: str, offsets: np.ndarray, *, depth: bool = True) -> Path:
    attributes = {"sequence": path.stem, "subject": subject, "gender": "neutral"}
    with artefacts.write(path, BODY_FIT, body_model="", **attributes) as writer:
        writer.put("cloud_residual", [0.01, 0.02, np.nan] if depth else [np.nan, 0.01, np.nan])
        writer.put("keypoint_offsets", offsets)
        fill(writer, BODY_FIT, T=3, C=1, P=1, G=1, K=135)
    return path


@pytest.fixture
def people(tmp_path: Path) -> list[Path]:
    """Fits of three people with depth, the first one twice, then of one with depth in a frame."""
    fits = [_fit(tmp_path / f"{n}.h5", f"p{n}", OFFSETS[n], depth=n < 3) for n in range(4)]
    return [*fits, _fit(tmp_path / "again.h5", "p0", OFFSETS[0] + 0.006)]


def test_people_with_depth_are_averaged_and_the_others_left_out(people: list[Path]) -> None:
    found, names = average_offsets(people)
    assert names == ["p0", "p1", "p2"]
    each = OFFSETS[:3].copy()
    each[0] += 0.003  # the mean of both recordings
    np.testing.assert_allclose(found.offsets, each.mean(0), atol=1e-6)
    scatter = np.sqrt(each.var(0, ddof=1).mean(1))
    np.testing.assert_allclose(found.sigma, np.maximum(scatter, FITTED_SIGMA_M), rtol=1e-4)


def test_too_few_people_are_named(people: list[Path]) -> None:
    with pytest.raises(UserError, match=r"2 people with depth \(p0, p1\).*without depth: 3;"):
        average_offsets([*people[:2], people[3]])
