"""`intercap scan --hand-held` on ray-cast walks around an object on a table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from bench.evaluate.scan_errors import Mesh, align, distances
from intercap_core.commands.scan import scan
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import invert, rigid
from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.project import load_project
from intercap_core.scan.standing import find_standing
from intercap_core.scan.walk import HandHeld, Walk, follow
from intercap_core.studio.render import scene_of
from tests.helpers.manifests import rewrite_manifests
from tests.helpers.synthetic_capture import write_frames

LENS = Intrinsics(320, 288, 250.0, 250.0, 159.5, 143.5)
TABLE_M = 0.7
STEPS = 80  # of a walk once around, with an overlap of 8 steps


def block(size: tuple[float, float, float], x: float, y: float, z: float) -> trimesh.Trimesh:
    """An upright block whose lowest middle is at (x, y, z)."""
    box = trimesh.creation.box(size)
    box.apply_translation((x, y, z + size[2] / 2))
    return box


def mug() -> trimesh.Trimesh:
    """A cylinder with a block as a handle, of 14 cm, on the table."""
    body = trimesh.creation.cylinder(0.06, 0.14, sections=48)
    body.apply_translation((0.02, -0.03, TABLE_M + 0.07))
    handle = block((0.06, 0.03, 0.08), 0.105, -0.03, TABLE_M + 0.03)
    return trimesh.util.concatenate([body, handle])


def room() -> list[trimesh.Trimesh]:
    """A floor, a table, and pieces of furniture of different sizes and headings."""
    pieces = [block((5.0, 5.0, 0.1), 0, 0, -0.1), block((0.6, 0.5, TABLE_M), 0, 0, 0)]
    for k, (size, x, y) in enumerate(
        (((0.5, 0.3, 0.9), 1.5, 0.2), ((0.4, 0.4, 0.5), -1.3, 0.9), ((0.3, 0.6, 1.1), -0.2, -1.6))
    ):
        piece = block(size, 0, 0, 0)
        piece.apply_transform(trimesh.transformations.rotation_matrix(0.5 + k, [0, 0, 1]))
        piece.apply_translation((x, y, 0))
        pieces.append(piece)
    return pieces


def way(steps: int = STEPS) -> np.ndarray:
    """room_from_camera (N, 4, 4): around the table at 0.85 m, up and down."""
    poses = []
    for k in range(steps):
        angle, up = 2 * np.pi * k / (STEPS - 8), np.radians(38 + 14 * np.sin(0.2 * k))
        towards = np.array([np.cos(angle) * np.cos(up), np.sin(angle) * np.cos(up), np.sin(up)])
        right = np.cross(-towards, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        eye = np.array([0.0, 0.0, TABLE_M + 0.06]) + 0.85 * towards
        poses.append(rigid(np.stack([right, np.cross(-towards, right), -towards], 1), eye))
    return np.stack(poses)


def record(path: Path, meshes: list[trimesh.Trimesh], poses: np.ndarray, cameras: int = 1) -> Rig:
    """Write the frames artefact of depth images with 1.5 mm of noise."""
    scene = scene_of(*((np.asarray(m.vertices), np.asarray(m.faces)) for m in meshes))
    rng = np.random.default_rng(0)
    rays = np.concatenate([LENS.rays, np.ones((LENS.height, LENS.width, 1))], 2)
    images = []
    for pose in poses:
        cast = np.concatenate(
            [np.broadcast_to(pose[:3, 3], rays.shape), rays @ pose[:3, :3].T], 2
        ).astype(np.float32)
        depth = scene.cast_rays(o3d.core.Tensor.from_numpy(cast))["t_hit"].numpy()
        noisy = depth + rng.normal(0, 0.0015, depth.shape)
        images.append(np.where(np.isfinite(depth), np.rint(1e3 * noisy), 0).astype(np.uint16))
    wrong = rigid(np.eye(3), np.array([5.0, 0, 0]))  # the calibration's pose means nothing
    rig = Rig(tuple(Camera(f"k{c + 1}", LENS, LENS, np.eye(4), wrong) for c in range(cameras)))
    path.parent.mkdir(parents=True, exist_ok=True)
    no_colour = np.full((len(poses), cameras), -1)
    write_frames(
        path, rig, num_sets=len(poses), depths=[np.stack(images)] * cameras,
        colour_index=no_colour, sequence="walk",
    )  # fmt: skip
    return rig


def project_of(folder: Path, meshes: list[trimesh.Trimesh], poses: np.ndarray, **options: int):
    """A project whose one sequence is a walk."""
    record(folder / "results" / "trial" / "walk" / "frames.h5", meshes, poses, **options)
    (folder / "objects.yaml").write_text("{}\n")
    (folder / "subjects.tsv").write_text("subject\tgender\np01\tneutral\n")
    (folder / "sequences.tsv").write_text(
        "sequence\tsubject\trecordings\tcalibration\nwalk\tp01\trec\tcal\n"
    )
    (folder / "config.yaml").write_text(f"dataset: trial\nresults: {folder / 'results'}\n")
    project = load_project(folder / "config.yaml")
    rewrite_manifests(project)
    return project


def test_a_walk_around_a_table_gives_the_closed_mesh(tmp_path: Path) -> None:
    """Only surfaces that face down were not measured: of the body, and of the handle at 3 cm."""
    project = project_of(tmp_path, [*room(), mug()], way())
    mesh, path, _ = scan(project, "mug", ["walk"], hand_held=True)
    truth = Mesh(np.asarray(mug().vertices), np.asarray(mug().faces))
    found = Mesh(mesh.vertices, mesh.faces)
    errors = np.concatenate(distances(found.moved(align(found, truth)), truth))
    assert path.is_file() and mesh.watertight
    assert errors.mean() < 0.002 and np.percentile(errors, 95) < 0.005
    assert 0.05 < mesh.closed_share < 0.25
    closed = ~mesh.measured[mesh.faces].any(1)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    down = shape.face_normals[:, 2] < -0.5
    assert shape.area_faces[closed & down].sum() > 0.75 * shape.area_faces[closed].sum()


def test_poses_of_a_walk_are_followed(tmp_path: Path) -> None:
    poses = way()[:24]
    record(tmp_path / "frames.h5", [*room(), mug()], poses)
    with Frames.open(tmp_path / "frames.h5") as frames:
        walk = follow(HandHeld(frames))
    true = invert(poses[0]) @ poses[[key.t for key in walk.keyframes]]
    off = invert(true) @ walk.poses
    assert len(walk.keyframes) > 10
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.004
    assert np.degrees(Rotation.from_matrix(off[:, :3, :3]).magnitude()).max() < 0.3


def walked(path: Path, others: list[trimesh.Trimesh], poses: np.ndarray) -> Walk:
    """A walk whose poses are known."""
    record(path, [*room(), mug(), *others], poses)
    with Frames.open(path) as frames:
        images = HandHeld(frames)
        keyframes = [images.keyframe(t) for t in range(len(poses))]
        return Walk(images.rig[0], keyframes, invert(poses[0]) @ poses)


@pytest.mark.parametrize(
    ("others", "poses", "message"),
    [
        ([], way(40)[::3], r"walk: the camera saw the object from \d+ of 360.*Walk once around"),
        ([block((0.08, 0.08, 0.1), -0.15, 0.1, TABLE_M)], way()[::3], "two objects stand next to"),
    ],
)
def test_what_a_walk_lacks_is_named(
    tmp_path: Path, others: list[trimesh.Trimesh], poses: np.ndarray, message: str
) -> None:
    with pytest.raises(UserError, match=message):
        find_standing(walked(tmp_path / "frames.h5", others, poses), "walk")


def test_a_camera_that_cannot_be_followed_is_named(tmp_path: Path) -> None:
    record(tmp_path / "frames.h5", [*room(), mug()], way()[np.r_[12:20, 45:65]])
    with (
        Frames.open(tmp_path / "frames.h5") as frames,
        pytest.raises(UserError, match=r"frame 8 \(0\.5 s\): the camera cannot be followed"),
    ):
        follow(HandHeld(frames))


def test_a_walk_of_two_cameras_is_refused(tmp_path: Path) -> None:
    project = project_of(tmp_path, [mug()], way(3), cameras=2)
    with pytest.raises(UserError, match=r"has 2 camera.*leave out --hand-held"):
        scan(project, "mug", ["walk"], hand_held=True)
    assert not (tmp_path / "objects").exists()


def test_a_moving_camera_without_the_option_is_named(tmp_path: Path) -> None:
    project = project_of(tmp_path, room(), way(20))
    with pytest.raises(UserError, match="its only camera moves; give --hand-held"):
        scan(project, "mug", ["walk"])
