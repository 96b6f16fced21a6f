"""Drawn moving surfaces, compared with rays cast by Embree."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.geometry.camera.transforms import apply, invert, rigid, rotation_exp
from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.studio.render import (
    BODY,
    OBJECT,
    MovingSurface,
    RoomView,
    scene_of,
)
from intercap_core.studio.rig import build_rig
from intercap_core.studio.room import build_room
from intercap_core.studio.subjects import Subject


@pytest.fixture(scope="module")
def surfaces() -> tuple[MovingSurface, MovingSurface]:
    """A person in the T-pose on the floor and a ball before the chest, colours by place."""
    subject = Subject.load("s01")
    upright = rotation_exp(np.array([np.pi / 2, 0, 0]))  # the rest pose has y up
    posed = subject.rest @ upright.T
    posed = posed - (0, 0, posed[:, 2].min())
    normals = subject.normals(posed[None])[0]
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.15)
    place = rigid(rotation_exp(np.array([0.3, 0.2, 0.1])), np.array([0.25, 0.3, 1.2]))
    return (
        MovingSurface(BODY, posed, subject.faces, normals, 0.5 + 0.2 * posed, np.eye(4)),
        MovingSurface(
            OBJECT, np.array(ball.vertices), np.array(ball.faces), ball.vertices / 0.15,
            0.5 + 0.2 * ball.vertices, place,
        ),
    )  # fmt: skip


@pytest.mark.parametrize("index", [0, 1])
def test_moving_surfaces_are_drawn_where_rays_hit(
    surfaces: tuple[MovingSurface, MovingSurface], index: int
) -> None:
    capture = StudioCapture(interaction="stool_sit", subject="s01", seed=1, frames=9)
    settings = StudioSettings(captures={}, cameras=2, colour_mode="720P")
    rig = build_rig(np.random.default_rng(1), capture, settings)
    camera = rig.true[index]
    assert camera.depth is not None
    pose = invert(rig.master_from_stage) @ camera.master_from_depth
    room = build_room(np.random.default_rng(0), [], np.eye(2), furnishing="bare")
    view = RoomView(camera.depth, pose, room, coloured=False)
    cast = view.cast(surfaces)
    scene = scene_of(*((apply(s.stage_from_mesh, s.vertices), s.faces) for s in surfaces))
    directions = view.directions()[cast.window]
    eyes = np.broadcast_to(view.eye, directions.shape)
    rays = np.concatenate([eyes, directions], -1).astype(np.float32)
    hit = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
    depth = hit["t_hit"].numpy()
    seen = depth < view.depth[cast.window]
    expected = np.where(seen, hit["geometry_ids"].numpy() + 1, 0)
    assert {BODY, OBJECT} <= set(np.unique(expected))
    assert (cast.identity != expected).mean() < 1e-4
    both = (cast.identity == expected).ravel()[cast.pixels]
    pixels = cast.pixels[both]
    np.testing.assert_allclose(cast.depth[both], depth.ravel()[pixels], atol=5e-5)
    # colours are a linear function of the place in the mesh's frame, so interpolation is exact
    rows, columns = (part[both] for part in cast.image_pixels)
    points = view.eye + view.directions()[rows, columns] * cast.depth[both, None]
    number = cast.identity.ravel()[pixels] - 1
    for k, surface in enumerate(surfaces):
        own = apply(invert(surface.stage_from_mesh), points[number == k])
        np.testing.assert_allclose(cast.colour[both][number == k], 0.5 + 0.2 * own, atol=1e-4)
    ball = number == 1
    outward = points[ball] - surfaces[1].stage_from_mesh[:3, 3]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert (cast.normal[both][ball] * outward).sum(1).min() > 0.995
    np.testing.assert_allclose(np.linalg.norm(cast.normal, axis=1), 1, atol=1e-5)
    assert view.count(surfaces[1]) >= (cast.identity == OBJECT).sum()
