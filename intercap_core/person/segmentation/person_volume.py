"""Signed distance of points from a person of average build around the triangulated keypoints.

The person is a union of capsules with two radii, one a bone. Where its surface lies is uncertain by
centimetres at the trunk (clothing, build), by millimetres at the fingers. The distance is given in
units of that uncertainty, one margin, bone by bone.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.body.keypoints import KEYPOINT_NAMES, LIMB_BONES, of_side
from intercap_core.person.segmentation.constants import (
    BLIND_HAND_LENGTH_M,
    BLIND_HAND_MARGIN_M,
    BLIND_HAND_RADIUS_M,
    BONES_PER_GROUP,
    FAR,
    FINGER_RADII_M,
    HAND_MARGIN_M,
    LARGEST_BUILD,
    LIMB_RADII_M,
    MIN_FINGERS,
    PALM_RADII_M,
    SMALLEST_BUILD,
    SOLE_RADII_M,
    TRUNK_RADII_M,
    USUAL_TRUNK_M,
)

# Name -> radii at both ends and margin, metres: trunk and head, limbs and soles of either side.
_SIDE_RADII_M = {bone: LIMB_RADII_M[bone] for bone in LIMB_BONES} | SOLE_RADII_M


def bones_of(joints: np.ndarray, sigma: np.ndarray | None = None) -> np.ndarray:
    """Bones (B, 9) float32 of one moment: both ends, both radii, margin; metres; hands last.

    ``joints`` (135, 3), NaN = not known; a bone without one of its ends is left out. A margin is
    that of the surface and, where ``sigma`` (135,) is given, metres, that of the bone's ends.
    """
    off = np.zeros(len(joints)) if sigma is None else sigma
    points = np.column_stack([joints, off])  # (135, 4)
    at = {name: points[i] for i, name in enumerate(KEYPOINT_NAMES[:67])}
    at["middle_ear"] = _middle(at["left_ear"], at["right_ear"])
    size = float(np.linalg.norm((at["neck"] - at["mid_hip"])[:3])) / USUAL_TRUNK_M
    size = float(np.clip(size, SMALLEST_BUILD, LARGEST_BUILD)) if np.isfinite(size) else 1.0
    radii = list(TRUNK_RADII_M.items())
    for side in ("left", "right"):
        bones = of_side(side, _SIDE_RADII_M)
        radii += zip(bones, _SIDE_RADII_M.values(), strict=True)
    rows = [(at[a], at[b], size * ra, size * rb, margin) for (a, b), (ra, rb, margin) in radii]
    for side in ("left", "right"):
        rows += _hand(at, side)
    found = np.array(
        [
            [*a[:3], *b[:3], ra, rb, np.hypot(margin, (a[3] + b[3]) / 2)]
            for a, b, ra, rb, margin in rows
        ],
        np.float32,
    )
    return found[np.isfinite(found).all(1)].reshape(-1, 9)


def _hand(
    at: dict[str, np.ndarray], side: str
) -> list[tuple[np.ndarray, np.ndarray, float, float, float]]:
    wrist = at[f"{side}_wrist"]
    if not np.isfinite(wrist).all():
        wrist = at[f"{side}_hand_wrist"]
    rows = []
    known = 0
    for finger in ("thumb", "index", "middle", "ring", "pinky"):
        chain = [at[f"{side}_{finger}{i}"] for i in (1, 2, 3)] + [at[f"{side}_{finger}_tip"]]
        known += int(np.isfinite(chain[0]).all())
        rows.append((wrist, chain[0], *PALM_RADII_M, HAND_MARGIN_M))
        radii = (PALM_RADII_M[1], *FINGER_RADII_M)
        rows += [(chain[i], chain[i + 1], radii[i], radii[i + 1], HAND_MARGIN_M) for i in range(3)]
    if known >= MIN_FINGERS:
        return rows
    along = wrist - at[f"{side}_elbow"]
    along[3] = 0.0  # as uncertain as the wrist
    along *= BLIND_HAND_LENGTH_M / max(float(np.linalg.norm(along)), 1e-6)
    return [(wrist, wrist + along, BLIND_HAND_RADIUS_M, BLIND_HAND_RADIUS_M, BLIND_HAND_MARGIN_M)]


def _middle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    if not np.isfinite(a).all():
        return b
    return a if not np.isfinite(b).all() else (a + b) / 2


def outside(points: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """How far points (N, 3) float32 lie outside the person, in margins, (N,) float32.

    Negative inside, at most ``FAR``; ``bones`` (B, 9) of :func:`bones_of`.
    """
    groups = range(0, len(bones), BONES_PER_GROUP)
    balls = np.zeros((len(groups), 5), np.float32)  # around every group of bones, largest margin
    for row, first in zip(balls, groups, strict=True):
        some = bones[first : first + BONES_PER_GROUP]
        ends = some[:, :6].reshape(-1, 3)
        row[:3] = (ends.min(0) + ends.max(0)) / 2
        row[3] = np.linalg.norm(ends - row[:3], axis=1).max() + some[:, 6:8].max()
        row[4] = some[:, 8].max()
    return _outside(points, bones, balls)


@numba.njit(cache=True, fastmath=True)
def _outside(points: np.ndarray, bones: np.ndarray, balls: np.ndarray) -> np.ndarray:
    found = np.empty(len(points), np.float32)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        nearest = np.float32(FAR)
        near = True
        for b in range(len(bones)):
            if b % BONES_PER_GROUP == 0:
                g = b // BONES_PER_GROUP
                ux, uy, uz = px - balls[g, 0], py - balls[g, 1], pz - balls[g, 2]
                reach = balls[g, 3] + max(nearest, np.float32(0)) * balls[g, 4]
                near = ux * ux + uy * uy + uz * uz < reach * reach
            if not near:
                continue
            ax, ay, az = bones[b, 0], bones[b, 1], bones[b, 2]
            dx, dy, dz = bones[b, 3] - ax, bones[b, 4] - ay, bones[b, 5] - az
            ux, uy, uz = px - ax, py - ay, pz - az
            length = dx * dx + dy * dy + dz * dz
            share = np.float32(0)
            if length > 1e-10:
                share = (ux * dx + uy * dy + uz * dz) / length
                share = min(max(share, np.float32(0)), np.float32(1))
            ux, uy, uz = ux - share * dx, uy - share * dy, uz - share * dz
            radius = bones[b, 6] + share * (bones[b, 7] - bones[b, 6])
            reach = radius + nearest * bones[b, 8]
            away = ux * ux + uy * uy + uz * uz
            if reach > 0 and away < reach * reach:
                nearest = (np.sqrt(away) - radius) / bones[b, 8]
        found[i] = nearest
    return found
