"""Signed distance of points from a person of average build around the triangulated keypoints.

The person is a union of tapered capsules (two radii), one per bone. The position of its surface is
uncertain by 3.5 cm at the trunk (clothing, build) and by 1.2 cm at the fingers. This
uncertainty is the *margin* of a bone. Distances are divided by it: a distance of 2 margins is 7 cm
at the trunk and 2.4 cm at a finger.

:class:`MovingPerson` evaluates the bones at the exposure of each camera: a fast forearm moves by
centimetres between the time of a set and the exposure.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.artefacts import Artefact
from intercap_core.body.keypoints import KEYPOINT_NAMES, of_side
from intercap_core.formats.recordings.synchronise import frame_interval, in_step_sigma
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.solve.time_series import filled_linearly, limited_velocity

# Radii at the first and at the second keypoint, and the uncertainty of the surface (one margin:
# clothing and build), metres. Radii are half breadths, and girths over 2 pi, of NASA-STD-3000,
# section 3.3; margins are tuned on the studio. "middle_ear" is half way between the ears.
TRUNK_RADII_M: dict[tuple[str, str], tuple[float, float, float]] = {
    ("neck", "mid_hip"): (0.130, 0.130, 0.035),
    ("left_shoulder", "left_hip"): (0.100, 0.110, 0.035),
    ("right_shoulder", "right_hip"): (0.100, 0.110, 0.035),
    ("left_hip", "right_hip"): (0.115, 0.115, 0.035),
    ("left_shoulder", "right_shoulder"): (0.075, 0.075, 0.035),
    ("neck", "middle_ear"): (0.075, 0.080, 0.030),
    ("middle_ear", "middle_ear"): (0.125, 0.125, 0.025),
    ("nose", "middle_ear"): (0.045, 0.105, 0.025),
}
# The same for the bones of each side.
LIMB_RADII_M: dict[tuple[str, str], tuple[float, float, float]] = {
    ("shoulder", "elbow"): (0.065, 0.048, 0.025),
    ("elbow", "wrist"): (0.048, 0.034, 0.018),
    ("hip", "knee"): (0.105, 0.070, 0.030),
    ("knee", "ankle"): (0.068, 0.045, 0.022),
    ("ankle", "big_toe"): (0.048, 0.035, 0.022),
    ("ankle", "heel"): (0.050, 0.045, 0.022),
    ("heel", "small_toe"): (0.040, 0.035, 0.022),
    ("heel", "big_toe"): (0.040, 0.035, 0.022),
}
FINGER_RADII_M = (0.012, 0.010, 0.009)  # at the second joint, third joint and tip (anatomy)
PALM_RADII_M = (0.024, 0.016)  # at the wrist, at the knuckles (anatomy)
# Distances are truncated here, margins: 24 cm from a finger, 70 cm from the trunk. A component that
# far away is certainly not clothing.
FAR = 20.0


def build_bones(joints: np.ndarray, sigma: np.ndarray | None = None) -> np.ndarray:
    """Bones (B, 9) float32 of one moment; hands last.

    Columns 0:3 and 3:6 are the ends, 6 and 7 the radii there, 8 the margin, all in metres. Bones
    with an unknown end are left out. Radii are scaled by the length of the trunk.

    Args:
        joints: (135, 3) metres; NaN = unknown.
        sigma: (135,) standard deviations of the keypoints, metres. The mean over both ends
            of a bone is added to its margin in quadrature.
    """
    off = np.zeros(len(joints)) if sigma is None else sigma
    points = np.column_stack([joints, off])  # (135, 4)
    at = {name: points[i] for i, name in enumerate(KEYPOINT_NAMES[:67])}
    at["middle_ear"] = _middle(at["left_ear"], at["right_ear"])
    # 0.50 m: distance from neck to mid hip of a person with these radii (anatomy)
    size = float(np.linalg.norm((at["neck"] - at["mid_hip"])[:3])) / 0.50
    # range from children to the tallest adults
    size = float(np.clip(size, 0.6, 1.25)) if np.isfinite(size) else 1.0
    radii = list(TRUNK_RADII_M.items())
    for side in ("left", "right"):
        radii += zip(of_side(side, LIMB_RADII_M), LIMB_RADII_M.values(), strict=True)
    rows = [(at[a], at[b], size * ra, size * rb, margin) for (a, b), (ra, rb, margin) in radii]
    for side in ("left", "right"):
        rows += _hand(at, side)
    a, b, *others = zip(*rows, strict=True)
    first, second = np.array(a), np.array(b)
    radii_and_margin = np.array(others).T
    radii_and_margin[:, 2] = np.hypot(radii_and_margin[:, 2], (first[:, 3] + second[:, 3]) / 2)
    bones = np.concatenate([first[:, :3], second[:, :3], radii_and_margin], 1).astype(np.float32)
    return bones[np.isfinite(bones).all(1)]


def _hand(
    at: dict[str, np.ndarray], side: str
) -> list[tuple[np.ndarray, np.ndarray, float, float, float]]:
    """Bones of one hand: (start, end, two radii, margin) each.

    Ends (4,) are x, y, z and standard deviation. With fewer than three known knuckles, the hand is
    one capsule that prolongs the forearm.
    """
    wrist = at[f"{side}_wrist"]
    if not np.isfinite(wrist).all():
        wrist = at[f"{side}_hand_wrist"]
    rows = []
    known = 0
    margin = 0.012  # of fingers and palm, metres; tuned on the studio
    for finger in ("thumb", "index", "middle", "ring", "pinky"):
        chain = [at[f"{side}_{finger}{i}"] for i in (1, 2, 3)] + [at[f"{side}_{finger}_tip"]]
        known += int(np.isfinite(chain[0]).all())
        rows.append((wrist, chain[0], *PALM_RADII_M, margin))
        radii = (PALM_RADII_M[1], *FINGER_RADII_M)
        rows += [(chain[i], chain[i + 1], radii[i], radii[i + 1], margin) for i in range(3)]
    if known >= 3:
        return rows
    along = wrist - at[f"{side}_elbow"]
    along[3] = 0.0  # as uncertain as the wrist
    # 15 cm along the forearm, radius 4.5 cm (anatomy), margin tuned on the studio
    along *= 0.15 / max(float(np.linalg.norm(along)), 1e-6)
    return [(wrist, wrist + along, 0.045, 0.045, 0.02)]


def _middle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mean of two points; if one is unknown, the other."""
    if not np.isfinite(a).all():
        return b
    return a if not np.isfinite(b).all() else (a + b) / 2


