"""How far points lie outside a person of usual build around the triangulated keypoints.

The person is the union of cones with round ends around the bones. Where that ends is known only so
well: clothing and build make a trunk uncertain by centimetres, fingers are told within millimetres.
So the distance is given in units of that uncertainty, bone by bone.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.body.keypoints import KEYPOINT_NAMES

# Bones: keypoints at both ends, radii there, how uncertain the surface is, metres. Radii are those
# of adults of middle build (half breadths and girths over 2 pi of NASA-STD-3000, section 3.3).
# "middle_ear" is half way between the ears.
_BODY: tuple[tuple[str, str, float, float, float], ...] = (
    ("neck", "mid_hip", 0.130, 0.130, 0.035),
    ("left_shoulder", "left_hip", 0.100, 0.110, 0.035),
    ("right_shoulder", "right_hip", 0.100, 0.110, 0.035),
    ("left_hip", "right_hip", 0.115, 0.115, 0.035),
    ("left_shoulder", "right_shoulder", 0.075, 0.075, 0.035),
    ("neck", "middle_ear", 0.075, 0.080, 0.030),
    ("middle_ear", "middle_ear", 0.125, 0.125, 0.025),
    ("nose", "middle_ear", 0.045, 0.105, 0.025),
)
_LIMBS: tuple[tuple[str, str, float, float, float], ...] = (
    ("shoulder", "elbow", 0.065, 0.048, 0.025), ("elbow", "wrist", 0.048, 0.034, 0.018),
    ("hip", "knee", 0.105, 0.070, 0.030), ("knee", "ankle", 0.068, 0.045, 0.022),
    ("ankle", "heel", 0.050, 0.045, 0.022), ("ankle", "big_toe", 0.048, 0.035, 0.022),
    ("heel", "small_toe", 0.040, 0.035, 0.022), ("heel", "big_toe", 0.040, 0.035, 0.022),
)  # fmt: skip
_FINGER = (0.012, 0.010, 0.009)  # radius at the knuckle, middle, tip
_PALM = (0.024, 0.016)  # at the wrist, at the knuckles
_HAND_MARGIN = 0.012
# A hand whose fingers nobody saw goes on from the wrist along the forearm by this much.
_HAND_LENGTH, _HAND_RADIUS, _BLIND_MARGIN = 0.15, 0.045, 0.02
_USUAL_TRUNK_M = 0.50  # neck to middle of the hips, of the people whose radii these are
_SMALLEST, _LARGEST = 0.6, 1.25  # children to the tallest
_GROUP = 5  # bones that are passed over together where a point is far from all of them
FAR = 20.0  # the distance that is given to whatever is farther than this


def bones_of(joints: np.ndarray) -> np.ndarray:
    """Bones (B, 9) float32 of one moment: both ends, both radii, margin; metres; hands last.

    ``joints`` (135, 3), NaN = not known; a bone without one of its ends is left out.
    """
    at = {name: joints[i] for i, name in enumerate(KEYPOINT_NAMES[:67])}
    at["middle_ear"] = _middle(at["left_ear"], at["right_ear"])
    size = float(np.linalg.norm(at["neck"] - at["mid_hip"])) / _USUAL_TRUNK_M
    size = float(np.clip(size, _SMALLEST, _LARGEST)) if np.isfinite(size) else 1.0
    rows = [(at[a], at[b], size * ra, size * rb, margin) for a, b, ra, rb, margin in _BODY]
    for side in ("left", "right"):
        for a, b, ra, rb, margin in _LIMBS:
            rows.append((at[f"{side}_{a}"], at[f"{side}_{b}"], size * ra, size * rb, margin))
    for side in ("left", "right"):
        rows += _hand(at, side)
    bones = np.array([[*a, *b, ra, rb, margin] for a, b, ra, rb, margin in rows], np.float32)
    return bones[np.isfinite(bones).all(1)].reshape(-1, 9)


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
        rows.append((wrist, chain[0], *_PALM, _HAND_MARGIN))
        radii = (_PALM[1], *_FINGER)
        rows += [(chain[i], chain[i + 1], radii[i], radii[i + 1], _HAND_MARGIN) for i in range(3)]
    if known >= 3:
        return rows
    along = wrist - at[f"{side}_elbow"]
    along = along / max(float(np.linalg.norm(along)), 1e-6) * _HAND_LENGTH
    return [(wrist, wrist + along, _HAND_RADIUS, _HAND_RADIUS, _BLIND_MARGIN)]


def _middle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    if not np.isfinite(a).all():
        return b
    return a if not np.isfinite(b).all() else (a + b) / 2


def outside(points: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """How far points (N, 3) float32 lie outside the person, in margins, (N,) float32.

    Negative inside, at most :data:`FAR`; ``bones`` (B, 9) of :func:`bones_of`.
    """
    groups = range(0, len(bones), _GROUP)
    balls = np.zeros((len(groups), 5), np.float32)  # around every group of bones, largest margin
    for row, first in zip(balls, groups, strict=True):
        some = bones[first : first + _GROUP]
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
            if b % _GROUP == 0:
                g = b // _GROUP
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
