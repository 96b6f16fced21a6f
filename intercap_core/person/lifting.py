"""Keypoints seen by a single view, lifted to 3D by the depth around their pixels.

Depth measures the skin, but a keypoint is a joint inside the body. The point therefore lies deeper
on the pixel's ray by an inset that depends on the joint.

The depth at an occluded joint belongs to another surface. Pixels that show the background of the
scene are skipped. In a side view, both shoulders or hips are lifted to nearly one place. The limb
with less confidence is then occluded and left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial import cKDTree

from intercap_core.artefacts import Artefact
from intercap_core.body.keypoints import KEYPOINT_NAMES, LEFT_HAND, RIGHT_HAND
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.clouds import depth_points
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.camera.triangulation import Triangulation
from intercap_core.person.groups import NOBODY
from intercap_core.person.sides import ARMS, BODY_POINTS, LEGS

# Depth of a keypoint below the skin, metres: measured on the open body, standing, as the median
# over all horizontal directions. Keypoints without an entry lie on the skin.
INSET_M = {
    "neck": 0.065,
    "shoulder": 0.060,
    "elbow": 0.046,
    "wrist": 0.026,
    "mid_hip": 0.13,
    "hip": 0.106,
    "knee": 0.059,
    "ankle": 0.040,
}


def _inset(index: int, name: str) -> float:
    if index in range(LEFT_HAND.start, RIGHT_HAND.stop):
        return 0.008  # half a finger (anatomy)
    return INSET_M.get(name.removeprefix("left_").removeprefix("right_"), 0.0)


INSETS_M = np.array([_inset(i, name) for i, name in enumerate(KEYPOINT_NAMES)])  # (135,)


@dataclass(frozen=True, eq=False)
class DepthRelief:
    """Depth pixels projected into the colour image."""

    camera: Camera
    """A camera with depth and colour."""
    pixels: np.ndarray
    """(N, 2) in the colour image."""
    distance: np.ndarray
    """(N,) along the ray, metres."""
    room: np.ndarray
    """(N,) bool: shows the scene's background."""

    @classmethod
    def of(
        cls, depth: np.ndarray, camera: Camera, bias_m: float, background: np.ndarray | None
    ) -> DepthRelief:
        """Project every second pixel of every second row of a depth image into the colour image.

        Args:
            depth: (H, W) uint16 mm.
            bias_m: systematic error to subtract from the depth, metres.
            background: (H, W) uint16 mm of the scene; None = unknown.
        """
        thinned = np.zeros_like(depth)
        some = np.s_[::2, ::2]
        thinned[some] = depth[some]
        points, index = depth_points(thinned, camera)
        room = np.zeros(len(index), bool)
        if background is not None:
            behind, here = background.ravel()[index].astype(int), depth.ravel()[index].astype(int)
            room = (behind > 0) & (here > behind - 40)  # tolerance 40 mm; tuned on the studio
        if bias_m:
            points = points * (1 - np.float32(bias_m) / points[:, 2:])
        assert camera.colour_from_depth is not None
        points = apply(camera.colour_from_depth, points)
        inside = camera.colour.inside_model(points)
        points = points[inside]
        distance = np.linalg.norm(points, axis=1)
        return cls(camera, camera.colour.project(points), distance, room[inside])

    def lift(self, pixels: np.ndarray, seen: np.ndarray, inset_m: np.ndarray) -> np.ndarray:
        """Points (K, 3), master frame, metres, of keypoints at ``pixels`` (K, 2); NaN = unknown.

        The surface at a keypoint is the median depth of the nearest layer, 5 cm thick, within 3 cm
        of its pixel, of at least four pixels. Background pixels are only used if fewer than four
        others are near. Such a point is kept if its distance is within 25 cm of the median of the
        other points, or if there are fewer than six others: a person who stands still for long is
        part of the background.

        Args:
            seen: (K,) bool, keypoints to lift.
            inset_m: (K,) depth of each keypoint below the skin, metres.
        """
        result, of_room = np.full((len(pixels), 3), np.nan), np.zeros(len(pixels), bool)
        rays = self.camera.colour.unproject(pixels)
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        wanted = np.flatnonzero(seen & np.isfinite(rays).all(1))
        if not len(wanted) or not len(self.distance):
            return result
        reach = self.camera.colour.fx * 0.03 / self.distance  # px of 3 cm; tuned on the studio
        around = self._tree.query_ball_point(pixels[wanted], reach.max(), p=np.inf)
        for k, near in zip(wanted, around, strict=True):
            away = np.abs(self.pixels[near] - pixels[k]).max(1)
            around_it = np.asarray(near, int)[away < reach[near]]
            before = around_it[~self.room[around_it]]
            # pixels; at 3 m, a Kinect has about 25 of the thinned pixels within 3 cm of a point
            enough = 4
            of_room[k] = len(before) < enough
            distances = self.distance[around_it if of_room[k] else before]
            if len(distances) < enough:
                continue
            nearest = np.quantile(distances, 0.2)  # the closest samples may be flying pixels
            layer = distances < nearest + 0.05  # metres; tuned on the studio
            surface = np.median(distances[layer])
            result[k] = rays[k] * (surface + inset_m[k])
        away = np.linalg.norm(result, axis=1)
        body = np.isfinite(away) & ~of_room
        if body.sum() >= 6:
            apart = np.abs(away - np.median(away[body]))
            result[of_room & ~(apart < 0.25)] = np.nan  # metres along the ray; tuned
        return apply(self.camera.master_from_colour, result)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.pixels, balanced_tree=False, compact_nodes=False)


