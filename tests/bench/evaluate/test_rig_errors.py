"""Errors of found rigs: the choice of the world, and ratios over recordings."""

from __future__ import annotations

import numpy as np
import pytest

from bench.evaluate.rig_errors import ChainErrors, RigErrors, figures, truth_from_rig
from intercap_core.geometry.camera.transforms import invert, rigid, rotation_exp
from tests.calibrate.plain_project import small_ring

MOVED = rigid(rotation_exp(np.array([0.2, -0.5, 0.3])), np.array([0.4, -0.1, 0.7]))


def test_a_rig_in_another_world_is_aligned_exactly() -> None:
    true = small_ring()[0].master_from_colour
    assert np.allclose(truth_from_rig(MOVED @ true, true), invert(MOVED))


def test_all_cameras_count_alike_not_the_master_alone() -> None:
    true = small_ring(4)[0].master_from_colour
    poses = true.copy()
    poses[0, :3, 3] += 0.04  # the master alone is off
    moved = truth_from_rig(poses, true)
    assert np.allclose(moved[:3, :3], np.eye(3))
    assert np.allclose(moved[:3, 3], -0.01)


def test_the_ratio_is_the_median_over_recordings() -> None:
    chains = [((8, 8), (2, 3)), ((10, 11), (2, 2)), ((5, 10), (4, 2))]
    rigs = [
        RigErrors(
            "person_depth", np.ones(2), np.ones(2),
            chain=ChainErrors(*(1e-3 * np.array(part, float) for part in chain)),
        )
        for chain in chains
    ]  # fmt: skip
    found = figures([*rigs, RigErrors("board", np.ones(2), np.ones(2))])
    assert found["body_pve_ratio"] == pytest.approx(1.1)
    assert found["object_ratio"] == pytest.approx(1.0)
    assert "body_pve_ratio" not in figures([RigErrors("board", np.ones(2), np.ones(2))])
