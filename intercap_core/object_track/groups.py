"""Groups of candidates of different views that may show one object, and their outlines.

In a view with depth, the measured points of a candidate give its position; a candidate with too few
points is ignored. Without depth, the rays through the middles of two views' masks give it, if they
meet and both masks have the object's size there.

The outline of a mask is its support function h(d) = max over its pixels p of d . p: its extent in
each direction of the image. The object's own support is reached at a vertex of its convex hull, so
residuals of hundreds of poses need no rendering. Parts that a person or the image's edge cuts off
are unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from intercap_core.formats.detections.instance import PERSON_LABEL
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.camera.triangulation import midpoints
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.object_silhouette import rim_pixels
from intercap_core.object_track.view import MaskCandidate, View

OUTLINE_DIRECTIONS = 16  # image directions in which the support function is sampled; tuned
LOCATED_MIN_POINTS = 15  # of a candidate's point cloud, or pixels of its mask; tuned on the studio


_ANGLES = 2 * np.pi * np.arange(OUTLINE_DIRECTIONS) / OUTLINE_DIRECTIONS
_COMPASS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], 1)
"""(D, 2) unit vectors of the image directions."""


@dataclass(frozen=True, eq=False)
class MaskOutline:
    """Support function of one view's mask, in the plane z = 1 of its undistorted colour camera."""

    support: np.ndarray
    """(D,) h(d) of each direction."""
    known: np.ndarray
    """(D,) bool, false where the mask is cut off."""
    middle: np.ndarray
    """(2,) middle of the mask, in the plane z = 1."""
    extent: float
    """Largest width, in the plane z = 1."""
    colour_from_master: np.ndarray
    """(4, 4) of the camera."""

    @classmethod
    def of(cls, view: View, candidate: MaskCandidate) -> MaskOutline | None:
        """Compute the outline of a candidate's mask; None if it is cut off in all directions."""
        mask, lens = candidate.mask, view.geometry.lens
        pixels, _ = rim_pixels(np.pad(mask.mask, 1))
        x, y = pixels[:, 0] + (mask.x0 - 1), pixels[:, 1] + (mask.y0 - 1)
        rays = lens.rays[y, x].astype(np.float64)
        fine = np.isfinite(rays[:, 0])
        x, y, rays = x[fine], y[fine], rays[fine]
        if not len(rays):
            return None
        reach = rays @ _COMPASS.T
        ends = reach.argmax(0)
        support = reach[ends, np.arange(OUTLINE_DIRECTIONS)]
        width = support + np.roll(support, OUTLINE_DIRECTIONS // 2)
        known = ~_is_cut_off(view, candidate, x[ends], y[ends])
        if not known.any():
            return None
        # Steiner point of the convex hull: 2 x the mean over directions d of h(d) d
        middle = (support[:, None] * _COMPASS).sum(0) * 2 / OUTLINE_DIRECTIONS
        pose = view.geometry.camera.colour_from_master
        return cls(support, known, middle, float(width.max()), pose)

    @property
    def eye(self) -> np.ndarray:
        """Centre (3,) of the camera, master frame."""
        return -self.colour_from_master[:3, :3].T @ self.colour_from_master[:3, 3]

    @property
    def ray(self) -> np.ndarray:
        """Unit direction (3,) through the middle, master frame."""
        ray = self.colour_from_master[:3, :3].T @ np.append(self.middle, 1.0)
        return ray / np.linalg.norm(ray)


def _is_cut_off(view: View, candidate: MaskCandidate, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return whether mask pixels x, y (N,) are within 2 px of a person or the image's edge."""
    lens, near = view.geometry.lens, 2
    cut = (x < near) | (y < near)
    cut |= (x >= lens.width - near) | (y >= lens.height - near)
    for dx in range(-near, near + 1):
        for dy in range(-near, near + 1):
            other = view.person.sample(x + dx, y + dy)
            cut |= other & ~candidate.mask.sample(x + dx, y + dy)
    return cut


def hull_vertices(mesh: ObjectMesh) -> np.ndarray:
    """Return the vertices (H, 3) of the mesh's convex hull."""
    from scipy.spatial import ConvexHull

    return mesh.vertices[ConvexHull(mesh.vertices).vertices]


def outline_residuals(
    outline: MaskOutline, hull: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute how far the object extends beyond a mask, and the Jacobian, for N poses.

    The difference of the two support functions is multiplied by the object's depth, which gives
    metres at the object.

    Args:
        outline: outline of the mask.
        hull: (H, 3) vertices of the convex hull, object frame.
        rotation, translation: (N, 3, 3) and (N, 3) of master_from_object.

    Returns:
        residual: (N, D) metres, negative if the mask extends farther, zero where it is cut off.
        jacobian: (N, D, 6) by the step (turn, shift) in the object frame: pose <- pose * exp(step).
    """
    pose = outline.colour_from_master
    turned = pose[:3, :3] @ rotation
    placed = translation @ pose[:3, :3].T + pose[:3, 3]
    points = np.einsum("nij,hj->nhi", turned, hull) + placed[:, None]
    least_m = 0.1  # depth of points near and behind the camera, so that divisions stay finite
    z = np.maximum(points[..., 2], least_m)
    flat = points[..., :2] / z[..., None]
    reach = flat @ _COMPASS.T  # (N, H, D)
    ends = reach.argmax(1)
    number = np.arange(len(rotation))[:, None]
    distance = np.maximum(placed[:, 2], least_m)[:, None]
    residual = (np.take_along_axis(reach, ends[:, None], 1)[:, 0] - outline.support) * distance
    towards = np.broadcast_to(_COMPASS, (len(rotation), OUTLINE_DIRECTIONS, 2))
    along = -(towards * flat[number, ends]).sum(-1, keepdims=True)
    by_camera = np.concatenate([towards, along], -1) * (distance / z[number, ends])[..., None]
    by_shift = by_camera @ turned
    by_turn = np.cross(hull[ends], by_shift)
    jacobian = np.concatenate([by_turn, by_shift], -1)
    return residual * outline.known, jacobian * outline.known[:, None]


@dataclass(frozen=True, eq=False)
class LocatedCandidate:
    """One candidate of one view, with the position that it gives."""

    view: int
    """Index of the view."""
    candidate: MaskCandidate
    """The candidate."""
    label_prior: float
    """1 with one of the object's labels, less otherwise."""
    points: np.ndarray
    """(N, 3) measured points, master frame; empty without depth."""
    centre: np.ndarray | None
    """(3,) median of the points; None without depth."""
    image: View
    """The view."""

    @cached_property
    def outline(self) -> MaskOutline | None:
        """Outline of the mask, None if all of it is cut off; computed on request."""
        return MaskOutline.of(self.image, self.candidate)

    def away(self, point: np.ndarray, diameter: float) -> float:
        """Return the distance of the candidate from a point (3,); below 1 it may be the object.

        The unit is the largest distance that is possible within one object. Infinite if the mask's
        width is not that of the object at the point.
        """
        slack_m = 0.03  # added to all sizes; tuned on the studio, as the shares below
        if self.centre is not None:  # two sides of one object are 0.6 of its diameter apart
            return float(np.linalg.norm(self.centre - point)) / (0.6 * diameter + slack_m)
        outline = self.outline
        assert outline is not None
        towards = point - outline.eye
        along = float(towards @ outline.ray)
        # narrow if seen end on or half hidden, wide if smeared by motion
        if not 0.12 * diameter < outline.extent * along < 1.25 * diameter + slack_m:
            return np.inf
        across = float(np.linalg.norm(towards - along * outline.ray))
        return across / (0.35 * diameter + slack_m)


Group = list[LocatedCandidate]
"""At most one candidate of each view."""


def find_groups(
    mesh: ObjectMesh,
    views: list[View],
    labels: tuple[str, ...],
    place_prior: Callable[[np.ndarray], float] | None = None,
    limit: int = 3,
) -> list[Group]:
    """Find groups of candidates that may be the object.

    The points of a candidate with depth give a place, and so does each crossing of the rays of two
    views. The nearest candidate of every other view joins the place if it is near enough. Groups
    are ranked by the sum of their candidates' label priors times the prior of the place.

    Args:
        mesh: the object.
        views: views of the frame set.
        labels: detector classes of the object.
        place_prior: prior of a position (3,) to be that of the object; groups at 0 are dropped.
        limit: largest number of groups.

    Returns:
        The groups, the most likely first.
    """
    measured = _locate_by_depth(views, mesh.diameter, labels)
    outlined = _locate_by_outline(views, labels)
    places = [(s.centre, [s]) for s in measured if s.centre is not None]
    places += [(point, []) for point in _ray_crossings(outlined, mesh.diameter)]
    sightings = measured + outlined
    groups: list[tuple[float, Group]] = []
    for place, anchor in places:
        group = list(anchor)
        for view in sorted({s.view for s in sightings} - {s.view for s in anchor}):
            others = [s for s in sightings if s.view == view]
            away = [s.away(place, mesh.diameter) for s in others]
            nearest = int(np.argmin(away))
            if away[nearest] < 1:
                group.append(others[nearest])
        value = sum(s.label_prior for s in group)
        if place_prior is not None:
            value *= place_prior(locate_group(group))
        if value > 0:
            groups.append((value, group))
    groups.sort(key=lambda item: -item[0])
    return _distinct_groups([group for _, group in groups], limit)


def locate_group(group: Group) -> np.ndarray:
    """Return the position (3,) of a group: the mean over its views of their mean points.

    Views count equally, because a near view has more points but does not show more of the object.
    Without depth it is the point nearest to the rays.
    """
    means = [s.points.mean(0) for s in group if len(s.points)]
    if means:
        return np.mean(means, axis=0)
    eyes = np.array([s.outline.eye for s in group if s.outline])
    rays = np.array([s.outline.ray for s in group if s.outline])
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, eyes))


def _distinct_groups(groups: list[Group], limit: int) -> list[Group]:
    """Keep the first ``limit`` groups that share at most half of their members with a kept one."""
    kept: list[Group] = []
    for group in groups:
        if len(kept) == limit:
            break
        members = {(s.view, s.candidate.index) for s in group}
        known = [{(s.view, s.candidate.index) for s in other} for other in kept]
        if all(len(members & other) <= 0.5 * len(members) for other in known):
            kept.append(group)
    return kept


def _ray_crossings(outlined: list[LocatedCandidate], diameter: float) -> list[np.ndarray]:
    """Find points (3,) where the rays of two views meet and both masks have the object's size."""
    points = []
    for a, b in combinations(outlined, 2):
        if a.view == b.view:
            continue
        assert a.outline is not None and b.outline is not None
        point, _ = midpoints(a.outline.ray, b.outline.ray, a.outline.eye, b.outline.eye)
        if np.isfinite(point).all() and max(s.away(point, diameter) for s in (a, b)) < 1:
            points.append(point)
    return points


def _possible_candidates(view: View) -> list[MaskCandidate]:
    """Return the candidates of a view that are not the person.

    A candidate is the person if most of it lies on the person, and it is labelled as a person or
    has more than 0.3 of the person's area. Either alone is not enough: labels may be wrong, and an
    object that is held in front of the body lies in the person's mask.
    """
    possible = []
    for candidate in view.candidates:
        mask = candidate.mask
        if mask.area:
            person = view.person.window(mask.x0, mask.y0, *mask.mask.shape)
            on_person = (person & mask.mask).sum() > 0.6 * mask.area
            large = candidate.label == PERSON_LABEL or mask.area > 0.3 * view.person.area
            if not (on_person and large):
                possible.append(candidate)
    return possible


def _label_prior(label: str, labels: tuple[str, ...]) -> float:
    if label == "":
        return 0.8  # tuned, as below
    # detectors err, so the label of another class does not exclude a candidate
    return 1.0 if label in labels or (not labels and label != PERSON_LABEL) else 0.5


def _locate_by_outline(views: list[View], labels: tuple[str, ...]) -> list[LocatedCandidate]:
    """Locate the candidates of views without depth by their outlines."""
    result = []
    for number, view in enumerate(views):
        for candidate in _possible_candidates(view) if view.depth is None else ():
            label_prior = _label_prior(candidate.label, labels)
            located = LocatedCandidate(number, candidate, label_prior, np.zeros((0, 3)), None, view)
            if candidate.mask.area >= LOCATED_MIN_POINTS and located.outline is not None:
                result.append(located)
    return result


def _locate_by_depth(
    views: list[View], diameter: float, labels: tuple[str, ...]
) -> list[LocatedCandidate]:
    """Locate the candidates of views with depth by their points."""
    most_m = 0.75 * diameter  # from a candidate's centre to its points; tuned on the studio
    result = []
    for number, view in enumerate(views):
        geometry = view.geometry
        if view.depth is None or geometry.depth_lens is None:
            continue
        candidates = _possible_candidates(view)
        if not candidates:
            continue
        depth = view.depth[::2, ::2]
        rays = geometry.depth_lens.rays[::2, ::2]
        valid = (depth > 0) & np.isfinite(rays[..., 0])
        depth, rays = depth[valid], rays[valid]
        local = np.column_stack([rays * depth[:, None], depth])
        camera = geometry.camera
        assert camera.colour_from_depth is not None
        pixel = np.rint(geometry.lens.project(apply(camera.colour_from_depth, local))).astype(int)
        for candidate in candidates:
            inside = np.flatnonzero(candidate.mask.sample(pixel[:, 0], pixel[:, 1]))
            if len(inside) < LOCATED_MIN_POINTS:
                continue
            z = depth[inside]
            inside = inside[np.abs(z - np.median(z)) < most_m]
            if len(inside) < LOCATED_MIN_POINTS:
                continue  # two surfaces, with the middle between them
            points = apply(camera.master_from_depth, local[inside]).astype(np.float64)
            centre = np.median(points, axis=0)
            spread = np.percentile(np.linalg.norm(points - centre, axis=1), 90)
            if spread > most_m:
                continue
            label_prior = _label_prior(candidate.label, labels)
            result.append(LocatedCandidate(number, candidate, label_prior, points, centre, view))
    return result
