"""Candidates of different views that may show one object: joined where they lie together in space.

Where depth measures a candidate its points say where it is; else the rays through the middles of
two views' masks do, where they meet and both masks have the size that the object would have there.
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
from intercap_core.object_track.constants import (
    CLOUD_MAX_SPREAD,
    CLOUD_PERCENTILE,
    CLOUD_STRIDE,
    GROUP_SLACK_M,
    MAX_GROUPS,
    NO_LABEL_PRIOR,
    ON_PERSON_SHARE,
    OTHER_LABEL_PRIOR,
    OUTLINE_MAX_WIDTH,
    OUTLINE_MIN_WIDTH,
    PERSON_SIZED_SHARE,
    RAY_MISS_SHARE,
    SAME_OBJECT_SHARE,
    SHARED_SIGHTINGS,
    SIGHTING_MIN_POINTS,
)
from intercap_core.object_track.outlines import Outline
from intercap_core.object_track.view import Candidate, View


@dataclass(frozen=True, eq=False)
class Sighting:
    """One candidate of one ``image``, that of view number ``view``, and, where that has depth, the
    measured ``points`` (N, 3), master frame, with their ``centre`` (3,). ``label_prior``: 1 where
    its label is one of the object's, less else."""

    view: int
    candidate: Candidate
    label_prior: float
    points: np.ndarray
    centre: np.ndarray | None
    image: View

    @cached_property
    def outline(self) -> Outline | None:
        """Its outline; None where all of it is cut off. Few searches ask for it."""
        return Outline.of(self.image, self.candidate)

    def away(self, point: np.ndarray, diameter: float) -> float:
        """Distance of the candidate from a place (3,), in units of the largest distance within one
        object."""
        if self.centre is not None:
            return float(np.linalg.norm(self.centre - point)) / (
                SAME_OBJECT_SHARE * diameter + GROUP_SLACK_M
            )
        outline = self.outline
        assert outline is not None
        towards = point - outline.eye
        along = float(towards @ outline.ray)
        if (
            not OUTLINE_MIN_WIDTH * diameter
            < outline.extent * along
            < OUTLINE_MAX_WIDTH * diameter + GROUP_SLACK_M
        ):
            return np.inf
        across = float(np.linalg.norm(towards - along * outline.ray))
        return across / (RAY_MISS_SHARE * diameter + GROUP_SLACK_M)


Group = list[Sighting]
"""At most one sighting a view."""


def find_groups(
    mesh: ObjectMesh,
    views: list[View],
    labels: tuple[str, ...],
    place_prior: Callable[[np.ndarray], float] | None = None,
    limit: int = MAX_GROUPS,
) -> list[Group]:
    """The first ``limit`` groups of candidates that may be the object, the most likely first.

    ``labels`` are the classes that the object may be given; ``place_prior`` says of a place (3,)
    how likely what is there is the object; where it cannot be there is no group.
    """
    measured = _measured(views, mesh.diameter, labels)
    outlined = _outlined(views, labels)
    places = [(s.centre, [s]) for s in measured if s.centre is not None]
    places += [(point, []) for point in _crossings(outlined, mesh.diameter)]
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
            value *= place_prior(centre_of(group))
        if value > 0:
            groups.append((value, group))
    groups.sort(key=lambda item: -item[0])
    return _different([group for _, group in groups], limit)


def centre_of(group: Group) -> np.ndarray:
    """Where the group is (3,): the mean of the views' mean points, or where their rays cross."""
    # the mean of the views' means: a near view holds more points but not more of the object
    means = [s.points.mean(0) for s in group if len(s.points)]
    if means:
        return np.mean(means, axis=0)
    eyes = np.array([s.outline.eye for s in group if s.outline])
    rays = np.array([s.outline.ray for s in group if s.outline])
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, eyes))


def _different(groups: list[Group], limit: int) -> list[Group]:
    """The first few groups that share at most half of their members with an earlier one."""
    kept: list[Group] = []
    for group in groups:
        if len(kept) == limit:
            break
        members = {(s.view, s.candidate.index) for s in group}
        known = [{(s.view, s.candidate.index) for s in other} for other in kept]
        if all(len(members & other) <= SHARED_SIGHTINGS * len(members) for other in known):
            kept.append(group)
    return kept


