"""The person's mask and candidates of the object from depth images alone, one moment at a time.

What stands before the static scene is the person, where it lies inside a body of usual build around
the triangulated keypoints, and else a thing. Things of all views are joined in space, and each
component is a candidate in every view that shows it. How close to the person a thing begins is
uncertain: it is tried at two distances, the track decides.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from intercap_core.artefacts import Artefact
from intercap_core.camera.rig import Rig
from intercap_core.camera.transforms import apply
from intercap_core.capture.frames import Frames
from intercap_core.segmentation.constants import (
    ABOVE_HEAD_M,
    AROUND_PATH_M,
    CELL_M,
    CLOTHING_MARGINS,
    FAR,
    FAR_CUT,
    FLOOR_M,
    MAX_COMPONENTS,
    MAX_HAND_SPEED_M_S,
    MAX_KEYPOINT_GAP_S,
    MIN_POINTS,
    MIN_VIEW_POINTS,
    NEAR_CUT,
    NEARBY_CELL_M,
    ON_TOP_SCORE,
    PARTLY_MOVED_SCORE,
    PERSON_MARGINS,
    PERSON_SAMPLES,
    SAME_SHARE,
    STATIC_SCORE,
    TWO_ENDS_SCORE,
)
from intercap_core.segmentation.depth_masks import Cells, Projected
from intercap_core.segmentation.foreground import DepthBackground, DepthView, sampled_images
from intercap_core.segmentation.image_segments import ImageCandidate, ViewSegments
from intercap_core.segmentation.person_volume import bones_of, outside
from intercap_core.segmentation.see_through import see_through, without_person
from intercap_core.segmentation.static_things import extent, find_static_things
from intercap_core.segmentation.voxels import components
from intercap_core.solve.velocity import limited_velocity


@dataclass(frozen=True, eq=False)
class _Seen:
    """Points (N, 3), z up, that one view sees of person and things, and their colour ``cells``.

    ``outside`` (N,) margins outside the person; ``moving`` (N,) bool: before the static scene;
    ``of_thing``: indices of the points of every static thing.
    """

    points: np.ndarray
    cells: Cells
    outside: np.ndarray
    moving: np.ndarray
    of_thing: list[np.ndarray]


@dataclass(frozen=True, eq=False)
class _Piece:
    """A component: indices of its points in each view, how likely it is a thing, its size."""

    members: list[np.ndarray]
    score: float
    extent_m: float


class DepthSegmenter:
    """Segments the views of a recording that have depth.

    ``frames`` read by the moment that their images show, ``scene`` the scene artefact, ``joints``
    (T, 135, 3) the subject's keypoints in the master frame, ``cameras`` which of them to look at.
    """

    def __init__(
        self, frames: Frames, scene: Artefact, joints: np.ndarray, cameras: list[int]
    ) -> None:
        self._frames = frames
        rig = Rig.from_artefact(scene)
        zup = scene["zup_from_master"]
        upright = bool(np.isfinite(zup).all())
        grounded = bool(scene.attributes["ground_found"]) and upright
        zup = zup if upright else np.eye(4)
        times = scene["times"]
        bias, self._late = np.nan_to_num(scene["depth_bias"]), scene["time_offset"]
        self.cameras = [
            c
            for c in cameras
            if rig[c].depth is not None and f"cameras/{rig.names[c]}/background" in scene
        ]
        self._views = {
            c: DepthView(rig[c], float(bias[c]), zup @ rig[c].master_from_depth)
            for c in self.cameras
        }
        joints = apply(zup, joints.reshape(-1, 3)).reshape(joints.shape)
        self._joints = fill_short_gaps(joints, times, max_gap_s=MAX_KEYPOINT_GAP_S)
        self._velocity = np.nan_to_num(
            limited_velocity(self._joints, times, max_speed=MAX_HAND_SPEED_M_S)
        )
        everywhere = self._joints[np.isfinite(self._joints).all(-1)]
        self._low = everywhere.min(0) - AROUND_PATH_M
        above = ABOVE_HEAD_M if upright else AROUND_PATH_M
        self._high = everywhere.max(0) + np.array([AROUND_PATH_M, AROUND_PATH_M, above])
        if grounded:
            self._low[2] = FLOOR_M
        views = [self._views[c] for c in self.cameras]
        backgrounds = [
            DepthBackground.of(
                scene[f"cameras/{rig.names[c]}/background"],
                sampled_images(frames, c),
                self._views[c].reach_mm(self._low, self._high),
            )
            for c in self.cameras
        ]
        backgrounds = see_through(views, backgrounds, self._low, self._high)
        some = self._joints[:: max(1, len(times) // PERSON_SAMPLES)]
        bodies = [bones_of(joints) for joints in some]
        backgrounds = [
            without_person(view, background, bodies)
            for view, background in zip(views, backgrounds, strict=True)
        ]
        self._background = dict(zip(self.cameras, backgrounds, strict=True))
        # without a floor to take away, all of the scene is one thing
        bottom = self._low if grounded else self._high
        self._static = find_static_things(views, backgrounds, bottom, self._high, everywhere)
        self._fixed = {c: self._static_points(number, c) for number, c in enumerate(self.cameras)}

    def _static_points(self, number: int, c: int) -> list[tuple[np.ndarray, np.ndarray, Cells]]:
        """Flat pixels, points and cells of every static thing in one camera."""
        view, found = self._views[c], []
        for thing in self._static.things:
            pixels = thing.pixels[number]
            points, local = view.points(self._background[c].depth, pixels)
            found.append((pixels, points, Cells.of(local, view.camera)))
        return found

    def segment(self, t: int, wanted: list[int]) -> dict[int, ViewSegments]:
        """The views ``wanted`` of moment ``t``, those that have no depth image left out."""
        images = {
            c: image
            for c in wanted
            if c in self._views and (image := self._frames.depth(t, c)) is not None
        }
        if not images:
            return {}
        seen = [self._look(t, c, image) for c, image in images.items()]
        moving = _moving_pieces(seen)
        pieces = [
            *moving,
            *_spread_pieces(seen, moving),
            *self._static_pieces(seen),
            *self._joint_pieces(seen),
        ]
        return {
            c: _masks(view, [(piece, piece.members[number]) for piece in pieces])
            for number, (c, view) in enumerate(zip(images, seen, strict=True))
        }

    def _look(self, t: int, c: int, image: np.ndarray) -> _Seen:
        view, background = self._views[c], self._background[c]
        index = background.before(image)
        points, local = view.points(image, index)
        inside = ((points > self._low) & (points < self._high)).all(1)
        points, local, index = points[inside], local[inside], index[inside]
        bones = bones_of(self._joints[t] + self._late[c] * self._velocity[t])
        away = outside(points, bones)
        # what this view does not know as background, another one may
        rest = np.flatnonzero((away > NEAR_CUT) & (background.depth.ravel()[index] == 0))
        scene = rest[self._static.surface.holds(points[rest])]
        moving = np.ones(len(points), bool)
        moving[scene] = False
        shown = background.shows(image).ravel()
        parts, cells, of_thing = [points], [Cells.of(local, view.camera)], []
        count = len(points)
        for thing, (pixels, fixed, fixed_cells) in zip(
            self._static.things, self._fixed[c], strict=True
        ):
            here = shown[pixels]
            parts.append(fixed[here])
            cells.append(fixed_cells[here])
            own = scene[thing.cells.holds(points[scene])]
            of_thing.append(np.concatenate([own, count + np.arange(here.sum())]))
            count += int(here.sum())
        more = count - len(points)
        return _Seen(
            np.concatenate(parts),
            Cells.joined(cells),
            np.concatenate([away, np.full(more, FAR, np.float32)]),
            np.concatenate([moving, np.zeros(more, bool)]),
            of_thing,
        )

    def _static_pieces(self, seen: list[_Seen]) -> list[_Piece]:
        return [
            _Piece(
                [view.of_thing[k] for view in seen],
                ON_TOP_SCORE if thing.on_top else STATIC_SCORE,
                thing.extent_m,
            )
            for k, thing in enumerate(self._static.things)
        ]

    def _joint_pieces(self, seen: list[_Seen]) -> list[_Piece]:
        """Static things together with what moves beside them: a chair that was pushed a little."""
        chosen = []
        touched = False
        for view in seen:
            moving = np.flatnonzero(view.moving & (view.outside > NEAR_CUT))
            parts = [moving]
            for k, thing in enumerate(self._static.things):
                if not thing.carries:
                    parts.append(view.of_thing[k])
                    touched |= bool(thing.cells.holds(view.points[moving]).any())
            chosen.append(np.unique(np.concatenate(parts)))
        if not touched:
            return []
        found = []
        for members, points in _grouped(seen, chosen):
            moves = [v.moving[m].sum() for v, m in zip(seen, members, strict=True)]
            if MIN_POINTS < sum(moves) < len(points) - MIN_POINTS:
                found.append(_Piece(members, PARTLY_MOVED_SCORE, extent(points)))
        return found[:MAX_COMPONENTS]


def _grouped(
    seen: list[_Seen], chosen: list[np.ndarray], cell_m: float = CELL_M
) -> Iterator[tuple[list[np.ndarray], np.ndarray]]:
    """Components of the points ``chosen`` in each view: their indices by view, and points."""
    ends = np.cumsum([0, *map(len, chosen)])
    points = np.concatenate([view.points[own] for view, own in zip(seen, chosen, strict=True)])
    for group in components(points, cell_m, MIN_POINTS):
        cuts = np.searchsorted(group, ends)
        members = [own[group[cuts[v] : cuts[v + 1]] - ends[v]] for v, own in enumerate(chosen)]
        yield members, points[group]


def _moving_pieces(seen: list[_Seen]) -> list[_Piece]:
    """Components of what moves and is not the person, taken off the person at either distance."""
    pieces: list[_Piece] = []
    for cut in (NEAR_CUT, FAR_CUT):
        kept = 0
        chosen = [np.flatnonzero(view.moving & (view.outside > cut)) for view in seen]
        for members, points in _grouped(seen, chosen):
            away = np.concatenate([v.outside[m] for v, m in zip(seen, members, strict=True)])
            reach = float(np.percentile(away, 95))
            if reach < CLOTHING_MARGINS or any(_same(members, other.members) for other in pieces):
                continue
            pieces.append(_Piece(members, 1 - 0.5 ** (reach / CLOTHING_MARGINS), extent(points)))
            kept += 1
            if kept == MAX_COMPONENTS:
                break
    return pieces


def _spread_pieces(seen: list[_Seen], pieces: list[_Piece]) -> list[_Piece]:
    """``pieces`` that lie close together: both ends of what a hand holds in its middle."""
    if len(pieces) < 2:
        return []
    chosen = [
        np.unique(np.concatenate([piece.members[v] for piece in pieces])) for v in range(len(seen))
    ]
    found: list[_Piece] = []
    for members, points in _grouped(seen, chosen, NEARBY_CELL_M):
        parts = components(points, CELL_M, MIN_POINTS)
        if len(parts) > 1 and len(found) < MAX_COMPONENTS:
            found.append(_Piece(members, TWO_ENDS_SCORE, extent(points)))
    return found


def _same(own: list[np.ndarray], other: list[np.ndarray]) -> bool:
    """Whether a component holds nearly all points of another one that it is part of."""
    size = sum(map(len, other))
    return sum(map(len, own)) > SAME_SHARE * size and any(
        len(a) and len(b) and a[0] in b for a, b in zip(own, other, strict=True)
    )


def _masks(seen: _Seen, pieces: list[tuple[_Piece, np.ndarray]]) -> ViewSegments:
    projected = Projected.of(seen.cells)
    person = seen.moving & (seen.outside < PERSON_MARGINS)
    things = ~person
    candidates = []
    for component, (piece, members) in enumerate(pieces):
        if len(members) < MIN_VIEW_POINTS:
            continue
        chosen = np.zeros(len(person), bool)
        chosen[members] = True
        rle = projected.rle(chosen, person & ~chosen)
        if rle:
            candidates.append(ImageCandidate(rle, piece.score, piece.extent_m, component))
    return ViewSegments(projected.rle(person, things), candidates)


def fill_short_gaps(joints: np.ndarray, times: np.ndarray, *, max_gap_s: float) -> np.ndarray:
    """Keypoints (T, K, 3), NaN = not known, with short gaps filled by linear interpolation.

    A gap is filled up to ``max_gap_s`` from its nearest known time of ``times`` (T,) seconds; at
    the beginning and the end the nearest known place is held.
    """
    result = joints.copy()
    for k in range(joints.shape[1]):
        known = np.flatnonzero(np.isfinite(joints[:, k]).all(1))
        if not len(known):
            continue
        for t in np.flatnonzero(~np.isfinite(joints[:, k]).all(1)):
            after = int(np.searchsorted(known, t))
            around = known[max(after - 1, 0) : after + 1]
            if np.abs(times[around] - times[t]).min() > max_gap_s:
                continue
            result[t, k] = [
                np.interp(times[t], times[around], joints[around, k, i]) for i in range(3)
            ]
    return result
