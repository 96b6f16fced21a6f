"""Fusion of depth images with known poses: size, closedness, thin walls, holes, colours."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import apply, rigid, rotation_exp
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.scan.fusion import Posed, fuse, place_variance, vertex_colours
from tests.scan.turned_object import Turned, turning

BOX = trimesh.creation.box((0.12, 0.16, 0.20))
VESSEL = trimesh.creation.annulus(0.045, 0.050, 0.12)  # a wall of 5 mm


def posed(mesh: trimesh.Trimesh, poses: np.ndarray, **options: float) -> Posed:
    recording = Turned([(mesh.vertices.copy(), mesh.faces.copy())], poses[None], **options)
    surfaces = {t: recording.surfaces(t) for t in range(len(recording))}
    return Posed(recording, surfaces, dict(enumerate(poses)))  # type: ignore[arg-type]


def distances_mm(mesh: trimesh.Trimesh, vertices: np.ndarray) -> np.ndarray:
    return 1e3 * DistanceField(mesh.vertices, mesh.faces).signed_distance(vertices)


@pytest.mark.parametrize("noise_m", [0.0, 0.004])
def test_a_turned_box_is_closed_and_of_its_size(noise_m: float) -> None:
    surface = fuse([posed(BOX, turning(12, 30.0), noise_m=noise_m)])
    found = trimesh.Trimesh(surface.vertices, surface.faces)
    assert found.is_watertight
    assert found.volume == pytest.approx(BOX.volume, rel=0.04)  # positive: normals outward
    off = distances_mm(BOX, surface.vertices)
    assert np.quantile(abs(off), 0.9) < 2.0  # a voxel; edges are rounded
    assert abs(np.median(off)) < 0.7
    assert surface.measured.mean() > 0.99


def test_uncertain_poses_count_less() -> None:
    """Two of three poses are turned by 12 degrees and have a standard deviation of 12 degrees."""
    part = posed(BOX, turning(24, 15.0))
    turn = np.radians(12.0)
    poses, covariances = dict(part.poses), {t: 1e-6 * np.eye(6) for t in part.poses}
    for t in (t for t in poses if t % 3):
        pose = poses[t].copy()
        pose[:3, :3] = rotation_exp(turn * np.eye(3)[t // 3 % 3] * (-1) ** t) @ pose[:3, :3]
        poses[t], covariances[t] = pose, np.diag([turn**2] * 3 + [1e-6] * 3)
    off = {}
    for name, known in (("equal", {}), ("weighted", covariances)):
        surface = fuse([Posed(part.recording, part.surfaces, poses, known)])
        off[name] = float(np.quantile(abs(distances_mm(BOX, surface.vertices)), 0.95))
    assert off["weighted"] < 2.5 and off["weighted"] < 0.6 * off["equal"]


def test_place_variance_is_that_of_drawn_poses() -> None:
    random = np.random.default_rng(5)
    root = random.standard_normal((6, 6)) * np.array([0.02] * 3 + [0.003] * 3)[:, None]
    covariance = root @ root.T
    pose = rigid(rotation_exp(random.standard_normal(3)), random.standard_normal(3))
    point = np.array([0.1, -0.2, 0.05])
    drawn = random.multivariate_normal(np.zeros(6), covariance, 100_000)
    arm = pose[:3, :3] @ point
    moved = np.cross(drawn[:, :3], arm) + drawn[:, 3:]
    assert apply(pose, point[None])[0] == pytest.approx(arm + pose[:3, 3])
    form, place = place_variance(pose, covariance), np.append(point, 1.0)
    assert place @ form @ place == pytest.approx(moved.var(0).mean(), rel=0.02)


def test_a_thin_wall_keeps_its_two_sides() -> None:
    """A surface of the mean distance of both sides would be filled, or have no wall at all."""
    surface = fuse([posed(VESSEL, turning(12, 30.0))])
    found = trimesh.Trimesh(surface.vertices, surface.faces)
    assert found.volume == pytest.approx(VESSEL.volume, rel=0.5)  # filled: five times as much
    assert np.median(abs(distances_mm(VESSEL, surface.vertices))) < 1.5


def test_a_rod_of_a_centimetre_stays_whole() -> None:
    """Three pixels wide, in the coarse grid of a first mesh."""
    rod = trimesh.creation.cylinder(0.0055, 0.5)
    surface = fuse([posed(rod, turning(6, 30.0), noise_m=0.002)], voxels=100**3)
    found = trimesh.Trimesh(surface.vertices, surface.faces)
    assert found.volume == pytest.approx(rod.volume, rel=0.2)
    assert np.ptp(surface.vertices[:, 2]) == pytest.approx(0.5, abs=0.01)


def test_depth_without_a_surface_is_refused() -> None:
    above_all = 1.0
    with pytest.raises(UserError, match=r"sequence turned: .* no surface"):
        fuse([posed(BOX, turning(1, 0.0))], up=np.array([0.0, 0, 1]), ground=above_all)


def test_what_no_camera_measured_is_closed_and_flagged() -> None:
    """Cameras above the box alone: its underside is closed at its lowest points."""
    above = [c for c in range(6) if c % 2 == 0]
    part = posed(BOX, turning(2, 0.0))
    part.recording.cameras[:] = above  # type: ignore[union-attr]
    part = Posed(part.recording, {t: part.recording.surfaces(t) for t in (0, 1)}, part.poses)
    surface = fuse([part], up=np.array([0.0, 0, 1]))
    assert trimesh.Trimesh(surface.vertices, surface.faces).is_watertight
    assert surface.vertices[:, 2].min() == pytest.approx(-0.10, abs=0.006)
    below = surface.vertices[:, 2] < -0.095
    inner = abs(surface.vertices[:, :2]).max(1) < 0.04
    assert not surface.measured[below & inner].any()
    above_inner = (surface.vertices[:, 2] > 0.095) & inner
    assert surface.measured[above_inner].all()


def test_a_second_piece_is_left_out_and_counted() -> None:
    other = trimesh.creation.box((0.04, 0.06, 0.06))
    other.apply_translation((0.13, 0, 0))
    surface = fuse([posed(trimesh.util.concatenate([BOX, other]), turning(12, 30.0))])
    assert surface.vertices[:, 0].max() < 0.08
    total = BOX.area + other.area
    assert surface.apart_share == pytest.approx(other.area / total, rel=0.4)


def test_colours_come_from_the_images() -> None:
    part = posed(BOX, turning(3, 20.0))
    colours = vertex_colours(BOX.vertices, [part])
    assert (colours == (200, 20, 10)).all()  # sRGB of the images' blue, green, red


def test_cameras_that_see_a_part_of_the_box_measure_this_part() -> None:
    part = posed(BOX, turning(4, 30.0, np.tile([0.0, 0.0, 0.30], (4, 1))))
    depth = part.recording.depth(0, 0)
    assert (depth[0] < 2.0).any() or (depth[-1] < 2.0).any()  # cut by the image's edge
    surface = fuse([part])
    assert surface.measured.mean() > 0.5
    assert np.median(abs(distances_mm(BOX, surface.vertices[surface.measured]))) < 1.5
