"""Datasets of the object_track artefact: of a track, and of a recording without an object."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from intercap_core.schemas import OBJECT_TRACK

if TYPE_CHECKING:  # the pipeline reads SOURCE_NONE without the tracker's imports
    from intercap_core.object_track.tracker import Track

SOURCE_NONE = "none"
"""The artefact's ``seed_source`` without an object."""
NOT_NAMED = "the sequence names no object: a person alone"

_UNKNOWN = {"f": np.nan, "i": -1, "b": False}
"""Value for "unknown" by the kind of a dtype."""


def absent_track(frames: int, cameras: int) -> dict[str, np.ndarray]:
    """Return all datasets but ``camera_names`` of a recording without an object.

    Every frame is lost, poses are NaN, and no candidate is chosen.
    """
    lengths = {"T": frames, "C": cameras}
    datasets = {}
    for key, field in OBJECT_TRACK.fields.items():
        if field.dtype != "str" and not field.optional:
            shape = [lengths[dim] if dim in lengths else int(dim) for dim in field.dims]
            dtype = np.dtype(field.dtype)
            datasets[key] = np.full(shape, _UNKNOWN[dtype.kind], dtype)
    return datasets | {
        "lost": np.ones(frames, bool),
        "views": np.zeros(frames, np.int8),
        "probability": np.zeros(frames, np.float32),
    }


def track_datasets(track: Track, cameras: list[int], count: int) -> dict[str, np.ndarray]:
    """Return all datasets but ``camera_names`` of a track.

    ``cameras`` are the indices of the cameras with views in the rig of ``count`` cameras. Cameras
    without a view have -1 and NaN.
    """
    frames = track.frames
    shape = (len(frames), count)
    candidate = np.full(shape, -1, np.int32)
    overlap, depth, contour = (np.full(shape, np.nan, np.float32) for _ in range(3))
    for t, frame in enumerate(frames):
        for c, view in zip(cameras, frame.fit.views, strict=True):
            candidate[t, c] = view.candidate
            overlap[t, c] = view.overlap
            depth[t, c] = view.depth_residual_m
            contour[t, c] = view.contour_residual_px
    poses = np.array([frame.fit.pose for frame in frames])
    datasets = {
        "rotation": poses[:, :3, :3],
        "translation": poses[:, :3, 3],
        "candidate": candidate,
        "overlap": overlap,
        "depth_residual": depth,
        "silhouette_residual": contour,
        "views": np.array([frame.fit.support for frame in frames], np.int8),
        "covariance": np.array([frame.fit.covariance + frame.spread for frame in frames]),
        "probability": np.array([frame.probability for frame in frames], np.float32),
    }
    for key in ("spread", "lost", "gone", "recovered", "ambiguous", "resting", "free_axis"):
        datasets[key] = np.array([getattr(frame, key) for frame in frames])
    if track.annotated:
        datasets["carried"] = np.array([frame.carried for frame in frames])
    return datasets
