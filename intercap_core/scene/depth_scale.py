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
# Of the logarithm of a ratio. The depth of skin is nearer than the joint by up to 5 %; values in
# metres are rounded by up to 25 % at 2 m. Half of the logarithm of 2 would be 0.35.
TOLERANCE = 0.25


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
    """Note on the factor near which at least half of the ratios (N,) lie; "" if none is."""
    if len(ratios) < MIN_POINTS:
        return ""
    low, middle, high = np.quantile(np.log(ratios), [0.25, 0.5, 0.75])
    signed = np.log([*FACTORS, *(1 / factor for factor in FACTORS)])
    nearest = signed[np.abs(signed - middle).argmin()]
    if max(abs(low - nearest), abs(high - nearest)) > TOLERANCE:
        return ""
    factor = np.exp(abs(nearest))
    way, right = ("as far as", "divide") if nearest > 0 else ("closer than", "multiply")
    return (
        f"its depth puts the person {factor:.0f} times {way} the keypoints do: {right} "
        f"depth_unit of the calibration by {factor:.0f} (it is 0.001, millimetres, if not stated)"
    )
