"""Epipolar cost of a time lag between two cameras, from the motion of people whom both see.

People are followed in each camera's images separately, so the cameras need not be synchronised.
A detector may exchange left and right. Only body points are used that do not depend on the sides:
nose, neck, middle of the hips, middle between both knees, and others. The search uses the points of
:data:`SEARCHED`; those of :data:`WITNESS` check its result.

Axes: T sets, C cameras, P places for people, K body points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.formats.recordings.synchronise import usual_steps
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import invert
from intercap_core.geometry.camera.triangulation import pixel_scale
from intercap_core.person.subject_joints import MAX_IMAGE_SPEED_RAD_S
from intercap_core.person.tracks import MAX_LINK_GAP_S
from intercap_core.scene.keypoint_motion import MIN_CONFIDENCE, known_median

_ALONE = ("nose", "neck", "mid_hip")
_SIDED = (
    "shoulder", "elbow", "wrist", "hip", "knee", "ankle",
    "eye", "ear", "big_toe", "heel", "middle1",
)  # fmt: skip
_SINGLE = [KEYPOINT_INDEX[name] for name in _ALONE]
_LEFT, _RIGHT = ([KEYPOINT_INDEX[f"{s}_{name}"] for name in _SIDED] for s in ("left", "right"))
_PLACES = {name: k for k, name in enumerate(_ALONE + _SIDED)}

# Places in :func:`body_middles` of the points that the search uses, by group. The points of a group
# share errors of the detector, because they are neighbours or derived from each other.
SEARCHED = {
    group: tuple(_PLACES[name] for name in names)
    for group, names in {
        "head and shoulders": ("nose", "neck", "shoulder"),
        "arms": ("elbow", "wrist"),
        "hips": ("mid_hip", "hip"),
        "legs": ("knee", "ankle"),
    }.items()
}
# Places of the points of face, feet and hands, which the search does not use.
WITNESS = tuple(_PLACES[name] for name in ("eye", "ear", "big_toe", "heel", "middle1"))


def body_middles(person: np.ndarray) -> np.ndarray:
    """Pixels (K, 2) of the body points of a person (135, 3) that do not depend on left and right.

    They are nose, neck and mid hip, and the middles of left and right shoulder, elbow, wrist, hip,
    knee, ankle, eye, ear, big toe, heel and knuckle of the middle finger. NaN if a point or one of
    both sides is not seen.
    """
    known = np.where(person[:, 2:] >= MIN_CONFIDENCE, person[:, :2], np.nan)
    return np.concatenate([known[_SINGLE], (known[_LEFT] + known[_RIGHT]) / 2])


def follow_rays(
    detections: PeopleOfImages, rig: Rig, times: np.ndarray, available: np.ndarray
) -> np.ndarray:
    """Follow people in each camera's images; returns the rays of their :func:`body_middles`.

    Rays (T, C, P, K, 2) are x and y at z = 1 in the colour camera's frame; NaN = not seen. Each of
    the P = 3 places holds one person for as long as they can be followed. Places of different
    cameras are unrelated. Of more people in an image, those of greatest confidence are used.

    Args:
        times: (T,) seconds of the sets.
        available: (T, C) bool, the set has an image of the camera.
    """
    rays = np.full((*available.shape, 3, len(_PLACES), 2), np.nan)
    for c, usual in enumerate(usual_steps(available)):
        images = np.flatnonzero(available[:, c])
        for t in images.tolist():
            people = detections.people(t, c)
            surest = np.argsort(-people[..., 2].sum(1), kind="stable")[:3]
            if not len(surest):
                continue
            pixels = np.stack([body_middles(people[i]) for i in surest])
            _place(rays[:, c], t, rig[c].colour.unproject(pixels)[..., :2], times)
        if usual >= 1.5:  # sets from image to image: 1 at the full frame rate, 2 at half of it
            _carry_on(rays[:, c], images, usual)
    return rays


def _place(rays: np.ndarray, t: int, people: np.ndarray, times: np.ndarray) -> None:
    """Write an image's ``people`` (N, K, 2) into row ``t`` of ``rays`` (T, P, K, 2), in place.

    A person is assigned to the place whose last person was recently seen nearby, closest pairs
    first. The remaining people take the places that were unused for longest.
    """
    count = rays.shape[1]
    last = [_last_seen(rays[:t, place]) for place in range(count)]
    options = sorted(
        (float(np.nanmedian(np.linalg.norm(person - rays[seen, place], axis=1))), i, place)
        for i, person in enumerate(people)
        for place, seen in enumerate(last)
        if seen >= 0 and np.isfinite(person[:, 0] + rays[seen, place, :, 0]).any()
    )
    free, waiting = set(range(count)), set(range(len(people)))
    for apart, i, place in options:
        gap = float(times[t] - times[last[place]])
        reach = 0.05 + MAX_IMAGE_SPEED_RAD_S * gap  # rad; 0.05 for detector noise, untuned
        if i in waiting and place in free and gap <= MAX_LINK_GAP_S and apart <= reach:
            rays[t, place] = people[i]
            waiting.remove(i)
            free.remove(place)
    for i in sorted(waiting):
        place = min(free, key=lambda k: last[k])
        rays[t, place] = people[i]
        free.remove(place)


def _last_seen(rays: np.ndarray) -> int:
    """Index of the last set in which a person's rays (T, K, 2) are known; -1 = none."""
    seen = np.flatnonzero(np.isfinite(rays[..., 0]).any(1))
    return int(seen[-1]) if len(seen) else -1


