"""The person's mask and candidates of the object from depth images alone, one moment at a time.

Background subtraction: depth nearer than the static background is foreground. Foreground within a
body of average build around the triangulated keypoints is the person, the rest belongs to objects.
The objects' points of all views are clustered in space into connected components. Each component
is a candidate in every view that shows it. Four kinds of component are proposed, among which the
object's tracker chooses:

- moving: foreground away from the person, separated from the body at two distances (``NEAR_CUT``,
  ``FAR_CUT``), because the border between hand and object is uncertain;
- merged: neighbouring moving components, for an object whose middle the hand occludes;
- static: components of the background near the person's path, for an object at rest;
- partly moved: a static component with adjacent foreground. The object moved by less than its
  size, so that part of it still coincides with the background.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from intercap_core.artefacts import Artefact
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.person.segmentation.candidate_masks import (
    ColourCells,
    ImageCandidate,
    ViewSegments,
)
from intercap_core.person.segmentation.foreground import (
    DepthBackground,
    DepthView,
    in_box,
    sampled_images,
    without_free_space,
    without_person_traces,
)
from intercap_core.person.segmentation.person_volume import FAR, MovingPerson, distance_outside
from intercap_core.person.segmentation.static_objects import (
    CELL_M,
    box_diagonal,
    components,
    find_static_objects,
)

# The two distances from the person beyond which an object's points are collected, in margins: the
# uncertainty of the volume's surface, see :mod:`.person_volume`. Tuned on the studio.
NEAR_CUT, FAR_CUT = 1.0, 2.5
CLOTHING_MARGINS = 2.2  # a component that stays within this distance is clothing; tuned likewise
AROUND_PATH_M = 1.5  # largest distance of objects from the person's path; tuned on the studio
MAX_COMPONENTS = 6  # of one kind in one frame set; tuned on the studio
MIN_POINTS = 40  # least number of points of a component, over all views; tuned on the studio


@dataclass(frozen=True, eq=False)
class _ViewPoints:
    """Foreground and static objects of one view."""

    points: np.ndarray
    """(N, 3) metres, z up."""
    cells: ColourCells
    """Cells of the N points in the colour image."""
    outside: np.ndarray
    """(N,) distance from the surface of the person's volume, margins; negative inside. 20 (FAR) for
    points of static objects."""
    moving: np.ndarray
    """(N,) bool: foreground that is no surface of the static scene."""
    of_static: list[np.ndarray]
    """Indices of the visible points of each static object."""


@dataclass(frozen=True, eq=False)
class _Component:
    """A connected component of points of all views."""

    members: list[np.ndarray]
    """Indices of its points in each view."""
    score: float
    """Prior probability that it is a handled object; tuned on the studio, not calibrated."""
    extent_m: float
    """Diagonal of the bounding box, metres."""


class DepthSegmenter:
    """Segments the views of a recording with depth."""

    def __init__(
        self,
        frames: Frames,
        scene: Artefact,
        joints: np.ndarray,
        sigma: np.ndarray,
        cameras: list[int],
    ) -> None:
        """
        Args:
            frames, scene, joints, sigma: see :func:`.image_segmentation.segment_images`.
            cameras: indices of the cameras to segment.
        """
        self._frames = frames
        rig = Rig.from_artefact(scene)
        zup = scene["zup_from_master"]
        upright = bool(np.isfinite(zup).all())
        grounded = bool(scene.attributes["ground_found"]) and upright
        zup = zup if upright else np.eye(4)  # without an up direction, the master's frame is used
        bias = np.nan_to_num(scene["depth_bias"])
        self.cameras = [
            c
            for c in cameras
            if rig[c].depth is not None and f"cameras/{rig.names[c]}/background" in scene
        ]
        self._views = {
            c: DepthView(rig[c], float(bias[c]), zup @ rig[c].master_from_depth)
            for c in self.cameras
        }
        self._person = MovingPerson(joints, sigma, scene, zup)
        joints = self._person.joints
        everywhere = joints[np.isfinite(joints).all(-1)]
        self._low = everywhere.min(0) - AROUND_PATH_M
        above = 0.7 if upright else AROUND_PATH_M  # metres above the highest keypoint; tuned
        self._high = everywhere.max(0) + np.array([AROUND_PATH_M, AROUND_PATH_M, above])
        if grounded:
            # points lower than 25 mm may be floor: the systematic error of depth is up to 11 mm +
            # 0.1 % of depth (Azure Kinect DK data sheet)
            self._low[2] = 0.025
        views = [self._views[c] for c in self.cameras]
        backgrounds = [
            DepthBackground.of(
                scene[f"cameras/{rig.names[c]}/background"],
                sampled_images(frames, c),
                self._views[c].reach_mm(self._low, self._high),
            )
            for c in self.cameras
        ]
        backgrounds = without_free_space(views, backgrounds, self._low, self._high)
        some = range(0, len(joints), max(1, len(joints) // 12))  # about 12 moments
        bodies = [self._person.bones_at(t) for t in some]
        backgrounds = [
            without_person_traces(view, background, bodies)
            for view, background in zip(views, backgrounds, strict=True)
        ]
        self._background = dict(zip(self.cameras, backgrounds, strict=True))
        # Without a known floor there are no static objects (empty box): the floor would connect the
        # whole scene into one component.
        bottom = self._low if grounded else self._high
        self._static, self._surface = find_static_objects(
            views, backgrounds, bottom, self._high, everywhere
        )
        self._fixed = {c: self._static_points(number, c) for number, c in enumerate(self.cameras)}

    def _static_points(
        self, number: int, c: int
    ) -> list[tuple[np.ndarray, np.ndarray, ColourCells]]:
        """Flat depth pixels, points and colour cells of each static object in camera ``c``.

        ``number``: place of the camera among the segmented ones.
        """
        view, parts = self._views[c], []
        for item in self._static:
            pixels = item.pixels[number]
            points, local = view.points(self._background[c].depth, pixels)
            parts.append((pixels, points, ColourCells.of(local, view.camera)))
        return parts

    def segment(self, t: int, wanted: list[int]) -> dict[int, ViewSegments]:
        """Segment the views ``wanted`` of moment ``t``, except those without a depth image."""
        images = {
            c: image
            for c in wanted
            if c in self._views and (image := self._frames.depth(t, c)) is not None
        }
        if not images:
            return {}
        seen = [self._view_points(t, c, image) for c, image in images.items()]
        moving = _moving_components(seen)
        proposed = [
            *moving,
            *_merged_neighbours(seen, moving),
            *self._static_components(seen),
            *self._partly_moved(seen),
        ]
        return {
            c: _masks(view, number, proposed)
            for number, (c, view) in enumerate(zip(images, seen, strict=True))
        }

    def _view_points(self, t: int, c: int, image: np.ndarray) -> _ViewPoints:
        """Points of one depth image: its foreground, then the visible points of static objects."""
        view, background = self._views[c], self._background[c]
        index = background.before(image)
        points, local = view.points(image, index)
        inside = np.flatnonzero(in_box(points, self._low, self._high))
        points, local, index = (values.take(inside, 0) for values in (points, local, index))
        bones = self._person.bones(t, c)
        away = distance_outside(points, bones)
        # foreground only because this view's background is unknown there: if another view measures
        # a static surface in the same place, it is not moving
        rest = np.flatnonzero((away > NEAR_CUT) & (background.depth.ravel()[index] == 0))
        scene = rest[self._surface.holds(points[rest])]
        moving = np.ones(len(points), bool)
        moving[scene] = False
        shown = background.shows(image).ravel()
        parts, cells, of_static = [points], [ColourCells.of(local, view.camera)], []
        count = len(points)
        for item, (pixels, fixed, fixed_cells) in zip(self._static, self._fixed[c], strict=True):
            here = shown[pixels]
            parts.append(fixed[here])
            cells.append(fixed_cells[here])
            own = scene[item.cells.holds(points[scene])]
            of_static.append(np.concatenate([own, count + np.arange(here.sum())]))
            count += int(here.sum())
        more = count - len(points)
        return _ViewPoints(
            np.concatenate(parts),
            ColourCells.joined(cells),
            np.concatenate([away, np.full(more, FAR, np.float32)]),
            np.concatenate([moving, np.zeros(more, bool)]),
            of_static,
        )

    def _static_components(self, seen: list[_ViewPoints]) -> list[_Component]:
        """Components of the static objects.

        The scores 0.3 for objects on top of others and 0.2 for the rest are tuned on the studio.
        """
        return [
            _Component(
                [view.of_static[k] for view in seen], 0.3 if item.on_top else 0.2, item.extent_m
            )
            for k, item in enumerate(self._static)
        ]

    def _partly_moved(self, seen: list[_ViewPoints]) -> list[_Component]:
        """Components of static objects together with foreground that touches them.

        For an object that moved by less than its size, such as a pushed chair: part of it coincides
        with its place in the background, the rest is foreground.
        """
        chosen = []
        touched = False
        for view in seen:
            mask = view.moving & (view.outside > NEAR_CUT)
            moving = view.points[mask]
            for k, item in enumerate(self._static):
                if not item.carries:
                    mask[view.of_static[k]] = True
                    touched = touched or bool(item.cells.holds(moving).any())
            chosen.append(np.flatnonzero(mask))
        if not touched:
            return []
        result = []
        for members, points in _connected(seen, chosen):
            moves = [v.moving[m].sum() for v, m in zip(seen, members, strict=True)]
            if MIN_POINTS < sum(moves) < len(points) - MIN_POINTS:
                result.append(_Component(members, 0.4, box_diagonal(points)))
        return result[:MAX_COMPONENTS]


def _connected(
    seen: list[_ViewPoints], chosen: list[np.ndarray], cell_m: float = CELL_M
) -> Iterator[tuple[list[np.ndarray], np.ndarray]]:
    """Yield the connected components of the points with indices ``chosen`` in each view.

    Each result has the indices of its points in each view, and the points (n, 3) themselves.
    """
    ends = np.cumsum([0, *map(len, chosen)])
    points = np.concatenate([view.points[own] for view, own in zip(seen, chosen, strict=True)])
    for group in components(points, cell_m, MIN_POINTS):
        cuts = np.searchsorted(group, ends)
        members = [own[group[cuts[v] : cuts[v + 1]] - ends[v]] for v, own in enumerate(chosen)]
        yield members, points[group]


def _moving_components(seen: list[_ViewPoints]) -> list[_Component]:
    """Components of the foreground beyond :data:`NEAR_CUT`, then beyond :data:`FAR_CUT`.

    Clothing, and components that hardly differ between the two cuts, are left out. The score is
    1 - 0.5^(d / CLOTHING_MARGINS), d = 95th percentile of the distance from the person.
    """
    proposed: list[_Component] = []
    for cut in (NEAR_CUT, FAR_CUT):
        kept = 0
        chosen = [np.flatnonzero(view.moving & (view.outside > cut)) for view in seen]
        for members, points in _connected(seen, chosen):
            away = np.concatenate([v.outside[m] for v, m in zip(seen, members, strict=True)])
            reach = float(np.percentile(away, 95))
            if reach < CLOTHING_MARGINS or any(
                _is_same(members, other.members) for other in proposed
            ):
                continue
            proposed.append(
                _Component(members, 1 - 0.5 ** (reach / CLOTHING_MARGINS), box_diagonal(points))
            )
            kept += 1
            if kept == MAX_COMPONENTS:
                break
    return proposed


def _merged_neighbours(seen: list[_ViewPoints], proposed: list[_Component]) -> list[_Component]:
    """Unions of the ``proposed`` components that are less than a hand's breadth apart.

    For an object held in its middle, whose ends are separate components.
    """
    if len(proposed) < 2:
        return []
    chosen = [np.unique(np.concatenate([c.members[v] for c in proposed])) for v in range(len(seen))]
    result: list[_Component] = []
    for members, points in _connected(seen, chosen, 0.07):  # metres: a hand (anatomy)
        parts = components(points, CELL_M, MIN_POINTS)
        if len(parts) > 1 and len(result) < MAX_COMPONENTS:
            result.append(_Component(members, 0.5, box_diagonal(points)))
    return result


def _is_same(own: list[np.ndarray], other: list[np.ndarray]) -> bool:
    """Whether ``own``, a subset of ``other``, contains at least 90 % of its points."""
    size = sum(map(len, other))
    return sum(map(len, own)) > 0.9 * size and any(
        len(a) and len(b) and a[0] in b for a, b in zip(own, other, strict=True)
    )


def _masks(seen: _ViewPoints, number: int, proposed: list[_Component]) -> ViewSegments:
    """Masks of the person and of the components in one view.

    ``number``: place of the view in the members of the components. Components with fewer than 12
    points in the view have no mask.
    """
    visible = seen.cells.visible()
    # foreground up to 1.5 margins from the volume is the person; tuned on the studio
    person = seen.moving & (seen.outside < 1.5)
    candidates = []
    for index, component in enumerate(proposed):
        members = component.members[number]
        if len(members) < 12:
            continue
        chosen = np.zeros(len(person), bool)
        chosen[members] = True
        rle = visible.rle(chosen, person & ~chosen)
        if rle:
            candidates.append(ImageCandidate(rle, component.score, component.extent_m, index))
    return ViewSegments(visible.rle(person, ~person), candidates)
