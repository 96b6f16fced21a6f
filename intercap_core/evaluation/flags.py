"""Reasons for unreliable frames, and detection of limbs whose left and right are exchanged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.body.joints import JOINT_INDEX


def merge_reasons(sources: Sequence[tuple[np.ndarray, str]]) -> list[str]:
    """Join the reasons that hold in each frame: (mask (T,), reason) to T texts, empty = fine."""
    frames = len(sources[0][0])
    return ["; ".join(reason for mask, reason in sources if mask[t]) for t in range(frames)]


def ranges(reasons: Sequence[str]) -> list[tuple[int, int, str]]:
    """Runs of frames with the same reason as (first, last, reason), empty reasons left out."""
    runs: list[tuple[int, int, str]] = []
    for frame, reason in enumerate(reasons):
        if not reason:
            continue
        if runs and runs[-1][1] == frame - 1 and runs[-1][2] == reason:
            runs[-1] = (runs[-1][0], frame, reason)
        else:
            runs.append((frame, frame, reason))
    return runs


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