def _carry_on(rays: np.ndarray, images: np.ndarray, usual: float) -> None:
    """Interpolate the ``rays`` (T, P, K, 2) of a camera with a lower frame rate, in place.

    A lag uses only the sets in which both cameras have rays. Without interpolation, the costs of
    adjacent lags would come from different sets and would not be comparable.

    Args:
        images: (N,) sets with an image.
        usual: usual number of sets from image to image.
    """
    for first, last in pairwise(images.tolist()):
        if last - first > 2 * usual:
            continue  # lost images are not interpolated
        for t in range(first + 1, last):
            share = (t - first) / (last - first)
            rays[t] = (1 - share) * rays[first] + share * rays[last]


@dataclass(frozen=True, eq=False)
class PairCosts:
    """Mean disagreement of pairs of cameras, by lag and body point.

    A delay of camera c by d sets means that it shows moment t in its image of set t + d. The lag of
    a pair (a, b) is the delay of b minus that of a.
    """

    cost: np.ndarray
    """(C, C, 2 reach + 1, K) mean cost of a pair (a, b), 0 to 1, at lag index - reach; NaN =
    unknown."""
    reach: int
    """Largest delay of a camera, and largest lag of a pair, that is tried, sets."""

    @classmethod
    def of(cls, rays: np.ndarray, rig: Rig, reach: int, fewest: float) -> PairCosts:
        """Compute costs of ``rays`` (T, C, P, K, 2).

        ``fewest``: least number of sets in which two people must be seen together at a lag; costs
        of others are NaN.
        """
        lags, views = range(-reach, reach + 1), len(rig)
        occupied = np.isfinite(rays[..., 0]).any((0, 3))  # (C, P)
        people = [rays[:, c, places] for c, places in enumerate(occupied)]
        cost = np.full((views, views, len(lags), rays.shape[3]), np.nan)
        for a, b in combinations(range(views), 2):
            epipolar = _epipolar_geometry(rig, a, b)
            for i, lag in enumerate(lags):
                cost[a, b, i] = _cost(people[a], people[b], epipolar, lag, fewest)
            cost[b, a] = cost[a, b, ::-1]
        return cls(cost, reach)

    def profile(
        self,
        camera: int,
        others: Sequence[int],
        late: np.ndarray,
        points: Sequence[int],
        bound: int | None = None,
    ) -> np.ndarray:
        """Mean cost (2 reach + 1,) of a camera's pairs by its delay, -reach to reach.

        Args:
            others: the other cameras of the pairs.
            late: (C,) delays of all cameras, sets.
            points: compared body points.
            bound: largest delay, sets; None = ``reach``.

        Returns:
            Cost; NaN if unknown, or beyond ``bound``.
        """
        tried = np.arange(-self.reach, self.reach + 1)
        lag = tried[:, None] - late[list(others)]
        cost = self.cost[list(others), camera, np.clip(lag + self.reach, 0, 2 * self.reach)]
        cost = np.where(np.abs(lag)[..., None] <= self.reach, cost, np.nan)[..., list(points)]
        cost = known_mean(cost.reshape(len(tried), -1).T)
        return cost if bound is None else np.where(np.abs(tried) <= bound, cost, np.nan)


