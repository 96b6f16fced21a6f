"""Each camera's people, followed in its own images: no view has to be in step with another.

Where two people are in the room, what is said of one over time must not be taken from the other.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.formats.recordings.synchronise import usual_steps
from intercap_core.geometry.camera.rig import Rig
from intercap_core.person.constants import MAX_IMAGE_SPEED_RAD_S, MAX_LINK_GAP_S
from intercap_core.scene.constants import LINK_SLACK_RAD, MAX_PEOPLE, MIN_CONFIDENCE, SLOWER_SETS

_PLACE = {name: index for index, name in enumerate(KEYPOINT_NAMES)}
_SIDES = [
    (_PLACE[f"left_{name}"], _PLACE[f"right_{name}"])
    for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
]
_ALONE = [_PLACE[name] for name in ("nose", "neck", "mid_hip")]
MIDDLES = len(_ALONE) + len(_SIDES)


def middles(person: np.ndarray) -> np.ndarray:
    """Pixels (K, 2) that do not depend on which side is called left, of keypoints (135, 3); NaN
    where one of the two is not seen."""
    known = np.where(person[:, 2:] >= MIN_CONFIDENCE, person[:, :2], np.nan)
    between = [(known[left] + known[right]) / 2 for left, right in _SIDES]
    return np.concatenate([known[_ALONE], between])


def followed(
    detections: PeopleOfImages, rig: Rig, times: np.ndarray, available: np.ndarray
) -> np.ndarray:
    """Rays (T, C, P, K, 2), x and y at z = 1, of the middles of people; NaN = not seen.

    Each of the P places holds one person of a camera's images for as long as it can be followed;
    places of two cameras have nothing to do with each other. ``times`` (T,) s of the sets,
    ``available`` (T, C): the set has an image of the camera.
    """
    rays = np.full((*available.shape, MAX_PEOPLE, MIDDLES, 2), np.nan)
    for c, usual in enumerate(usual_steps(available)):
        images = np.flatnonzero(available[:, c])
        for t in images.tolist():
            people = detections.people(t, c)
            surest = np.argsort(-people[..., 2].sum(1), kind="stable")[:MAX_PEOPLE]
            if not len(surest):
                continue
            pixels = np.stack([middles(people[i]) for i in surest])
            _place(rays[:, c], t, rig[c].colour.unproject(pixels)[..., :2], times)
        if usual >= SLOWER_SETS:
            _carry_on(rays[:, c], images, usual)
    return rays


def _place(rays: np.ndarray, t: int, people: np.ndarray, times: np.ndarray) -> None:
    """Put an image's ``people`` (N, K, 2) into the places of ``rays`` (T, P, K, 2), in place: each
    where somebody was last seen near by, else into one that was free for longest."""
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
        reach = LINK_SLACK_RAD + MAX_IMAGE_SPEED_RAD_S * gap
        if i in waiting and place in free and gap <= MAX_LINK_GAP_S and apart <= reach:
            rays[t, place] = people[i]
            waiting.remove(i)
            free.remove(place)
    for i in sorted(waiting):
        place = min(free, key=lambda k: last[k])
        rays[t, place] = people[i]
        free.remove(place)


def _last_seen(rays: np.ndarray) -> int:
    """The last set of rays (T, K, 2) that has any, -1 = none."""
    seen = np.flatnonzero(np.isfinite(rays[..., 0]).any(1))
    return int(seen[-1]) if len(seen) else -1


def _carry_on(rays: np.ndarray, images: np.ndarray, usual: float) -> None:
    """Fill the ``rays`` (T, P, K, 2) of a camera of fewer images a second than sets, in place, in
    the sets between two of its ``images`` (N,), usually ``usual`` sets apart: people move evenly
    over so short a time. Else one lag is judged by other pairs and moments than the next."""
    for first, last in pairwise(images.tolist()):
        if last - first > 2 * usual:
            continue  # lost images: nothing is made up
        for t in range(first + 1, last):
            share = (t - first) / (last - first)
            rays[t] = (1 - share) * rays[first] + share * rays[last]
