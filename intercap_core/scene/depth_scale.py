"""Unit of each camera's depth, by comparison with the person triangulated from keypoints.

Files of depth do not state their unit: RealSense cameras write 1, 1/4 or 1/10 mm, TUM 1/5000 m, and
some tools centimetres or metres. Read as millimetres, all distances are off by one factor.
"""

from __future__ import annotations

import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.solve.time_series import sample_evenly
from intercap_core.person.sides import BODY_POINTS

FACTORS = (2.0, 4.0, 5.0, 10.0, 100.0, 1000.0)  # between the units above, and their inverses
IMAGES = 20  # of each camera, which hold hundreds of body points
MIN_POINTS = 12  # half of the body points of one image
# Depth of the skin over that of the joint: skin is nearer by up to 0.13 m at 1.3 m, feet stand on
# the floor behind them. Narrow enough to tell 4 from 5.
ON_THE_BODY = (0.87, 1.1)
# Share of points on the body. Others see what is before or behind it: half of the body can be
# hidden or, at the rims of limbs, missed, but rarely four fifths.
MIN_SHARE = 0.2
MAX_SHARE_AS_STATED = 0.05


def describe_depth_scale(
    source: Frames, rig: Rig, joints: np.ndarray, image_of: np.ndarray
) -> list[str]:
    """Notes (C,) on cameras whose depth has another unit than the keypoints; "" = none.

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
        ratios = [np.zeros(0)]
        if camera.depth is not None:
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
    """Note on the factor by which the ratios (N,) are those of points on the body; "" if none.

    Surfaces behind the body are common, those before it rare: the smallest factor is taken.
    """
    if len(ratios) < MIN_POINTS or _share(ratios, 1.0) > MAX_SHARE_AS_STATED:
        return ""
    factors = sorted((*FACTORS, *(1 / factor for factor in FACTORS)))
    factor = next((f for f in factors if _share(ratios, f) >= MIN_SHARE), 1.0)
    if factor == 1.0:
        return ""
    times = max(factor, 1 / factor)
    way, right = ("as far as", "divide") if factor > 1 else ("closer than", "multiply")
    return (
        f"its depth puts the person {times:.0f} times {way} the keypoints do: {right} depth_unit "
        f"of the calibration by {times:.0f} (it is 0.001, millimetres, if not stated)"
    )


def _share(ratios: np.ndarray, factor: float) -> float:
    """Share of the ratios (N,) that are those of points on the body with depth scaled by factor."""
    # Whole metres are rounded by a quarter; no other factor is near.
    low, high = ON_THE_BODY if factor > 0.002 else (0.7, 1.4)
    return float(np.mean((ratios > low * factor) & (ratios < high * factor)))
