"""The static scene as each depth camera sees it.

What moves in front of the scene is nearer than it, so a pixel's background is the *farthest* depth
that it holds steadily, not the median: someone who stands still for most of a recording does not
become background. Someone who never leaves does not either, as long as the keypoints tell where
(:mod:`.person_space`); a thing that never moves does: it cannot be told from furniture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.scene.constants import (
    BACKGROUND_AGREE_MM,
    BACKGROUND_AGREE_PER_DEPTH,
    MAX_SAMPLES,
    OFTEN_VALID,
    STATIC_SHARE,
    STEADY_SHARE,
    VALID_AGREE,
)
from intercap_core.scene.person_space import person_pixels


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


def background_of(frames: Frames, c: int, joints: np.ndarray | None = None) -> Background | None:
    """The background of camera ``c``; None where it has no depth image.

    ``joints`` (T, 135, 3): the subject's keypoints at the moment that the camera's image of each
    set shows, master frame, metres, NaN = not known; what is near them is not background.
    """
    camera = frames.rig[c]
    sets = sample_sets(frames.depth_available[:, c])
    if not len(sets) or camera.depth is None:
        return None
    images = np.stack([image for t in sets if (image := frames.depth(int(t), c)) is not None])
    somebody = np.zeros(images.shape, bool)
    if joints is not None:
        for image, near, t in zip(images, somebody, sets, strict=True):
            near[:] = person_pixels(image, camera.depth, camera.depth_from_master, joints[t])
    return steady_background(images, somebody)


def steady_background(images: np.ndarray, somebody: np.ndarray | None = None) -> Background:
    """The background of depth images (S, H, W) uint16 mm of one camera; ``somebody`` (S, H, W)
    bool: a person may be there, so that the sample is no evidence of the background."""
    samples, height, width = images.shape
    told = np.full(height * width, samples)
    if somebody is not None:
        told -= somebody.reshape(samples, -1).sum(0)
        images = np.where(somebody, 0, images)
    ordered = np.sort(images.reshape(samples, -1).T, axis=1)  # (pixels, S), invalid zeros first
    valid = samples - (ordered == 0).sum(1)
    share = np.where(valid >= OFTEN_VALID * told, STEADY_SHARE, VALID_AGREE)
    needed = np.maximum(np.ceil(share * valid), min(2, samples)).astype(int)
    depth = np.zeros(len(ordered), np.uint16)
    support = np.zeros(len(ordered))
    for count in np.unique(needed[valid >= needed]):
        rows = np.flatnonzero((needed == count) & (valid >= needed))
        depth[rows], support[rows] = _farthest_cluster(ordered[rows], int(count))
    static = (depth > 0) & (support > STATIC_SHARE * np.maximum(valid, told / 2))
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
        tolerance = BACKGROUND_AGREE_MM + BACKGROUND_AGREE_PER_DEPTH * middle
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
