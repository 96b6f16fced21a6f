"""Pictures of the contact heatmaps: the body, each hand and each object from two sides."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.evaluation.summary import SurfaceHeat
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.output.site import drawing

# sRGB, from no contact to the map's maximum: grey skin, yellow, red, dark red
COLOUR_STOPS = ((0.80, 0.81, 0.83), (0.99, 0.80, 0.25), (0.91, 0.26, 0.15), (0.40, 0.02, 0.12))
STOP_AT = (0.0, 0.25, 0.6, 1.0)  # likelihoods of COLOUR_STOPS, shares of the maximum


def colours(values: np.ndarray, top: float) -> np.ndarray:
    """Return colours (V, 3) of values (V,); ``top`` has the last colour."""
    share = np.clip(values / max(top, 1e-12), 0, 1)
    stops = np.array(COLOUR_STOPS)
    return np.column_stack([np.interp(share, STOP_AT, stops[:, k]) for k in range(3)])


def body_surfaces(
    model: BodyModel, likelihood: np.ndarray, common: float | None = None
) -> list[tuple[str, list[drawing.EncodedImage], float]]:
    """Draw the body with lowered arms from both sides, and each hand from both sides.

    Returns name, pictures and highest likelihood of each surface. The last colour is that of the
    likelihood ``common``. If it is None, it is the surface's own highest likelihood, as in the
    paper's figure, because hands touch far more often than other parts.
    """
    params = model.zeros(1)
    for index, turn in ((JOINT_INDEX["left_shoulder"], -1), (JOINT_INDEX["right_shoulder"], 1)):
        params.body_pose[:, 3 * (index - 1) + 2] = turn  # radians about z lower the arm
    with torch.no_grad():
        standing = model.forward(params).vertices[0].numpy().astype(np.float64)
    faces, top = model.faces.numpy(), highest(likelihood)
    paint, up = colours(likelihood, common or top), np.array([0, 1.0, 0])
    whole = [
        _draw_from(standing, faces, paint, view, up, (280, 480), name)
        for name, view in (("front", [0, 0, 1.0]), ("back", [0, 0, -1.0]))
    ]
    surfaces = [("body", whole, top)]
    template = model.template.numpy().astype(np.float64)
    with torch.no_grad():
        joints = model.forward(model.zeros(1)).joints[0].numpy()
    for side, outwards in (("left", 1.0), ("right", -1.0)):
        wrist = joints[JOINT_INDEX[f"{side}_wrist"], 0]
        shown = outwards * (template[:, 0] - wrist) > -0.03  # with 3 cm of the forearm
        kept = faces[shown[faces].all(1)]
        fingers = np.array([outwards, 0, 0])  # in the T-pose, fingers point away from the body
        top = highest(likelihood[shown])
        paint = colours(likelihood, common or top)
        hand = [
            _draw_from(template, kept, paint, view, fingers, (240, 240), f"{side} hand, {what}")
            for what, view in (("palm", [0, -1.0, 0]), ("back", [0, 1.0, 0]))
        ]
        surfaces.append((f"{side} hand", hand, top))
    return surfaces


def highest(likelihood: np.ndarray) -> float:
    """Return the likelihood of a map's last colour: its maximum, or 1e-6 without contact."""
    return max(float(likelihood.max(initial=0.0)), 1e-6)


def object_pictures(
    vertices: np.ndarray, faces: np.ndarray, heat: SurfaceHeat, top: float
) -> list[drawing.EncodedImage]:
    """Draw two opposite views of an object (V, 3), (F, 3) from above; its frame is z up.

    ``top``: likelihood of the last colour.
    """
    # edges of at most 12 mm, because colours are interpolated between vertices
    fine, triangles = trimesh.remesh.subdivide_to_size(vertices, faces, 0.012, max_iter=12)
    paint = colours(_interpolate(heat, fine), top)
    up = np.array([0, 0, 1.0])
    return [
        _draw_from(fine, triangles, paint, view, up, (260, 260), name)
        for name, view in (("one side", [0.8, -0.9, 0.5]), ("other side", [-0.8, 0.9, 0.5]))
    ]


def _interpolate(heat: SurfaceHeat, points: np.ndarray) -> np.ndarray:
    """Interpolate the likelihood at points (N, 3) from the 12 nearest samples of the surface.

    The weights are a Gaussian kernel with a standard deviation of 6 mm.
    """
    distance, near = cKDTree(heat.points).query(points, k=min(12, len(heat.points)))
    weight = np.exp(-0.5 * (distance / 0.006) ** 2) + 1e-12
    return (weight * heat.likelihood[near]).sum(1) / weight.sum(1)


def _draw_from(
    vertices: np.ndarray,
    faces: np.ndarray,
    paint: np.ndarray,
    towards_viewer: list[float] | np.ndarray,
    up: np.ndarray,
    size: tuple[int, int],
    caption: str,
) -> drawing.EncodedImage:
    """Draw the faces from far away; they fill a picture of ``size`` (width, height)."""
    backward = np.asarray(towards_viewer, np.float64)
    backward = backward / np.linalg.norm(backward)
    turn = drawing.look_along(-backward, up)
    used = vertices[np.unique(faces)] @ turn.T
    low, high = used.min(0), used.max(0)
    middle, extent = (low + high) / 2, (high - low)[:2]
    distance = 40.0 * float(extent.max())  # nearly parallel rays
    lens = drawing.pinhole(*size, 0.92 * distance * min(size[0] / extent[0], size[1] / extent[1]))
    pose = rigid(turn, np.array([0, 0, distance]) - middle)
    picture = drawing.draw([drawing.ColouredMesh(vertices, faces, pose, colours=paint)], lens)
    return drawing.encode_png(picture.rgba, caption)
