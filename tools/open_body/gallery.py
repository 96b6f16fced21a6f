"""Pictures of the open body for the documentation, rendered by ray casting."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from intercap_core.body.model import BodyModel, with_hand_mean
from intercap_core.body.parameters import BodyParameters
from intercap_core.studio.subjects import Subject

from .hands import mirrored, named_grasp

_COLOURS = np.array([
    [0.90, 0.30, 0.25], [0.25, 0.45, 0.90], [0.95, 0.70, 0.20], [0.30, 0.75, 0.85],
    [0.45, 0.75, 0.35], [0.60, 0.40, 0.80], [0.95, 0.50, 0.70], [0.40, 0.40, 0.45],
    [0.75, 0.85, 0.30], [0.85, 0.55, 0.30], [0.35, 0.65, 0.60], [0.80, 0.15, 0.40],
    [0.55, 0.60, 0.95], [0.70, 0.50, 0.35],
])  # fmt: skip


def shade(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    centre: np.ndarray,
    width_m: float,
    size: tuple[int, int],
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    colours: np.ndarray | None = None,
    points: np.ndarray | None = None,
) -> np.ndarray:
    """Return an orthographic view (H, W, 3) uint8 of a mesh (y up), seen from +z.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3)
        centre: (3,) centre of the picture.
        width_m: width of the picture, metres.
        size: width and height, pixels.
        yaw_deg: rotation about y; positive shows the person's left side.
        pitch_deg: elevation of the camera.
        colours: (V, 3) in [0, 1].
        points: (N, 3) drawn as red dots, even if they are hidden.
    """
    import open3d as o3d

    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    r_yaw = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    r_pitch = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)],
                        [0, np.sin(pitch), np.cos(pitch)]])  # fmt: skip
    view = r_pitch @ r_yaw
    local = ((vertices - centre) @ view.T).astype(np.float32)
    width, height = size
    step = width_m / width
    xs = (np.arange(width) + 0.5 - width / 2) * step
    ys = (height / 2 - np.arange(height) - 0.5) * step
    rays = np.zeros((height, width, 6), np.float32)
    rays[..., 0], rays[..., 1], rays[..., 2], rays[..., 5] = xs, ys[:, None], 5, -1
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(local, faces.astype(np.uint32))
    hit = scene.cast_rays(rays)
    seen = np.isfinite(hit["t_hit"].numpy())
    face = np.where(seen, hit["primitive_ids"].numpy().astype(np.int64), 0)
    normals = np.zeros_like(local)
    cross = np.cross(local[faces[:, 1]] - local[faces[:, 0]],
                     local[faces[:, 2]] - local[faces[:, 0]])  # fmt: skip
    for i in range(3):
        np.add.at(normals, faces[:, i], cross)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    uv = hit["primitive_uvs"].numpy()
    bary = np.concatenate([1 - uv.sum(-1, keepdims=True), uv], -1)
    normal = np.einsum("hwk,hwkc->hwc", bary, normals[faces[face]])
    light = np.array([-0.35, 0.45, 0.82])
    level = 0.3 + 0.7 * np.clip(normal @ light, 0, 1)
    base = np.full((*face.shape, 3), 0.82) if colours is None else np.einsum(
        "hwk,hwkc->hwc", bary, colours[faces[face]])  # fmt: skip
    image = np.where(seen[..., None], base * level[..., None], 1.0)
    if points is not None:
        at = (points - centre) @ view.T
        px = np.round(at[:, 0] / step + width / 2 - 0.5).astype(int)
        py = np.round(height / 2 - 0.5 - at[:, 1] / step).astype(int)
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                ok = (px + dx >= 0) & (px + dx < width) & (py + dy >= 0) & (py + dy < height)
                image[py[ok] + dy, px[ok] + dx] = (0.85, 0.05, 0.05)
    return (image * 255).round().astype(np.uint8)


def save(path: Path, tiles: list[np.ndarray]) -> None:
    """Save tiles side by side as a PNG of 64 colours, small enough for a repository."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.fromarray(np.concatenate(tiles, 1))
    picture.quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)


def rest_points(model: BodyModel) -> tuple[np.ndarray, np.ndarray]:
    """Rest joints (55,3) and finger tips (10,3), left then right, of the mean body."""
    out = model.forward(model.zeros())
    points = model.keypoints(out)[0].numpy()
    order = (1, 2, 4, 3, 0)  # OpenPose has the thumb first and the ring before the little finger
    tips = [25 + 21 * side + 4 + 4 * f for side in (0, 1) for f in order]
    return out.joints[0].numpy(), points[tips]


def grasping(model: BodyModel, grasp: str) -> BodyParameters:
    """Both hands in a named grasp, T-posed otherwise."""
    joints, tips = rest_points(model)
    left = named_grasp(grasp, joints.astype(float), tips.astype(float))
    params = model.zeros()
    params.left_hand_pose[0] = torch.as_tensor(left)
    params.right_hand_pose[0] = torch.as_tensor(mirrored(left))
    return params


def posed(model: BodyModel, **angles: tuple[float, float, float]) -> BodyParameters:
    """The mean-handed body with some joints turned, axis-angle in radians by joint name."""
    from intercap_core.body.joints import JOINT_INDEX

    params = with_hand_mean(model, model.zeros())
    for name, angle in angles.items():
        k = JOINT_INDEX[name]
        target = params.jaw_pose if name == "jaw" else params.body_pose
        column = 0 if name == "jaw" else 3 * (k - 1)
        target[0, column : column + 3] = torch.tensor(angle)
    return params


