"""Settings as people write them: inputs of public bug reports."""

from __future__ import annotations

import numpy as np

from intercap_core.formats.recordings.layouts import open_layout
from tests.cases import SEQUENCE, check, open_case


def test_frame_numbers_with_leading_zeros_are_decimal(tmp_path):
    annotation = open_case("b24", tmp_path).annotation(SEQUENCE)
    assert tuple(annotation.drop_frames) == (10, 11)
    (contact,), (pose,) = annotation.contact, annotation.object_poses
    assert (contact.start, contact.end, pose.frame) == (12, 17, 10)


def test_cameras_named_by_numbers(tmp_path):
    project = open_case("b04_numbers", tmp_path)
    assert "3 cameras" in check(project).summary
    extrinsics = open_layout(project.sequences[SEQUENCE]).extrinsics
    assert extrinsics.master == "1" and set(extrinsics.master_from_colour) == {"1", "2", "3"}
    np.testing.assert_allclose(extrinsics.master_from_colour["1"], np.eye(4), atol=1e-9)