def distance_outside(points: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """Signed distance (N,) float32 of points (N, 3) float32 from the person, in margins.

    Negative inside, at most ``FAR``. The distance from a bone is (distance from its axis - radius
    at the foot point) / margin. The foot point is the nearest point of the axis, and the radius is
    interpolated there, which slightly differs from the exact tapered capsule.

    ``bones``: (B, 9), see :func:`build_bones`.
    """
    along = bones[:, 3:6] - bones[:, :3]
    length = np.maximum((along**2).sum(1, keepdims=True), np.float32(1e-10))
    parts = [
        bones[:, :3],
        along,
        along / length,
        bones[:, 6:7],
        np.diff(bones[:, 6:8]),
        bones[:, 8:],
    ]
    return _outside(np.ascontiguousarray(points.T), np.concatenate(parts, 1))


@numba.njit(cache=True, fastmath=True)
def _outside(points: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """Kernel of :func:`distance_outside`, without branches so that the inner loop is vectorised.

    Args:
        points: (3, N) float32.
        bones: (B, 12) float32: start; vector to the end; the same divided by its squared length;
            radius at the start; its change towards the end; margin.
    """
    x, y, z = points[0], points[1], points[2]
    result = np.full(len(x), np.float32(FAR))
    for b in range(len(bones)):
        ax, ay, az, dx, dy, dz, ex, ey, ez, radius, change, margin = bones[b]
        for i in range(len(x)):
            ux, uy, uz = x[i] - ax, y[i] - ay, z[i] - az
            share = min(max(ux * ex + uy * ey + uz * ez, np.float32(0)), np.float32(1))
            ux, uy, uz = ux - share * dx, uy - share * dy, uz - share * dz
            away = np.sqrt(ux * ux + uy * uy + uz * uz)
            result[i] = min(result[i], (away - radius - share * change) / margin)
    return result


class MovingPerson:
    """The person's volume over time.

    ``joints`` (T, K, 3) are the keypoints, metres, with short gaps filled; NaN = unknown.
    """

    def __init__(
        self,
        joints: np.ndarray,
        sigma: np.ndarray,
        scene: Artefact,
        frame_from_master: np.ndarray | None = None,
    ) -> None:
        """``sigma`` (T, K) are standard deviations of ``joints`` (T, K, 3), master frame, metres.

        ``scene`` gives times and time offsets, ``frame_from_master`` (4, 4) leads to the frame of
        the result; None = the master's.
        """
        times = scene["times"]
        if frame_from_master is not None:
            joints = apply(frame_from_master, joints.reshape(-1, 3)).reshape(joints.shape)
        # sets more than half a second from the nearest known one stay unknown; tuned on the studio
        self.joints = fill_short_gaps(joints, times)
        self._sigma = np.nan_to_num(sigma)
        self._velocity = np.nan_to_num(
            # at most 8 m/s: hands reach 5 m/s in everyday tasks
            limited_velocity(self.joints, times, max_speed=8.0)
        )
        self._late = scene["time_offset"]
        undetermined = in_step_sigma(frame_interval(times))
        self._late_sigma = np.nan_to_num(scene["time_offset_sigma"], nan=undetermined)

    def bones(self, t: int, c: int) -> np.ndarray:
        """Bones (B, 9) at the exposure of camera ``c`` in set ``t``, see :func:`build_bones`."""
        off = self._late_sigma[c] * np.linalg.norm(self._velocity[t], axis=-1)
        joints = self.joints[t] + self._late[c] * self._velocity[t]
        return build_bones(joints, np.hypot(self._sigma[t], off))

    def bones_at(self, t: int) -> np.ndarray:
        """Bones (B, 9) at the time of set ``t``, see :func:`build_bones`."""
        return build_bones(self.joints[t], self._sigma[t])


def fill_short_gaps(joints: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Fill short gaps of keypoints (T, K, 3), NaN = unknown, by linear interpolation.

    A set is filled if the keypoint is known in some set within 0.5 s. Before the first and
    after the last known set, the nearest position is repeated. ``times``: (T,) seconds.
    """
    result = joints.copy()
    for k in range(joints.shape[1]):
        known = np.isfinite(joints[:, k]).all(1)
        if known.any():
            near = np.abs(times[:, None] - times[known]).min(1) <= 0.5
            result[near, k] = filled_linearly(joints[:, k], times, known)[near]
    return result
