"""Observations of the person in all frames: keypoints and cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.keypoints import (
    BODY,
    CONTOUR,
    FACE,
    KEYPOINT_INDEX,
    LEFT_HAND,
    NUM_KEYPOINTS,
    RIGHT_HAND,
)
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig
from intercap_core.schemas import PERSON, SCENE

# Keypoints that place the trunk.
TRUNK_KEYPOINTS = [
    KEYPOINT_INDEX[name]
    for name in ("neck", "right_shoulder", "left_shoulder", "mid_hip", "right_hip", "left_hip")
]


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations in T frames and C cameras, with K = 135 keypoints."""

    sequence: str
    rig: Rig
    keypoints: np.ndarray
    """(T, C, K, 2) float32, px."""
    confidence: np.ndarray
    """(T, C, K) float32, 0 = not detected."""
    joints: np.ndarray
    """(T, K, 3) float32 triangulated keypoints, master frame, metres, NaN = unknown."""
    joint_views: np.ndarray
    """(T, K) number of views of each triangulated keypoint."""
    background: list[np.ndarray | None]
    """Depth image of the empty room in each camera, mm; None = unknown."""
    depth_bias: np.ndarray
    """(C,) excess of the depth that each camera measures, metres."""
    image_of: np.ndarray
    """(T, C) index of the recorded frame set whose image of camera c was exposed at the time of
    frame t, -1 = none."""
    time_offset: np.ndarray
    """(C,) delay of each camera's exposure after the time of the frame, seconds."""
    times: np.ndarray
    """(T,) time of each frame, seconds."""

    @property
    def num_frames(self) -> int:
        return len(self.times)

    @property
    def placed(self) -> np.ndarray:
        """(T,) bool: three keypoints of the trunk are triangulated, enough to place a body."""
        trunk = self.joints[:, TRUNK_KEYPOINTS]
        return np.isfinite(trunk).all(2).sum(1) >= 3

    @cached_property
    def usable(self) -> np.ndarray:
        """(T,) bool: frames that are fitted.

        A frame is usable if a body can be placed (:attr:`placed`). It also is if six body keypoints
        are triangulated and a body can be placed in a frame within 1 s: a single view from the side
        or over a table may see only one shoulder. Both numbers are tuned on the studio.
        """
        placed = self.placed
        if not placed.any():
            return placed
        near = self.times[placed]
        after = np.searchsorted(near, self.times).clip(1, max(len(near) - 1, 1))
        gap = np.abs(self.times - near[np.stack([after - 1, after % len(near)])]).min(0)
        known = np.isfinite(self.joints[:, BODY]).all(2).sum(1)
        return placed | ((gap <= 1.0) & (known >= 6))

    @cached_property
    def median_confidence(self) -> np.ndarray:
        """(K,) median confidence of detected keypoints in usable frames, by part of the body.

        1 for a part that is never detected.
        """
        median = np.ones(NUM_KEYPOINTS)
        for part in (BODY, LEFT_HAND, RIGHT_HAND, slice(FACE.start, CONTOUR.stop)):
            confidence = self.confidence[self.usable, :, part]
            detected = confidence[confidence > 0]
            if len(detected):
                median[part] = np.median(detected)
        return median

    @property
    def cameras_of_person(self) -> np.ndarray:
        """(C,) bool: the camera shows a keypoint of the body in a usable frame."""
        return np.asarray((self.confidence[self.usable, :, BODY] > 0).any((0, 2)))

    def window(self, frames: slice | np.ndarray) -> Observations:
        """Return the observations of some frames, a slice or indices."""
        by_frame = ("keypoints", "confidence", "joints", "joint_views", "image_of", "times")
        return replace(self, **{name: getattr(self, name)[frames] for name in by_frame})


def read_observations(scene: Path, person: Path) -> Observations:
    """Read the observations. Raises UserError if the artefacts do not belong together."""
    with artefacts.read(scene, SCENE) as read:
        rig = Rig.from_artefact(read)
        sequence = str(read.attributes["sequence"])
        times = read["times"]
        image_of, time_offset = read["image_of"], read["time_offset"]
        depth_bias = read["depth_bias"]
        keys = set(read.keys("cameras/"))
        background = [
            read[f"cameras/{name}/background"] if f"cameras/{name}/background" in keys else None
            for name in rig.names
        ]
    with artefacts.read(person, PERSON) as read:
        names = tuple(read.text("camera_names"))
        if names != rig.names or len(read["missing"]) != len(times):
            raise UserError(
                f"{person}: has {len(read['missing'])} frames of cameras {', '.join(names)}, "
                f"expected {len(times)} of {', '.join(rig.names)} as in {scene}; re-run stage "
                "'person' for this sequence"
            )
        keypoints, joints, views = read["keypoints"], read["joints"], read["joint_views"]
        inlier = read["inlier"]
    confidence = np.clip(np.nan_to_num(keypoints[..., 2]), 0.0, 1.0)
    # keypoints of a view that disagree with the triangulated point lose most of their confidence;
    # the factor is tuned on the studio
    outlier = (views >= 2)[:, None] & ~inlier
    confidence[outlier] = 0.2 * confidence[outlier].astype(np.float64)
    confidence[~np.isfinite(keypoints[..., :2]).all(-1)] = 0
    return Observations(
        sequence=sequence,
        rig=rig,
        keypoints=np.nan_to_num(keypoints[..., :2]),
        confidence=confidence,
        joints=joints,
        joint_views=views,
        background=background,
        depth_bias=depth_bias,
        image_of=image_of,
        time_offset=time_offset,
        times=times,
    )