def _crossings(outlined: list[Sighting], diameter: float) -> list[np.ndarray]:
    """Points (3,) where the rays through two views' masks intersect and both masks have the size
    that the object would have there."""
    found = []
    for a, b in combinations(outlined, 2):
        if a.view == b.view:
            continue
        assert a.outline is not None and b.outline is not None
        point, _ = midpoints(a.outline.ray, b.outline.ray, a.outline.eye, b.outline.eye)
        if np.isfinite(point).all() and max(s.away(point, diameter) for s in (a, b)) < 1:
            found.append(point)
    return found


def _could_be(view: View) -> list[Candidate]:
    """All candidates that are not the person: labels err, so none is left out for its label
    alone."""
    found = []
    for candidate in view.candidates:
        mask = candidate.mask
        if mask.area:
            person = view.person.window(mask.x0, mask.y0, *mask.mask.shape)
            on_person = (person & mask.mask).sum() > ON_PERSON_SHARE * mask.area
            large = (
                candidate.label == PERSON_LABEL or mask.area > PERSON_SIZED_SHARE * view.person.area
            )
            if not (
                on_person and large
            ):  # an object held before the body may lie in the person's mask
                found.append(candidate)
    return found


def _label_prior(label: str, labels: tuple[str, ...]) -> float:
    if label == "":
        return NO_LABEL_PRIOR
    return 1.0 if label in labels or (not labels and label != PERSON_LABEL) else OTHER_LABEL_PRIOR


def _outlined(views: list[View], labels: tuple[str, ...]) -> list[Sighting]:
    """The outline of every candidate in views without depth that could be the object."""
    found = []
    for number, view in enumerate(views):
        for candidate in _could_be(view) if view.depth is None else ():
            label_prior = _label_prior(candidate.label, labels)
            one = Sighting(number, candidate, label_prior, np.zeros((0, 3)), None, view)
            if candidate.mask.area >= SIGHTING_MIN_POINTS and one.outline is not None:
                found.append(one)
    return found


def _measured(views: list[View], diameter: float, labels: tuple[str, ...]) -> list[Sighting]:
    """The measured points of every candidate that could be the object."""
    found = []
    for number, view in enumerate(views):
        geometry = view.geometry
        if view.depth is None or geometry.depth_lens is None:
            continue
        candidates = _could_be(view)
        if not candidates:
            continue
        depth = view.depth[::CLOUD_STRIDE, ::CLOUD_STRIDE]
        rays = geometry.depth_lens.rays[::CLOUD_STRIDE, ::CLOUD_STRIDE]
        valid = (depth > 0) & np.isfinite(rays[..., 0])
        depth, rays = depth[valid], rays[valid]
        local = np.column_stack([rays * depth[:, None], depth])
        camera = geometry.camera
        assert camera.colour_from_depth is not None
        pixel = np.rint(geometry.lens.project(apply(camera.colour_from_depth, local))).astype(int)
        for candidate in candidates:
            inside = np.flatnonzero(candidate.mask.sample(pixel[:, 0], pixel[:, 1]))
            if len(inside) < SIGHTING_MIN_POINTS:
                continue
            z = depth[inside]
            inside = inside[np.abs(z - np.median(z)) < CLOUD_MAX_SPREAD * diameter]
            if len(inside) < SIGHTING_MIN_POINTS:
                continue  # two surfaces, with the middle between them
            points = apply(camera.master_from_depth, local[inside]).astype(np.float64)
            centre = np.median(points, axis=0)
            spread = np.percentile(np.linalg.norm(points - centre, axis=1), CLOUD_PERCENTILE)
            if spread > CLOUD_MAX_SPREAD * diameter:
                continue
            label_prior = _label_prior(candidate.label, labels)
            found.append(Sighting(number, candidate, label_prior, points, centre, view))
    return found
