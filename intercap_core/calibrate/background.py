"""Camera poses by the static background that depth cameras share.

All cameras stand over one floor, so two cameras differ by an angle about the vertical and a shift
along the floor. :func:`_search` scores all angles and shifts of a pair on a grid: a cell that both
measure as occupied counts for a pose, a cell that one measures as occupied and the other sees
through counts against it. The best poses are refined by point-to-plane ICP and judged on the depth
images (:func:`_judge`).

Rooms have parallel walls and equal chairs, so the best pose of a pair may be wrong. A camera is
placed only if two other cameras agree on its pose and no other pose is nearly as likely. A room may
look the same after half a turn, so a person's joints must confirm the result
(:func:`confirm_by_joints`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations

import numpy as np
from scipy import fft
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from intercap_core.calibrate.adjust import JointTerm
from intercap_core.calibrate.evidence import JOINTS, Views
from intercap_core.calibrate.placement import MAX_ERROR_PX, MIN_POINTS, reference_points
from intercap_core.errors import UserError
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert, rigid, rotation_log
from intercap_core.scene.background import Background
from intercap_core.scene.ground import fit_ground
from intercap_core.scene.registration import balance_directions
from intercap_core.scene.surfaces import surface_from_depth
from intercap_core.scene.up import rough_up

# Grid of the search. On the hardest eight pairs of config/rig's suitcase_carry_s05 the true pose
# has the highest score; with cells widened by 10 cm it has rank 0 to 6, with a weight of free cells
# of 0.5 it is beaten by poses without overlap.
CELL_M, LAYER_M = 0.1, 0.25  # width and height of a cell
SIDE = 160  # cells along either side
HEIGHTS_M = (0.15, 2.4)  # above the floor; lower cells are alike everywhere
ANGLES = 180  # 2 degrees: one cell at 2.9 m
FREE_MARGIN_M = 0.4  # cells this close to a surface are not free: the shift is off by half a cell
FREE_WEIGHT = 0.1
CANDIDATES = 8  # poses of a pair that are refined
PATCH_M = 0.25  # side of a cube whose points count as one piece of evidence
MIN_PATCHES = 8  # that agree; fewer are one piece of furniture
# At true poses of config/rig, 0 to 5 patches are against and 4 to 39 agree; at wrong ones with 8 or
# more that agree, mostly half are against.
AGAINST_WEIGHT, MAX_AGAINST = 4.0, 0.2
# Two cameras that would look the same way from the same place: equal walls behind them agree best
# there, and the cameras of a rig look from different sides.
NEAR_M, NEAR_RAD = 1.0, np.radians(20.0)
MIN_CAMERAS = 3  # of which two agree on the pose of the third
# Largest score of another pose over that of the best one
MAX_RIVAL = 0.7
SAME_M, SAME_RAD = 0.15, np.radians(3.0)  # two poses after ICP that are one
MAX_DEPTH_M = 6.0
POINT_CELL_M = 0.06
# Reach of the ICP: from the error of the grid to the depth error at 4 m
ICP_REACH_M, ICP_STEPS, ICP_POINTS = (0.2, 0.1, 0.06), 8, 4000
NORMAL_M = 0.3  # distance that counts as much as normals 60 degrees apart

Pose = np.ndarray
"""(4, 4) transform between two cameras, metres."""


@dataclass(frozen=True, eq=False)
class _LevelView:
    """Background of one camera in its level frame: z up, origin on the floor under the camera."""

    level_from_colour: Pose
    level_from_depth: Pose
    nearest: np.ndarray
    """(H, W) uint16 mm, smallest depth of a pixel and its neighbours; 0 = unknown."""
    lens: Intrinsics
    points: np.ndarray
    """(N, 3) surface points, metres."""
    normals: np.ndarray
    """(N, 3) unit."""
    free: np.ndarray
    """(M, 3) points on the rays in front of the surfaces, metres."""

    @cached_property
    def tree(self) -> cKDTree:
        """Search among points and normals: neighbours face the same way."""
        return cKDTree(np.hstack([self.points, NORMAL_M * self.normals]))

    @cached_property
    def structure(self) -> np.ndarray:
        """Points (K, 3) above the floor."""
        return self.points[self.points[:, 2] > HEIGHTS_M[0]]

    @cached_property
    def middle(self) -> np.ndarray:
        """Middle (3,) of the view on the floor."""
        return np.r_[self.free[:, :2].mean(0), 0.0]


def _level(rig: Rig, c: int, background: Background, gravity: np.ndarray) -> _LevelView | None:
    """Level the background of camera ``c``; None if it shows no floor.

    ``gravity``: (C, 3) down in each colour camera; NaN = not measured.
    """
    lens, own = rig[c].depth, Rig((rig[c].moved(np.eye(4)),))
    depth = np.where(background.static, background.depth, np.uint16(0))
    assert lens is not None
    surface = surface_from_depth(depth, lens, cell_m=POINT_CELL_M, max_depth_m=MAX_DEPTH_M)
    to_colour = own[0].master_from_depth
    points, normals = apply(to_colour, surface.points), surface.normals @ to_colour[:3, :3].T
    floor = fit_ground(
        points, normals, own, rough_up(own, gravity[[c]]), tolerance_m=0.03, cell_m=POINT_CELL_M
    )
    if not floor.found:
        return None
    across = np.cross(floor.normal, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    turn = np.stack([across, np.cross(floor.normal, across), floor.normal])
    level = rigid(turn, np.array([0, 0, -(floor.point @ floor.normal)]))

    thin = np.s_[::8, ::8]  # a ray every 10 cm at 6 m
    z = depth[thin] * 1e-3
    rays = np.dstack([lens.rays[thin], np.ones(z.shape)])
    seen = (z > 0) & np.isfinite(rays[..., 0])
    depths = np.arange(0.3, MAX_DEPTH_M, CELL_M)[:, None]
    before = depths < z[seen] - FREE_MARGIN_M
    free = apply(level @ to_colour, (rays[seen] * depths[..., None])[before])
    return _LevelView(
        level,
        level @ to_colour,
        minimum_filter(depth, 3),
        lens,
        apply(level, points),
        normals @ turn.T,
        free,
    )


def _grid(points: np.ndarray) -> np.ndarray:
    """Occupancy (L, SIDE, SIDE), 0 or 1, of points (N, 3) about the origin."""
    layers = round((HEIGHTS_M[1] - HEIGHTS_M[0]) / LAYER_M)
    low = [-CELL_M * SIDE / 2, -CELL_M * SIDE / 2, HEIGHTS_M[0]]
    cell = np.floor((points - low) / [CELL_M, CELL_M, LAYER_M]).astype(int)
    x, y, z = cell[((cell >= 0) & (cell < [SIDE, SIDE, layers])).all(1)].T
    result = np.zeros((layers, SIDE, SIDE), np.float32)
    result[z, x, y] = 1
    return result


def _search(firsts: Sequence[_LevelView], second: _LevelView) -> list[list[Pose]]:
    """Best poses of the second level frame in each of the first ones.

    The score of a shift is a correlation of the grids, computed for all shifts at once by FFT.
    """
    spectra = []
    for first in firsts:
        grid = _grid(first.structure - first.middle)
        free = _grid(first.free - first.middle) * (grid == 0)
        spectra.append((fft.rfft2(grid), fft.rfft2(FREE_WEIGHT * free)))
    found: list[list[tuple[float, Pose]]] = [[] for _ in firsts]
    for angle in np.arange(ANGLES) * 2 * np.pi / ANGLES:
        turn = Rotation.from_rotvec([0, 0, angle]).as_matrix()
        grid = _grid((second.structure - second.middle) @ turn.T)
        free = _grid((second.free - second.middle) @ turn.T) * (grid == 0)
        own = fft.rfft2(grid).conj()
        difference = own - fft.rfft2(FREE_WEIGHT * free).conj()
        for first, (occupied, clear), options in zip(firsts, spectra, found, strict=True):
            spectrum = np.einsum("lij,lij->ij", occupied, difference)
            spectrum -= np.einsum("lij,lij->ij", clear, own)
            score = fft.irfft2(spectrum, (SIDE, SIDE))
            for best in np.argpartition(score, -3, axis=None)[-3:]:
                cell = np.array(np.unravel_index(best, score.shape))
                cell = (cell + SIDE // 2) % SIDE - SIDE // 2
                shift = first.middle + np.r_[cell * CELL_M, 0] - turn @ second.middle
                options.append((float(score.flat[best]), rigid(turn, shift)))
    return [_distinct(options, first, second) for first, options in zip(firsts, found, strict=True)]


def _distinct(
    options: list[tuple[float, Pose]], first: _LevelView, second: _LevelView
) -> list[Pose]:
    """The best :data:`CANDIDATES` poses that are not the neighbour of a better one."""
    result: list[Pose] = []
    for _, pose in sorted(options, key=lambda option: -option[0]):
        apart = (_difference(pose, other, second.middle) for other in result)
        if not _is_near(first, second, pose) and all(
            m > 5 * CELL_M or rad > np.radians(10) for m, rad in apart
        ):
            result.append(pose)
        if len(result) == CANDIDATES:
            break
    return result


def _is_near(first: _LevelView, second: _LevelView, pose: Pose) -> bool:
    """Whether two cameras would look the same way from nearly the same place."""
    relative = invert(first.level_from_colour) @ pose @ second.level_from_colour
    apart, angle = _difference(relative, np.eye(4), np.zeros(3))
    return apart < NEAR_M and angle < NEAR_RAD


def _difference(first: Pose, second: Pose, at: np.ndarray) -> tuple[float, float]:
    """Distance of a point (3,) under two poses, metres, and the angle between them, radians."""
    apart = float(np.linalg.norm(apply(first, at) - apply(second, at)))
    return apart, float(np.linalg.norm(rotation_log(first[:3, :3].T @ second[:3, :3])))


def _refine(first: _LevelView, second: _LevelView, pose: Pose, reach_m: Sequence[float]) -> Pose:
    """Point-to-plane ICP of the second background on the first; both stay level.

    Cameras on opposite sides of an object see its opposite faces. Points are neighbours only if
    their normals are alike, so these faces are not pulled onto each other.
    """
    thin = slice(None, None, max(1, len(second.points) // ICP_POINTS))
    for reach in np.repeat(reach_m, ICP_STEPS):
        points = apply(pose, second.points[thin])
        normals = second.normals[thin] @ pose[:3, :3].T
        away, place = first.tree.query(
            np.hstack([points, NORMAL_M * normals]), distance_upper_bound=reach
        )
        near = np.isfinite(away)
        points, goals, normals = points[near], first.points[place[near]], first.normals[place[near]]
        residual = ((points - goals) * normals).sum(1)
        weight = np.maximum(0.0, 1 - (residual / reach) ** 2) ** 2  # Tukey's biweight
        weight = balance_directions(weight, normals)
        about = np.cross(points - second.middle, normals)[:, 2]
        jacobian = np.column_stack([about, normals[:, :2]])
        matrix = (jacobian.T * weight) @ jacobian + 1e-3 * np.eye(3)
        angle, *shift = -np.linalg.solve(matrix, jacobian.T @ (weight * residual))
        turn = Rotation.from_rotvec([0, 0, angle]).as_matrix()
        pose = rigid(turn, second.middle + np.r_[shift, 0] - turn @ second.middle) @ pose
    return pose


def _judge(first: _LevelView, second: _LevelView, pose: Pose) -> float:
    """Return the score of a pose in patches above the floor; 0 = the pose is rejected.

    A patch supports the pose if both cameras measure a surface there that faces the same way. It
    contradicts the pose if one camera measures a surface there and the other sees through it. Only
    static surfaces count: people and carried objects move between the images of the two cameras.
    """
    points = apply(pose, second.points)
    both = np.hstack([points, NORMAL_M * second.normals @ pose[:3, :3].T])
    near = np.isfinite(first.tree.query(both, distance_upper_bound=1.5 * ICP_REACH_M[-1])[0])
    agree = _count_patches(points[near & (points[:, 2] > HEIGHTS_M[0])])
    against = sum(
        _count_patches(moved[_is_in_front(moved, by)])
        for moved, by in (
            (apply(pose, second.structure), first),
            (apply(invert(pose), first.structure), second),
        )
    )
    if agree < MIN_PATCHES or against > MAX_AGAINST * agree:
        return 0.0
    return agree - AGAINST_WEIGHT * against


def _count_patches(points: np.ndarray) -> int:
    """Number of cubes of side :data:`PATCH_M` that hold points (N, 3), metres."""
    return len(np.unique(np.floor(points / PATCH_M).astype(int), axis=0))


def _is_in_front(points: np.ndarray, view: _LevelView) -> np.ndarray:
    """Mask (N,) of points, level frame of the view, that lie clearly before what it measures."""
    in_depth = apply(invert(view.level_from_depth), points)
    pixels = view.lens.project(in_depth)
    height, width = view.nearest.shape
    inside = (in_depth[:, 2] > 0.3) & np.isfinite(pixels).all(1)
    column, row = np.rint(np.where(inside[:, None], pixels, -1)).astype(int).T
    inside &= (row >= 0) & (row < height) & (column >= 0) & (column < width)
    measured = np.where(inside, view.nearest[row * inside, column * inside], 0) * 1e-3
    # twice 5 cm + 1 %: the error of ICP at the image's edge, and of depth
    return inside & (measured - in_depth[:, 2] > 0.1 + 0.02 * measured)


@dataclass(frozen=True, eq=False)
class _Option:
    """A pose of a camera in the rig."""

    camera: int
    pose: Pose
    """(4, 4) master_from_colour."""
    witnesses: frozenset[int]
    """Placed cameras whose background agrees with it."""
    score: float
    """Patches that agree, less those against it, over all witnesses."""


class _Rooms:
    """Level views of all cameras, and the relative poses that their backgrounds allow."""

    def __init__(self, views: Mapping[int, _LevelView], placed: Sequence[int]) -> None:
        """Search the poses of all pairs but those of two ``placed`` cameras."""
        self.views = views
        self.poses: dict[tuple[int, int], list[Pose]] = {}
        """first_from_second of the colour cameras, for both orders of each pair."""
        for b, second in views.items():
            firsts = [a for a in views if a < b and not (a in placed and b in placed)]
            for a, options in zip(firsts, _search([views[a] for a in firsts], second), strict=True):
                to_a, from_b = invert(views[a].level_from_colour), second.level_from_colour
                found = [to_a @ pose @ from_b for pose in options]
                found = [
                    pose for guess in found if (pose := self._confirm(a, b, guess)[0]) is not None
                ]
                self.poses[a, b], self.poses[b, a] = found, [invert(pose) for pose in found]

    def _confirm(
        self, a: int, b: int, pose: Pose, reach_m: Sequence[float] = ICP_REACH_M
    ) -> tuple[Pose | None, float]:
        """The refined pose a_from_b of the colour cameras and its score; None = it is wrong."""
        first, second = self.views[a], self.views[b]
        level = first.level_from_colour @ pose @ invert(second.level_from_colour)
        level = _refine(first, second, level, reach_m)
        score = _judge(first, second, level)
        if score <= 0:
            return None, 0.0
        return invert(first.level_from_colour) @ level @ second.level_from_colour, score

    def best(self, camera: int, placed: Mapping[int, Pose]) -> _Option | None:
        """The pose of a camera that two placed ones or more confirm; None = not determined."""
        guesses = [at @ pose for by, at in placed.items() for pose in self.poses[by, camera]]
        options: list[_Option] = []
        for guess in guesses:
            if any(self.is_same(camera, guess, option.pose) for option in options):
                continue
            scores = {}
            for by, at in placed.items():
                pose, score = self._confirm(by, camera, invert(at) @ guess, ICP_REACH_M[1:])
                if pose is not None and self.is_same(camera, at @ pose, guess):
                    scores[by] = score
            options.append(_Option(camera, guess, frozenset(scores), sum(scores.values())))
        best = max(options, key=lambda option: option.score, default=None)
        if best is None or len(best.witnesses) < 2:
            return None
        rival = max((o.score for o in options if o is not best), default=0.0)
        return best if rival <= MAX_RIVAL * best.score else None

    def is_same(self, camera: int, pose: Pose, other: Pose) -> bool:
        """Whether two poses of a camera differ by no more than the error of the ICP."""
        view = self.views[camera]
        at = apply(invert(view.level_from_colour), view.middle)
        apart, angle = _difference(pose, other, at)
        return apart < SAME_M and angle < SAME_RAD

    def first_three(self) -> dict[int, Pose]:
        """Poses of the three cameras that agree best; empty if no three agree on one pose each."""
        best: dict[int, Pose] = {}
        most = 0.0
        for a, b, c in permutations(sorted(self.views), 3):
            closed = []
            for b_in_a in self.poses[a, b] if a < b else ():
                placed = {a: np.eye(4), b: b_in_a}
                option = self.best(c, placed)
                if option is not None:
                    closed.append((option.score, placed | {c: option.pose}))
            score, poses = max(closed, key=lambda option: option[0], default=(0.0, {}))
            rivals = (s for s, other in closed if not self.is_same(b, other[b], poses[b]))
            if score > most and max(rivals, default=0.0) <= MAX_RIVAL * score:
                best, most = poses, score
        return best


def place_by_background(
    rig: Rig, backgrounds: Sequence[Background | None], gravity: np.ndarray, placed: Sequence[int]
) -> tuple[Rig, dict[int, frozenset[int]]]:
    """Place the cameras that are not ``placed`` by the background that they share with others.

    A camera is placed if two placed cameras agree on its pose. With fewer than two placed cameras,
    three are placed first that agree.

    Args:
        backgrounds: of the C cameras; None = without depth.
        gravity: (C, 3) down in each colour camera; NaN = not measured.

    Returns:
        The rig, and for each camera that was placed the cameras that agree on its pose.
    """
    views = {}
    for c, background in enumerate(backgrounds):
        view = None if background is None else _level(rig, c, background, gravity)
        if view is not None and _count_patches(view.structure) >= MIN_PATCHES:
            views[c] = view
    if len(views) < MIN_CAMERAS:
        return rig, {}
    rooms = _Rooms(views, placed)
    poses = {c: rig[c].master_from_colour for c in placed if c in views}
    witnesses: dict[int, frozenset[int]] = {}
    if len(placed) < 2:
        poses = rooms.first_three()
        witnesses = {c: frozenset(poses) - {c} for c in poses}
    while True:
        options = [o for c in views if c not in poses and (o := rooms.best(c, poses))]
        if not options:
            break
        best = max(options, key=lambda option: option.score)
        poses[best.camera], witnesses[best.camera] = best.pose, best.witnesses
    all_poses = rig.master_from_colour.copy()
    for c, pose in poses.items():
        all_poses[c] = pose
    return rig.moved(all_poses), witnesses


def confirm_by_joints(rig: Rig, views: Views, by_background: Mapping[int, frozenset[int]]) -> None:
    """Raise UserError if a person's joints do not confirm cameras placed by their background."""
    everyone = list(range(len(rig)))
    joints = JointTerm(rig, views, reference_points(rig, views, everyone, None)[:, JOINTS])
    sizes = joints.sizes_px(rig.master_from_colour)
    for c, others in sorted(by_background.items()):
        seen = sizes[np.isfinite(sizes[:, c]), c]
        error = float(np.median(seen)) if len(seen) >= MIN_POINTS else np.nan
        if error <= MAX_ERROR_PX:
            continue
        found = "too few joints of a person are" if np.isnan(error) else "a person's joints are not"
        names = ", ".join(rig.names[other] for other in sorted(others))
        raise UserError(
            f"camera {rig.names[c]}: its background fits to that of {names}, but {found} where "
            f"other cameras see them ({len(seen)} joints, median {error:.0f} px, expected at least "
            f"{MIN_POINTS} and at most {MAX_ERROR_PX:g} px), and rooms can look alike from two "
            "places. Let a person walk through the common view, or show a board. Nothing was "
            "written"
        )
