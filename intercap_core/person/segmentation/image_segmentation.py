"""Masks and candidates from images alone: by depth if the camera has depth, else by colour."""

from __future__ import annotations

import logging

import numpy as np

from intercap_core.artefacts import Artefact
from intercap_core.formats.recordings.frames import Frames
from intercap_core.person.segmentation.candidate_masks import ViewSegments
from intercap_core.person.segmentation.colour_candidates import ColourSegmenter
from intercap_core.person.segmentation.depth_candidates import DepthSegmenter
from intercap_core.progress import Progress

log = logging.getLogger(__name__)


def segment_images(
    frames: Frames, scene: Artefact, joints: np.ndarray, sigma: np.ndarray, wanted: np.ndarray
) -> dict[tuple[int, int], ViewSegments]:
    """Segment images; returns results by (moment, camera). Images that cannot be segmented lack
    one.

    Args:
        frames: read by the moment that their images show.
        scene: the scene artefact.
        joints: (T, 135, 3) the subject's keypoints, master frame, metres; NaN = unknown.
        sigma: (T, 135) standard deviations of the keypoints, metres.
        wanted: (T, C) bool, images to segment.
    """
    posed = np.isfinite(scene["master_from_colour"]).all((1, 2)) & scene["present"]
    wanted = wanted & posed
    result: dict[tuple[int, int], ViewSegments] = {}
    depth = wanted & frames.depth_available
    if depth.any() and np.isfinite(joints).any():
        segmenter = DepthSegmenter(
            frames, scene, joints, sigma, np.flatnonzero(depth.any(0)).tolist()
        )
        moments = np.flatnonzero(depth.any(1)).tolist()
        progress = Progress(log, "segmented", len(moments), "frames by depth")
        for t in moments:
            segments = segmenter.segment(t, np.flatnonzero(depth[t]).tolist())
            result.update({(t, c): view for c, view in segments.items()})
            progress.step()
    colour = wanted & ~depth & frames.colour_available
    if colour.any() and np.isfinite(joints).any():
        by_colour = ColourSegmenter(frames, scene, joints, sigma)
        progress = Progress(log, "segmented", int(colour.sum()), "images by colour")
        for t, c in np.argwhere(colour).tolist():
            view = by_colour.segment(t, c)
            if view is not None:
                result[t, c] = view
            progress.step()
    return result
