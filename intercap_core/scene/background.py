"""Static background depth of each depth camera.

Moving surfaces are nearer than the static scene, so the background of a pixel is the *farthest*
depth that it measures repeatedly, not the median: a person who stands still for most of the
recording does not become background. Pixels near the triangulated keypoints are ignored, so a
person who never leaves does not become background either. An object that never moves cannot be
distinguished from furniture and is part of the background.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from intercap_core.body.keypoints import keypoint_pairs, of_side
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.solve.time_series import sample_evenly

# Largest distance from a bone to skin, clothing and hair, metres: of the bones of the middle, and
# of those of either side. A pair of equal names is a ball: the hand around the wrist. These radii
# exceed those of the segmentation, because pixels left out here do no harm. Tuned on the studio.
MIDDLE_REACH_M = {
    ("neck", "mid_hip"): 0.26,
    ("nose", "neck"): 0.22,
    ("left_ear", "right_ear"): 0.20,
}
SIDE_REACH_M = {
    ("shoulder", "hip"): 0.20, ("wrist", "wrist"): 0.24, ("shoulder", "elbow"): 0.16,
    ("elbow", "wrist"): 0.14, ("hip", "knee"): 0.18, ("knee", "ankle"): 0.15,
    ("ankle", "big_toe"): 0.14, ("ankle", "heel"): 0.14,
}  # fmt: skip

_BONES = (*MIDDLE_REACH_M, *of_side("right", SIDE_REACH_M), *of_side("left", SIDE_REACH_M))
_FIRST, _SECOND = keypoint_pairs(_BONES).T
_REACH = np.array([*MIDDLE_REACH_M.values(), *SIDE_REACH_M.values(), *SIDE_REACH_M.values()])


def mask_person(
    depth: np.ndarray, lens: Intrinsics, depth_from_master: np.ndarray, joints: np.ndarray
) -> np.ndarray:
    """Return the mask (H, W) of depth pixels that lie within reach of a bone.

    Every eighth pixel in both directions is tested; the mask is enlarged by nearest neighbour.

    Args:
        depth: (H, W) uint16 mm.
        depth_from_master: (4, 4).
        joints: (K, 3) keypoints in the 135-point order, at least the body's 25, master frame,
            metres; NaN = unknown.
    """
    ends = [apply(depth_from_master, joints[index]) for index in (_FIRST, _SECOND)]
    known = np.isfinite(ends[0]).all(1) & np.isfinite(ends[1]).all(1)
    result = np.zeros(depth.shape, bool)
    if not known.any():
        return result
    start, along, reach = ends[0][known], (ends[1] - ends[0])[known], _REACH[known]
    small = np.s_[4::8, 4::8]
    z = depth[small].astype(np.float64) * 1e-3
    points = np.dstack([lens.rays[small] * z[..., None], z])
    low = np.minimum(start, start + along).min(0) - reach.max()
    high = np.maximum(start, start + along).max(0) + reach.max()
    near = (z > 0) & ((points >= low) & (points <= high)).all(-1)
    chosen = points[near][:, None]
    length = np.maximum((along**2).sum(1), 1e-9)
    share = np.clip(((chosen - start) * along).sum(-1) / length, 0, 1)
    away = ((chosen - start - share[..., None] * along) ** 2).sum(-1)
    near[near] = (away < reach**2).any(1)
    size = (depth.shape[1], depth.shape[0])
    return cv2.resize(near.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


@dataclass(frozen=True, eq=False)
class Background:
    """Static scene of one depth camera."""

    depth: np.ndarray
    """(H, W) uint16 mm; 0 = unknown."""
    static: np.ndarray
    """(H, W) bool: most sampled images show the background in this pixel."""


def camera_background(frames: Frames, c: int, joints: np.ndarray) -> Background | None:
    """Background of camera ``c``; None if it has no depth image.

    ``joints``: (T, 135, 3) keypoints of the subject, master frame, metres; NaN = unknown. Row t
    belongs to the moment that the camera's image of set t shows. Pixels near them are ignored.
    """
    camera = frames.rig[c]
    # at most 25 images, evenly spaced in time, which bounds the memory
    sets = sample_evenly(frames.depth_available[:, c], 25)
    if not len(sets) or camera.depth is None:
        return None
    images = np.stack([image for t in sets if (image := frames.depth(int(t), c)) is not None])
    person = [
        mask_person(image, camera.depth, camera.depth_from_master, joints[t])
        for image, t in zip(images, sets, strict=True)
    ]
    return steady_background(images, np.stack(person))


def steady_background(images: np.ndarray, person: np.ndarray) -> Background:
    """Background of one camera, pixel by pixel.

    The background is the farthest depth on which 20 % of a pixel's valid samples agree. If less
    than 75 % of the samples are valid, 80 % must agree: the pixel looks past the scene, and a
    passing surface may repeat. The thresholds are tuned on the studio.

    Args:
        images: (S, H, W) uint16 mm; 0 = invalid.
        person: (S, H, W) bool, samples that may show a person and are ignored.
    """
    samples, height, width = images.shape
    usable = samples - person.reshape(samples, -1).sum(0)
    ordered = np.where(person, np.uint16(0), images).reshape(samples, -1)
    _sort_samples(ordered)  # invalid zeros first
    valid = np.count_nonzero(ordered, axis=0)
    share = np.where(valid >= 0.75 * usable, 0.2, 0.8)
    needed = np.maximum(np.ceil(share * valid), min(2, samples)).astype(np.int64)
    depth, support = _farthest_clusters(ordered, needed)
    # the cluster has over half of the valid samples, and over a quarter of those without a person
    static = (depth > 0) & (support > 0.5 * np.maximum(valid, usable / 2))
    return Background(depth.reshape(height, width), static.reshape(height, width))


def _sort_samples(values: np.ndarray) -> None:
    """Sort each column of ``values`` (S, N) in ascending order, in place.

    Batcher's odd-even merge sort (Knuth, TAOCP 3, algorithm 5.2.2M): each step compares two whole
    rows, which is much faster than to sort many short columns one by one.
    """
    count = len(values)
    top = 1 << max(count - 1, 1).bit_length() - 1
    power = top
    while power:
        stage, parity, distance = top, 0, power
        while True:
            for i in range(count - distance):
                if i & power == parity:
                    low = np.minimum(values[i], values[i + distance])
                    np.maximum(values[i], values[i + distance], out=values[i + distance])
                    values[i] = low
            if stage == power:
                break
            distance, stage, parity = stage - power, stage // 2, power
        power //= 2


@numba.njit(cache=True)
def _farthest_clusters(ordered: np.ndarray, needed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median (N,), mm, and size (N,) of the farthest cluster of samples of each pixel.

    A window of ``needed`` successive sorted samples slides from the farthest sample to the nearest.
    The first window whose range is within the tolerance is chosen. The cluster consists of all
    samples within the tolerance of the window's middle. Median and size are 0 without a cluster.

    Args:
        ordered: (S, N) ascending mm; 0 = invalid.
        needed: (N,) smallest number of samples of each pixel's cluster.
    """
    samples, pixels = ordered.shape
    depth, support = np.zeros(pixels, np.uint16), np.zeros(pixels, np.int64)
    for i in range(pixels):
        for first in range(samples - needed[i], -1, -1):
            low = np.float32(ordered[first, i])
            if low == 0:
                break
            high = np.float32(ordered[first + needed[i] - 1, i])
            middle = (low + high) / np.float32(2)
            # Three standard deviations of the sensor's random error. It is about 1 mm + 0.1 % of
            # depth, more at 4 m (Toelgyessy et al., Sensors 21(2):413, 2021, NFOV)
            tolerance = np.float32(8.0) + np.float32(0.004) * middle
            if high - low <= tolerance:
                end = first + needed[i]
                while end < samples and np.float32(ordered[end, i]) - middle <= tolerance:
                    end += 1
                while first and middle - np.float32(ordered[first - 1, i]) <= tolerance:
                    first -= 1
                depth[i] = ordered[(first + end) // 2, i]
                support[i] = end - first
                break
    return depth, support