class Lifter:
    """Lifts keypoints of single views.

    ``frames`` must be read by moment. ``scene`` gives calibration, depth biases and backgrounds.
    """

    def __init__(self, frames: Frames, scene: Artefact, *, min_confidence: float) -> None:
        self._frames, self._min_confidence = frames, min_confidence
        self._rig = Rig.from_artefact(scene)
        self._bias = np.nan_to_num(scene["depth_bias"])
        known = set(scene.keys("cameras/"))
        keys = (f"cameras/{name}/background" for name in self._rig.names)
        self._background = [scene[key] if key in known else None for key in keys]
        self._relief = lru_cache(maxsize=len(self._rig))(self._load)

    def _load(self, t: int, c: int) -> DepthRelief | None:
        camera = self._rig[c]
        depth = self._frames.depth(t, c) if camera.depth is not None else None
        if depth is None:
            return None
        return DepthRelief.of(depth, camera, float(self._bias[c]), self._background[c])

    def people(self, t: int, c: int, people: np.ndarray) -> np.ndarray:
        """Points (P, 25, 3) of body keypoints (P, 25, 3) in view ``c`` of set ``t``; see
        :data:`intercap_core.person.groups.Lift`."""
        relief = self._relief(t, c)
        if relief is None:
            return np.full(people.shape, np.nan)
        seen = people[..., 2] >= self._min_confidence
        inset = INSETS_M[BODY_POINTS]
        return np.stack(
            [relief.lift(body[:, :2], s, inset) for body, s in zip(people, seen, strict=True)]
        )

    def fill(
        self, person: np.ndarray, keypoints: np.ndarray, triangulation: Triangulation
    ) -> np.ndarray:
        """Lift missing points of sets with fewer than 8 triangulated body points.

        Each such set uses the one view that yields most points; it becomes the only inlier of the
        new points. ``triangulation`` is changed in place.

        Args:
            person: (T, C) index of the subject's detection; -1 = not seen.
            keypoints: (T, C, 135, 3) of the subject.
            triangulation: triangulation of T * 135 points.

        Returns:
            (T,) bool, sets with lifted points.
        """
        sets, views = person.shape
        points = triangulation.points.reshape(sets, -1, 3)
        inlier = triangulation.inlier.reshape(sets, -1, views)
        triangulated = np.isfinite(points[:, BODY_POINTS, 0]).sum(1)
        lifted = np.zeros(sets, bool)
        for t in np.flatnonzero(triangulated < 8):
            best, best_view = np.full(points.shape[1:], np.nan), -1
            for c in np.flatnonzero(person[t] != NOBODY):
                relief = self._relief(int(t), int(c))
                if relief is None:
                    continue
                seen = keypoints[t, c, :, 2] >= self._min_confidence
                option = relief.lift(keypoints[t, c, :, :2], seen, INSETS_M)
                option[_hidden_side(option, keypoints[t, c, :, 2])] = np.nan
                if np.isfinite(option[:, 0]).sum() > np.isfinite(best[:, 0]).sum():
                    best, best_view = option, int(c)
            new = np.isnan(points[t, :, 0]) & np.isfinite(best[:, 0])
            points[t, new], inlier[t, new, best_view] = best[new], True
            lifted[t] = new.any()
        return lifted


def _hidden_side(points: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Mask (135,) of lifted ``points`` (135, 3) that the body itself must occlude.

    If both shoulders (hips) are closer than half of an adult's breadth, 18 cm (9 cm), one arm (leg)
    is occluded. It is the one whose shoulder (hip) has less confidence. Of that limb, the points
    with less confidence than those of the other side are masked.
    """
    hidden = np.zeros(len(points), bool)
    for limb, breadth in ((ARMS, 0.18), (LEGS, 0.09)):
        left, right = np.split(limb, 2)
        if np.linalg.norm(points[left[0]] - points[right[0]]) < breadth:
            sure = confidence[left] > confidence[right]
            side = right if sure[0] else left
            hidden[side] = sure if sure[0] else ~sure
    return hidden
