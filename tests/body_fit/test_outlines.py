"""Planes through the rim of a mask touch the body at the right distance."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from intercap_core.body_fit.outlines import MaskRim, RimSamples, find_touched, trace_outline
from intercap_core.geometry.camera import masks
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import rigid

LENS = Intrinsics(640, 480, 500.0, 505.0, 318.0, 243.0, (0.08, -0.03, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
CENTRE, RADIUS = np.array([0.15, -0.1, 2.0]), 0.25
MASTER_FROM_COLOUR = rigid(
    trimesh.transformations.euler_matrix(0.4, 0.3, -0.2)[:3, :3], np.array([0.3, 0.5, -0.2])
)
BALL = trimesh.creation.icosphere(subdivisions=4)
SAMPLES = RimSamples(
    np.arange(0, len(BALL.vertices), 3),
    np.arange(0, len(BALL.vertices), 3),
    np.array([_row[:20] for _row in np.argsort(
        np.linalg.norm(BALL.vertices[::3, None] - BALL.vertices, axis=2), axis=1
    )]),
)  # fmt: skip


def _mask(centre: np.ndarray, radius: float) -> masks.Runs:
    """Pixels whose ray meets a ball."""
    y, x = np.mgrid[: LENS.height, : LENS.width]
    rays = LENS.unproject(np.stack([x, y], -1).reshape(-1, 2).astype(float))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    off = np.linalg.norm(np.cross(rays, centre), axis=1)
    return _runs((off < radius).reshape(LENS.height, LENS.width))


def _runs(mask: np.ndarray) -> masks.Runs:
    return masks.Runs(masks.encode(mask), *mask.shape)


def _rim(mask: masks.Runs) -> MaskRim:
    found = trace_outline(mask, None, LENS, 0)
    assert found is not None
    return found


def _touching(
    rim: MaskRim, radius: float, displacement: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Samples and distances of a ball of this radius, displaced along the camera's x, metres."""
    turn, shift = MASTER_FROM_COLOUR[:3, :3], MASTER_FROM_COLOUR[:3, 3]
    vertices = ((radius * BALL.vertices + CENTRE) @ turn.T + shift).astype(np.float32)
    normals = (BALL.vertices @ turn.T).astype(np.float32)
    moved = np.broadcast_to(displacement * turn[:, 0], (len(vertices), 3))
    return find_touched(rim, MASTER_FROM_COLOUR, vertices, normals, SAMPLES, 0.05, moved)


def test_planes_touch_the_masked_ball() -> None:
    rim = _rim(_mask(CENTRE, RADIUS))
    apart = (rim.normals * CENTRE).sum(1)  # of the ball's centre: inward
    np.testing.assert_allclose(np.linalg.norm(rim.normals, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose((rim.normals * rim.rays).sum(1), 0, atol=1e-6)
    assert apart.mean() == pytest.approx(-RADIUS, abs=0.0005)
    assert np.abs(apart + RADIUS).max() < 0.004  # of a pixel, 4 mm wide there
    assert 200 < len(rim.rays) < 500


@pytest.mark.parametrize("smaller_m", [-0.02, 0.0, 0.01, 0.03])
def test_distance_is_the_missing_radius(smaller_m: float) -> None:
    rim = _rim(_mask(CENTRE, RADIUS))
    sample, distance = _touching(rim, RADIUS - smaller_m)
    assert len(sample) > 0.9 * len(rim.rays)
    assert distance.mean() == pytest.approx(smaller_m, abs=0.0015)


def test_planes_beyond_reach_are_left_out() -> None:
    assert len(_touching(_rim(_mask(CENTRE, RADIUS)), RADIUS - 0.06)[0]) == 0


def test_motion_until_the_exposure_is_taken_out() -> None:
    rim = _rim(_mask(CENTRE, RADIUS))
    sample, distance = _touching(rim, RADIUS, displacement=0.01)
    sideways = BALL.vertices[sample, 0]
    assert distance[sideways > 0.9].mean() == pytest.approx(-0.0095, abs=0.002)
    assert distance[sideways < -0.9].mean() == pytest.approx(0.0095, abs=0.002)


def _box(rows: slice, columns: slice) -> np.ndarray:
    """A mask of the image with one rectangle."""
    mask = np.zeros((LENS.height, LENS.width), bool)
    mask[rows, columns] = True
    return mask


def test_image_border_is_no_rim() -> None:
    normals = _rim(_runs(_box(slice(100, None), slice(300)))).normals  # leaves left and below
    assert (normals[:, 0] > 0.9).any() and (normals[:, 1] < -0.9).any()
    assert not (normals[:, 0] < -0.5).any() and not (normals[:, 1] > 0.5).any()


def test_a_gap_between_limbs_has_a_rim_and_a_speck_has_none() -> None:
    whole = _box(slice(100, 300), slice(100, 300))
    rim = _rim(_runs(whole & ~_box(slice(150, 250), slice(180, 220))))
    assert len(rim.rays) != len(_rim(_runs(whole)).rays)
    assert np.abs(rim.rays[:, :2] / rim.rays[:, 2:]).max() < 1
    for speck in (_box(slice(200, 204), slice(200, 204)), np.zeros_like(whole)):
        assert trace_outline(_runs(speck), None, LENS, 0) is None


def test_rim_next_to_another_object_is_left_out() -> None:
    whole = _box(slice(100, 300), slice(100, 300))
    other = _box(slice(150, 250), slice(302, 400))  # two pixels from the mask's right border
    rim = trace_outline(_runs(whole), _runs(other), LENS, 0)
    assert rim is not None
    at = LENS.project(rim.rays.astype(float))
    on_the_right = at[:, 0] > 298
    assert on_the_right.any()
    assert not ((at[:, 1] > 152) & (at[:, 1] < 248) & on_the_right).any()
