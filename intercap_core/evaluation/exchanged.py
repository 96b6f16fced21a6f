"""Frames in which left and right of a limb seem exchanged: they jump to each other's place."""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX

_SIDES = ("left", "right")
_LIMBS = {
    "legs": ("knee", "ankle", "foot"),
    "arms": ("elbow", "wrist"),
}
# Each side's joints end where the other's were: the way to their own place is this many times the
# way to the other's, and this long on average, metres. Limbs that cross in motion pass each other
# without one being where the other was. Chosen on the studio: over 112 recordings no limb is taken
# for exchanged that is not, with 1.5 one is.
MUCH_FARTHER, LEAST_JUMP_M = 2.0, 0.15


def exchanged(joints: np.ndarray) -> dict[str, np.ndarray]:
    """For each pair of limbs the frames (T,) in which, of joints (T, 55, 3), the sides are not what
    they are in most of the frames."""
    found = {}
    for limb, names in _LIMBS.items():
        sides = np.stack(
            [joints[:, [JOINT_INDEX[f"{side}_{name}"] for name in names]] for side in _SIDES], 1
        )  # (T, 2, J, 3)
        own, other = (
            np.linalg.norm(sides[1:] - before, axis=3).mean(axis=(1, 2))
            for before in (sides[:-1], sides[:-1, ::-1])
        )
        jumps = (own > MUCH_FARTHER * other) & (own > LEAST_JUMP_M)
        state = np.concatenate([[0], np.cumsum(jumps) % 2]).astype(bool)
        found[limb] = state if state.mean() <= 0.5 else ~state
    return found
