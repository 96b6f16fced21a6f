"""The static scene as each depth camera sees it.

What moves in front of the scene is nearer than it, so a pixel's background is the *farthest*
depth that it holds steadily, not the median: someone who stands still for most of a recording
does not become background. Someone or something that never moves does: nothing tells it from
furniture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.capture.frames import Frames

MAX_SAMPLES = 25  # sets looked at; memory is this many depth images of one camera
STEADY_SHARE = 0.2  # of a pixel's valid samples that must agree
STATIC_SHARE = 0.5  # above this the pixel shows background most of the time
# Samples agree within this: three standard deviations of the sensor's random error, about 1 mm +
# 0.1 % of depth and more at 4 m (Toelgyessy et al., Sensors 21(2):413, 2021, figure of NFOV).
AGREE_MM = 8.0
AGREE_PER_DEPTH = 0.004


@dataclass(frozen=True, eq=False)
class Background:
    """``depth`` (H, W) uint16 mm, 0 = unknown; ``static`` (H, W) bool: seen in most samples."""

    depth: np.ndarray
    static: np.ndarray


def sample_sets(available: np.ndarray) -> np.ndarray:
    """At most :data:`MAX_SAMPLES` sets, evenly among those where ``available`` (T,)."""
    sets = np.flatnonzero(available)
    if len(sets) <= MAX_SAMPLES:
        return sets
    return sets[np.linspace(0, len(sets) - 1, MAX_SAMPLES).round().astype(int)]


def background_of(frames: Frames, c: int) -> Background | None:
    """The background of camera ``c``; None where it has no depth image."""
    sets = sample_sets(frames.depth_available[:, c])
    if not len(sets) or frames.rig[c].depth is None:
        return None
    images = [frames.depth(int(t), c) for t in sets]
    return steady_background(np.stack([image for image in images if image is not None]))


def steady_background(images: np.ndarray) -> Background:
    """The background of depth images (S, H, W) uint16 mm of one camera."""
    samples, height, width = images.shape
    ordered = np.sort(images.reshape(samples, -1).T, axis=1)  # (pixels, S), invalid zeros first
    valid = samples - (ordered == 0).sum(1)
    needed = np.maximum(np.ceil(STEADY_SHARE * valid), min(2, samples)).astype(int)
    depth = np.zeros(len(ordered), np.uint16)
    support = np.zeros(len(ordered))
    for count in np.unique(needed[valid >= needed]):
        rows = np.flatnonzero((needed == count) & (valid >= needed))
        depth[rows], support[rows] = _farthest_cluster(ordered[rows], int(count))
    static = (depth > 0) & (support > STATIC_SHARE * np.maximum(valid, samples / 2))
    return Background(depth.reshape(height, width), static.reshape(height, width))


def _farthest_cluster(ordered: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Median (N,) and size (N,) of the farthest ``count`` or more samples that agree.

    ``ordered`` (N, S) ascending mm, 0 = invalid. 0 and 0 where no such samples agree.
    """
    values = ordered.astype(np.float32)
    samples = values.shape[1]
    depth = np.zeros(len(values), np.uint16)
    support = np.zeros(len(values))
    open_rows = np.arange(len(values))
    for first in range(samples - count, -1, -1):
        low, high = values[open_rows, first], values[open_rows, first + count - 1]
        middle = (low + high) / 2
        tolerance = AGREE_MM + AGREE_PER_DEPTH * middle
        agree = (low > 0) & (high - low <= tolerance)
        rows = open_rows[agree]
        if len(rows):
            near = np.abs(values[rows] - middle[agree, None]) <= tolerance[agree, None]
            size = near.sum(1)
            start = np.argmax(near, 1)
            depth[rows] = ordered[rows, start + size // 2]
            support[rows] = size
        open_rows = open_rows[~agree & (low > 0)]
        if not len(open_rows):
            break
    return depth, support
