"""Unit of each camera's depth, by comparison with the person triangulated from keypoints.

Depth files do not state their unit: RealSense cameras write 1, 1/4 or 1/10 mm, TUM 1/5000 m, and
some tools centimetres or metres. If it is read as millimetres, all distances are wrong by one
factor. A wrong scale of the camera poses has the same effect.
"""

from __future__ import annotations

import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.solve.time_series import sample_evenly
from intercap_core.person.sides import BODY_POINTS

# Possible factors between the units above.
FACTORS = sorted({f for k in (1.0, 2.0, 4.0, 5.0, 10.0, 100.0, 1000.0) for f in (k, 1 / k)})
IMAGES = 20  # of each camera, which hold hundreds of body points
MIN_POINTS = 12  # half of the body points of one image
# Depth of the skin over that of the joint: skin is nearer by up to 0.13 m at 1.3 m, feet stand on
# the floor behind them. Narrow enough to distinguish 4 from 5.
ON_THE_BODY = (0.87, 1.1)
# Share of points on the body at which a factor is possible: objects in front of the person hide up
# to 75 % of the points and may be at half of the distance. In 262 cameras of virtual recordings
# with right units (biases of depth, two cameras, keypoints of MediaPipe) the share is 0.27 to 1.
MIN_SHARE = 0.2


def describe_depth_scale(
    source: Frames, rig: Rig, joints: np.ndarray, image_of: np.ndarray
) -> list[str]:
    """Notes (C,) on the unit of each camera's depth; "" = as stated, or the camera has no depth.

    Args:
        source: images by frame set.
        rig: cameras at the poses of the calibration.
        joints: (T, 135, 3) triangulated person by moment, master frame, metres; NaN = unknown.
        image_of: (T, C) set whose image shows each moment; -1 = none.
    """
    known = np.isfinite(joints[:, BODY_POINTS, 0]).any(1)
    images = source.showing(image_of)
    notes = []
    for c, camera in enumerate(rig):
        if camera.depth is None or not images.depth_available[:, c].any():
            notes.append("")
            continue
        ratios = [np.zeros(0)]
        for t in sample_evenly(known & images.depth_available[:, c], IMAGES):
            depth = images.depth(int(t), c)
            if depth is not None:
                ratios.append(depth_ratios(depth, camera, joints[t, BODY_POINTS]))
        notes.append(describe_factor(np.concatenate(ratios)))
    return notes


def depth_ratios(depth: np.ndarray, camera: Camera, joints: np.ndarray) -> np.ndarray:
    """Measured depth over the depth of each joint that the image shows, (N,).

    Args:
        depth: (H, W) uint16, mm, 0 = invalid.
        camera: a camera with depth.
        joints: (K, 3) master frame, metres; NaN = unknown.
    """
    lens = camera.depth
    assert lens is not None
    points = apply(invert(camera.master_from_depth), joints[np.isfinite(joints[:, 0])])
    points = points[lens.sees(points)]
    u, v = np.rint(lens.project(points)).astype(int).T
    values = depth[np.clip(v, 0, lens.height - 1), np.clip(u, 0, lens.width - 1)] * 1e-3
    return values[values > 0] / points[values > 0, 2]


def describe_factor(ratios: np.ndarray) -> str:
    """Note on the factor of the ratios (N,) of :func:`depth_ratios`; "" if it is 1.

    Several factors are named if the depth of some points is that of an object or a wall.
    """
    possible = [factor for factor in FACTORS if _share(ratios, factor) >= MIN_SHARE]
    if len(ratios) < MIN_POINTS or not possible:
        return (
            f"the unit of its depth is not determined: {len(ratios)} triangulated body points have "
            "depth, too few of them on the person"
        )
    if 1.0 in possible:
        return ""
    factors = " or ".join(f"{factor:g}" for factor in possible)
    return (
        f"its depth is {factors} times the distance of the person by keypoints: either the unit of "
        "its depth is wrong (divide depth_unit of the calibration, 0.001 = millimetres if not "
        "stated, by this factor), or the scale of the camera poses is (multiply calibration_scale "
        "by it, or positions in a calibration without scale)"
    )


def _share(ratios: np.ndarray, factor: float) -> float:
    """Share of the ratios (N,) that are those of points on the body with depth scaled by factor."""
    low, high = ON_THE_BODY if factor > 0.002 else (0.7, 1.4)  # whole metres are rounded
    on_the_body = (ratios > low * factor) & (ratios < high * factor)
    return float(on_the_body.sum() / max(1, len(ratios)))
