"""Proposed frame and symmetry of a mesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from intercap_core.entries import Symmetry
from intercap_core.geometry.camera.transforms import apply, rigid, rotation_exp
from intercap_core.scan.proposal import propose_symmetry, standing_frame

UP = np.array([0.0, -1.0, 0.0])  # of a camera: y down


def in_frame(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """The mesh in its standing frame, from a tilted pose in a camera's frame."""
    tilted = rigid(rotation_exp(np.array([np.pi / 2 + 0.05, 0.0, 0.03])), np.array([0.3, 0.2, 2.0]))
    vertices = apply(tilted, np.asarray(mesh.vertices))
    frame = standing_frame(vertices, mesh.faces, UP)
    return apply(frame, vertices), mesh.faces


def test_a_cylinder_stands_on_its_axis_and_turns_about_it() -> None:
    vertices, faces = in_frame(trimesh.creation.cylinder(0.04, 0.2, sections=64))
    np.testing.assert_allclose(np.ptp(vertices, axis=0), (0.08, 0.08, 0.2), atol=1e-3)
    found = propose_symmetry(vertices, faces)
    assert [s.axis for s in found.symmetry.continuous] == [(0.0, 0.0, 1.0)]
    assert "all turns about z, 0." in found.words


def test_a_box_has_half_turns_and_its_longest_side_along_x() -> None:
    vertices, faces = in_frame(trimesh.creation.box((0.2, 0.1, 0.3)))
    np.testing.assert_allclose(np.ptp(vertices, axis=0), (0.2, 0.1, 0.3), atol=1e-9)
    found = propose_symmetry(vertices, faces).symmetry
    assert len(found.discrete) == 3 and not found.continuous


def test_a_square_prism_has_quarter_turns() -> None:
    found = propose_symmetry(*in_frame(trimesh.creation.box((0.1, 0.1, 0.3))))
    assert "4 turns about z" in found.words


def test_a_ball_is_a_sphere() -> None:
    found = propose_symmetry(*in_frame(trimesh.creation.icosphere(4, radius=0.1)))
    assert found.symmetry.sphere


def test_a_handle_breaks_the_symmetry() -> None:
    body = trimesh.creation.cylinder(0.04, 0.1, sections=64)
    handle = trimesh.creation.box((0.04, 0.015, 0.06))
    handle.apply_translation((0.06, 0, 0.015))
    vertices, faces = in_frame(trimesh.util.concatenate([body, handle]))
    found = propose_symmetry(vertices, faces)
    assert found.symmetry == Symmetry()
    assert "none; the nearest is 2 turns about" in found.words


@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_the_frame_does_not_depend_on_the_pose_about_the_vertical(turn: float) -> None:
    box = trimesh.creation.box((0.2, 0.1, 0.3))
    vertices = apply(
        rigid(rotation_exp(turn * UP), np.zeros(3)), np.asarray(box.vertices)[:, [0, 2, 1]]
    )
    frame = standing_frame(vertices, box.faces[:, ::-1], UP)
    np.testing.assert_allclose(np.ptp(apply(frame, vertices), axis=0), (0.2, 0.1, 0.3), atol=1e-9)
