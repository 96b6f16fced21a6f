"""The definition of a detector's keypoints, learned from people with depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.body_fit.definition import FITTED_SIGMA_M, average_offsets
from intercap_core.entries import SubjectEntry
from intercap_core.errors import UserError
from intercap_core.schemas import BODY_FIT
from tests.helpers.bodies import open_body
from tests.stages.test_body_fit import BODY_ALONE, Capture


@pytest.fixture(scope="module")
def people(tmp_path_factory) -> list[Path]:
    """Fits of three people with depth, then of one without."""
    model, found = open_body(), []
    for number in range(4):
        folder = tmp_path_factory.mktemp("person")
        capture = Capture(model, folder, 3, cameras=4, pixel_noise=0.5, depth=number < 3)
        found.append(folder / "body_fit.h5")
        subject = SubjectEntry(subject=f"p{number}", gender="neutral")
        capture.fit(found[-1], subject=subject, settings=BODY_ALONE)
    return found


def test_people_with_depth_are_averaged_and_the_others_left_out(people: list[Path]) -> None:
    found, names = average_offsets(people)
    assert names == ["p0", "p1", "p2"]
    each = []
    for path in people[:3]:
        with artefacts.read(path, BODY_FIT) as fit:
            each.append(fit["keypoint_offsets"])
    np.testing.assert_allclose(found.offsets, np.mean(each, axis=0), atol=1e-6)
    assert (found.sigma >= FITTED_SIGMA_M).all()


def test_too_few_people_are_named(people: list[Path]) -> None:
    with pytest.raises(UserError, match=r"2 people with depth \(p0, p1\).*without depth"):
        average_offsets([*people[:2], people[3]])
