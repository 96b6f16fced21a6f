"""Left and right as detected, as the result has them, and where they are in doubt."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from intercap_core.annotate import questions, result, sides
from intercap_core.annotate.opened import Opened
from intercap_core.errors import UserError
from intercap_core.output.viewer.page import unpacked
from tests.annotate.served import annotation, artefact, detect


def _doubtful(opened: Opened) -> list[tuple[int, int, str]]:
    return [(doubt.first, doubt.last, doubt.camera) for doubt in sides.doubts(opened)]


def test_payload_has_detected_and_fitted_limbs(opened: Opened) -> None:
    detect(opened.project.path, {"k2": [1, 2]})
    header, arrays = unpacked(sides.sides_payload(opened))
    assert header["cameras"] == ["k1", "k2", "k3"]
    detected, others = arrays["detected"], np.r_[7:14, :7]
    np.testing.assert_allclose(detected[1, 1], detected[0, 1][others], atol=4)  # a moving person
    np.testing.assert_allclose(detected[3, 1], detected[0, 1], atol=12)
    exchanged = (sides.sides_of(opened).exchanged > 0).any(axis=2)
    assert np.argwhere(exchanged).tolist() == [[1, 1], [2, 1]]
    with h5py.File(artefact(opened.project.path, "joint")) as joint:
        left_shoulder = joint["joints"][:, 16]
    np.testing.assert_array_equal(arrays["result"][:, 0], left_shoulder)


def test_exchanges_in_most_views_are_doubtful_until_stated(opened: Opened) -> None:
    detect(opened.project.path, {"k2": [1, 2]})
    assert _doubtful(opened) == []
    detect(opened.project.path, {"k2": [1, 2, 5], "k3": [2, 5]})
    assert _doubtful(opened) == [(2, 5, "k2")]  # a gap of two frames is one place
    assert [p["kind"] for p in result.describe(opened)["places"]].count("sides") == 1
    proposed = [q for q in questions.propose(opened, []) if q["kind"] == "sides"]
    assert [(q["first"], q["last"], q["camera"]) for q in proposed] == [(2, 5, "k2")]
    annotation(opened.project.path).write_text("left_right: [{start: 2, end: 6, camera: k3}]\n")
    assert _doubtful(opened) == []


def test_a_result_that_jumps_to_the_other_side_is_doubted(opened: Opened) -> None:
    detect(opened.project.path, {})
    assert _doubtful(opened) == []
    with h5py.File(artefact(opened.project.path, "joint"), "r+") as joint:
        moved = joint["joints"][...]
        arms = np.array([16, 17, 18, 19, 20, 21])
        moved[3:5, arms] = moved[3:5, arms[[1, 0, 3, 2, 5, 4]]]
        joint["joints"][...] = moved
    assert [(first, last) for first, last, _ in _doubtful(opened)] == [(3, 4)]


def test_a_person_of_other_detections_is_reported(opened: Opened) -> None:
    with h5py.File(artefact(opened.project.path, "person"), "r+") as person:
        person["person"][2, 1] = 4
    with pytest.raises(UserError, match="re-run stage 'person'"):
        sides.sides_payload(opened)
    assert any("re-run stage 'person'" in note for note in result.describe(opened)["notes"])
