"""Keypoints of one view lifted to 3D by the depth beside them, where no second view sees them.

Depth measures the skin, a keypoint is a joint inside the body: the point lies deeper on the pixel's
ray by an inset of its own. The depth at an occluded joint is of another surface: pixels of the
scene's background are skipped, and where a side view shows both shoulders or hips in one place, the
one that the detector trusts less is occluded and left out with its limb.
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

KEYPOINT_REACH_M = 0.03  # half side, across the ray, of where depth is read; tuned
MIN_DEPTH_SAMPLES = 4  # depth pixels; tuned on the studio
# Quantile of the samples that counts as nearest: nearer ones may float between body and background.
NEAREST_QUANTILE = 0.2  # tuned on the studio
SURFACE_M = 0.05  # samples this far behind the nearest are another surface; tuned on the studio
AT_BACKGROUND_MM = 40  # within this of the scene's background a pixel shows it; tuned on the studio
DEPTH_STRIDE = 2  # pixels and rows; a quarter of the depth image is enough around a joint
# How deep a keypoint lies under the skin, metres: measured on the open body (`body.loading`),
# standing, the median over all horizontal directions. What is not named lies on the skin.
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
HAND_INSET_M = 0.008  # half a finger's thickness
# Between shoulders, between hips, metres, half of an adult's breadth: nearer, one occludes the
# other.
OCCLUDED_BREADTH_M = (0.18, 0.09)
BODY_DEPTH_M = 0.25  # from the body's middle, along the ray, an unmoving part may lie; tuned
ENOUGH_TRIANGULATED = 8  # body points; a set with so many needs no lifting; tuned on the studio
MIN_MOVING_POINTS = (
    6  # points before the background; with fewer, the person is taken for part of it
)


def _insets() -> np.ndarray:
    """(135,) metres."""
    parts = [name.removeprefix("left_").removeprefix("right_") for name in KEYPOINT_NAMES]
    inset = np.array([INSET_M.get(part, 0.0) for part in parts])
    inset[LEFT_HAND] = inset[RIGHT_HAND] = HAND_INSET_M
    return inset


INSETS_M = _insets()


@dataclass(frozen=True, eq=False)
class DepthRelief:
    """What a depth image shows, as the colour camera sees it.

    ``pixels`` (N, 2) of the colour image and ``distance`` (N,) along the ray, metres; ``room`` (N,)
    bool where the scene's background is seen.
    """

    camera: Camera
    pixels: np.ndarray
    distance: np.ndarray
    room: np.ndarray

    @classmethod
    def of(
        cls, depth: np.ndarray, camera: Camera, bias_m: float, background: np.ndarray | None
    ) -> DepthRelief:
        """Every second pixel of every second row of ``depth`` (H, W) uint16 mm.

        ``bias_m`` is subtracted from the depth. ``background`` (H, W) of the scene, None = unknown.
        """
        thinned = np.zeros_like(depth)
        some = np.s_[::DEPTH_STRIDE, ::DEPTH_STRIDE]
        thinned[some] = depth[some]
        points, index = depth_points(thinned, camera)
        room = np.zeros(len(index), bool)
        if background is not None:
            behind, here = background.ravel()[index].astype(int), depth.ravel()[index].astype(int)
            room = (behind > 0) & (here > behind - AT_BACKGROUND_MM)
        if bias_m:
            points = points * (1 - np.float32(bias_m) / points[:, 2:])
        assert camera.colour_from_depth is not None
        points = apply(camera.colour_from_depth, points)
        inside = camera.colour.inside_model(points)
        points = points[inside]
        distance = np.linalg.norm(points, axis=1)
        return cls(camera, camera.colour.project(points), distance, room[inside])

    def lift(self, pixels: np.ndarray, seen: np.ndarray, inset_m: np.ndarray) -> np.ndarray:
        """Points (K, 3), master frame, of keypoints at ``pixels`` (K, 2) where ``seen`` (K,).

        ``inset_m`` (K,): how deep each lies. NaN where nothing is measured, or only the room; but
        who stands still for long is part of the room: that counts where it is as far away as the
        rest of the body, or where there is hardly any rest.
        """
        result, of_room = np.full((len(pixels), 3), np.nan), np.zeros(len(pixels), bool)
        rays = self.camera.colour.unproject(pixels)
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        wanted = np.flatnonzero(seen & np.isfinite(rays).all(1))
        if not len(wanted) or not len(self.distance):
            return result
        reach = self.camera.colour.fx * KEYPOINT_REACH_M / self.distance
        around = self._tree.query_ball_point(pixels[wanted], reach.max(), p=np.inf)
        for k, near in zip(wanted, around, strict=True):
            away = np.abs(self.pixels[near] - pixels[k]).max(1)
            around_it = np.asarray(near, int)[away < reach[near]]
            before = around_it[~self.room[around_it]]
            of_room[k] = len(before) < MIN_DEPTH_SAMPLES
            found = self.distance[around_it if of_room[k] else before]
            if len(found) < MIN_DEPTH_SAMPLES:
                continue
            nearest = np.quantile(found, NEAREST_QUANTILE)
            surface = np.median(found[found < nearest + SURFACE_M])
            result[k] = rays[k] * (surface + inset_m[k])
        away = np.linalg.norm(result, axis=1)
        body = np.isfinite(away) & ~of_room
        if body.sum() >= MIN_MOVING_POINTS:
            apart = np.abs(away - np.median(away[body]))
            result[of_room & ~(apart < BODY_DEPTH_M)] = np.nan
        return apply(self.camera.master_from_colour, result)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.pixels, balanced_tree=False, compact_nodes=False)


class Lifter:
    """Lifts keypoints of a recording's single views.

    ``frames`` read by the moment that their images show, ``scene`` the scene artefact.
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
        :data:`intercap_core.person.subject.Lift`."""
        relief = self._relief(t, c)
        if relief is None:
            return np.full(people.shape, np.nan)
        seen = people[..., 2] >= self._min_confidence
        inset = INSETS_M[BODY_POINTS]
        return np.stack(
            [relief.lift(body[:, :2], s, inset) for body, s in zip(people, seen, strict=True)]
        )

    def fill(self, person: np.ndarray, keypoints: np.ndarray, found: Triangulation) -> np.ndarray:
        """Lift, in place, what ``found`` (T * 135 points) lacks where few points are triangulated.

        ``person`` (T, C) and ``keypoints`` (T, C, 135, 3) are the subject's. A set takes its points
        from the view that gives most of them; that view counts as the one that agrees. Returns the
        sets (T,) bool that were lifted.
        """
        sets, views = person.shape
        points = found.points.reshape(sets, -1, 3)
        inlier = found.inlier.reshape(sets, -1, views)
        triangulated = np.isfinite(points[:, BODY_POINTS, 0]).sum(1)
        lifted = np.zeros(sets, bool)
        for t in np.flatnonzero(triangulated < ENOUGH_TRIANGULATED):
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
    """Keypoints (135,) bool that the body itself must hide, of lifted ``points`` (135, 3).

    Of a shoulder or hip that coincides with the other one, the limb that the detector trusts less.
    """
    hidden = np.zeros(len(points), bool)
    for limb, breadth in zip((ARMS, LEGS), OCCLUDED_BREADTH_M, strict=True):
        left, right = np.split(limb, 2)
        if np.linalg.norm(points[left[0]] - points[right[0]]) < breadth:
            sure = confidence[left] > confidence[right]
            side = right if sure[0] else left
            hidden[side] = sure if sure[0] else ~sure
    return hidden