def _cost(
    rays_a: np.ndarray,
    rays_b: np.ndarray,
    epipolar: tuple[np.ndarray, float],
    lag: int,
    fewest: float,
) -> np.ndarray:
    """Mean costs (K,) of one lag of cameras a and b, by body point.

    1. Each person of camera a is compared with the person of camera b who has the least mean
       epipolar distance over the whole recording.
    2. The median over time is subtracted from the distance x of each body point. The cost is
       Geman and McClure's x^2 / (x^2 + s^2) with s = 6 px at 1080p.
    3. Costs of people are averaged with their amount of motion as weight, because a person who
       stands still agrees at any lag.

    Args:
        rays_a: (T, P, K, 2).
        rays_b: (T, Q, K, 2).
        epipolar: see :func:`_epipolar_geometry`.
        lag: sets.
        fewest: least number of sets.
    """
    sets = len(rays_a)
    at = slice(max(0, -lag), min(sets, sets - lag))
    if at.stop - at.start < fewest:
        return np.full(rays_a.shape[2], np.nan)
    first, second = rays_a[at], rays_b[at.start + lag : at.stop + lag]
    distance = _sampson_distances(first, second, *epipolar)
    seen = np.isfinite(distance).sum(0, keepdims=True)
    distance = np.where(seen >= fewest, distance, np.nan)
    known = np.isfinite(distance).any(-1)  # (T, P, Q)
    size = known_mean(known_mean(np.moveaxis(np.abs(distance), -1, 0)))
    size[known.sum(0) < fewest] = np.nan
    cost = np.full((first.shape[1], len(first), first.shape[2]), np.nan)
    weight = cost.copy()
    for p in np.flatnonzero(np.isfinite(size).any(1)):
        own = distance[:, p, np.nanargmin(size[p])]
        change = (own - known_median(own)) / 6.0  # px at 1080p, error at the right lag; tuned
        cost[p] = change**2 / (1 + change**2)
        motion = 1e-6 + float(np.nanmean(np.sqrt(np.nanvar(first[:, p], axis=0).sum(-1))))  # rad
        weight[p] = np.where(np.isfinite(cost[p]), motion, np.nan)
    return known_mean(known_mean(weight * cost) / known_mean(weight))


def _epipolar_geometry(rig: Rig, a: int, b: int) -> tuple[np.ndarray, float]:
    """Essential matrix E (3, 3), and the mean focal length of both cameras, pixels at 1080p.

    ``y' E x`` = 0 for rays x of camera a and y of camera b to one point.
    """
    b_from_a = invert(rig[b].master_from_colour) @ rig[a].master_from_colour
    x, y, z = b_from_a[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ b_from_a[:3, :3]
    scale = pixel_scale(rig)
    return essential, float(np.mean([rig[c].colour.fx / scale[c] for c in (a, b)]))


def _sampson_distances(
    first: np.ndarray, second: np.ndarray, essential: np.ndarray, focal: float
) -> np.ndarray:
    """Signed Sampson distances (T, P, Q, K) between people of two cameras, pixels at 1080p.

    Args:
        first: (T, P, K, 2) rays of camera a.
        second: (T, Q, K, 2) rays of camera b.
        essential: (3, 3).
        focal: focal length, pixels at 1080p.
    """
    x, y = (np.concatenate([rays, np.ones_like(rays[..., :1])], -1) for rays in (first, second))
    line, back = x @ essential.T, y @ essential
    squares = [of[..., 0] ** 2 + of[..., 1] ** 2 for of in (line, back)]
    size = np.sqrt(squares[0][:, :, None] + squares[1][:, None])
    return focal * np.einsum("tpki,tqki->tpqk", line, y) / np.maximum(size, 1e-12)


def known_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the finite values over the first axis; NaN if there are none."""
    known = np.isfinite(values)
    count = known.sum(0)
    total = np.where(known, values, 0.0).sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