REACH = {
    "left_shoulder": (0.2, -0.7, -0.5), "left_elbow": (0.0, -0.7, 0.0),
    "right_shoulder": (0.1, 0.2, 1.2), "right_elbow": (0.0, 0.3, 0.0),
    "right_hip": (-0.25, 0.0, 0.05), "right_knee": (0.5, 0.0, 0.0), "head": (0.2, 0.25, 0.0),
    "spine2": (0.15, 0.0, 0.0),
}  # fmt: skip
SIT = {
    "left_hip": (-1.5, 0.0, 0.1), "right_hip": (-1.45, 0.0, -0.1), "left_knee": (1.5, 0.0, 0.0),
    "right_knee": (1.55, 0.0, 0.0), "left_shoulder": (0.0, -0.3, -1.1),
    "right_shoulder": (0.0, 0.3, 1.1), "left_elbow": (0.0, -0.9, 0.0),
    "right_elbow": (0.0, 0.9, 0.0), "spine1": (0.1, 0.0, 0.0),
}  # fmt: skip
# Arms folded, a leg over the other one
FOLDED = {
    "left_shoulder": (0.3, -1.1, -0.75), "right_shoulder": (0.3, 1.1, 0.75),
    "left_elbow": (0.0, -1.9, 0.0), "right_elbow": (0.0, 1.9, 0.0),
    "left_hip": (-1.5, 0.0, -0.15), "right_hip": (-1.75, -0.2, 0.35),
    "left_knee": (1.5, 0.0, 0.0), "right_knee": (1.5, 0.0, 0.0),
}  # fmt: skip


def render(folder: Path) -> None:
    model = BodyModel.load()
    faces = model.faces.numpy()
    middle = np.array([0, -0.45, 0.0])

    def skin(params: BodyParameters) -> np.ndarray:
        return model.forward(params).vertices[0].numpy()

    rest = model.forward(model.zeros())
    keypoints = model.keypoints(rest)[0].numpy()
    v = rest.vertices[0].numpy()
    view = {"centre": middle, "width_m": 2.0, "size": (400, 400)}
    save(folder / "body_rest.png", [
        shade(v, faces, points=rest.joints[0].numpy(), **view),
        shade(v, faces, points=keypoints, yaw_deg=35, pitch_deg=10, **view),
        shade(v, faces, points=v[model.markers], yaw_deg=-35, pitch_deg=10, **view),
    ])  # fmt: skip
    save(folder / "body_poses.png", [
        shade(skin(posed(model, **pose)), faces, yaw_deg=yaw, centre=middle, width_m=1.7,
              size=(260, 306))
        for pose, yaw in ((REACH, 0), (REACH, 50), (SIT, 35), (SIT, 90), (FOLDED, 0), (FOLDED, 60))
    ])  # fmt: skip
    hand = {"width_m": 0.24, "size": (300, 240), "centre": np.array([0.77, 0.04, 0.02])}
    save(folder / "body_grasps.png", [
        np.concatenate([
            shade(skin(grasping(model, name)), faces, pitch_deg=-60, **hand),
            shade(skin(grasping(model, name)), faces, yaw_deg=30, pitch_deg=-20, **hand),
        ])
        for name in ("relaxed", "fist", "medium_wrap", "pinch", "point")
    ])  # fmt: skip
    face = {"centre": np.array([0, 0.32, 0.1]), "width_m": 0.28, "size": (260, 300)}
    smile = model.zeros()
    smile.expression[0, 0] = 2.0
    save(folder / "body_face.png", [
        shade(v, faces, points=keypoints[67:], **face),
        shade(skin(posed(model, jaw=(0.35, 0.0, 0.0))), faces, **face),
        shade(skin(posed(model, jaw=(0.35, 0.0, 0.0))), faces, yaw_deg=50, **face),
        shade(skin(smile), faces, **face),
    ])  # fmt: skip
    shapes = []
    for k in range(4):
        for sign in (-2.0, 2.0):
            params = model.zeros()
            params.betas[0, k] = sign
            shapes.append(shade(skin(params), faces, centre=middle, width_m=2.1, size=(230, 230)))
    save(folder / "body_shapes.png", [
        np.concatenate(shapes[i:i + 2]) for i in range(0, len(shapes), 2)
    ])  # fmt: skip
    colours = np.full((len(v), 3), 0.82)
    for ids, colour in zip(model.regions.values(), _COLOURS, strict=True):
        colours[ids] = colour
    low = {"centre": np.array([0.78, 0.05, 0.0]), "width_m": 0.3, "size": (300, 400)}
    save(folder / "body_regions.png", [
        shade(v, faces, colours=colours, **view),
        shade(v, faces, colours=colours, yaw_deg=180, **view),
        shade(v, faces, colours=colours, pitch_deg=-80, **low),
        shade(v, faces, colours=colours, pitch_deg=-50, centre=np.array([0, -1.3, 0]),
              width_m=0.6, size=(300, 400)),
    ])  # fmt: skip
    pose = posed(model, **REACH).full_pose().numpy()
    tiles = []
    for name in ("s01", "s04", "s07", "s12"):
        subject = Subject.load(name)
        out = subject.skin(pose, np.zeros((1, 3)))
        tiles += [
            shade(surface[0], subject.faces, yaw_deg=25, centre=middle, width_m=1.1,
                  size=(180, 330))
            for surface in (out.vertices, out.clothed)
        ]  # fmt: skip
    save(folder / "body_subjects.png", tiles)
