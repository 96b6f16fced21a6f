"""Up direction: from gravity sensors, the user, the cameras' poses, and the standing person.

:func:`rough_up` is available before the person is located. :func:`estimate_up` combines all
evidence by its stated deviations, for recordings in which no surface shows the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_INDEX, LEG_BONES, of_side
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig

# Standard deviations of the evidence for the up direction, degrees. None is tuned.
# Zero-level offset of the Azure Kinect's accelerometer, 40 mg (data sheet of the LSM6DSM).
GRAVITY_SENSOR_DEG = 2.3
# Roll of a camera that is levelled by eye on a tripod.
CAMERA_ROLL_DEG = 3.0
# Pitch of a camera, which looks up or down at the person.
CAMERA_PITCH_DEG = 25.0
FOOT_M = 0.26  # length of a foot, metres
# Height over the floor of the foot keypoints in one place, metres: one to two centimetres.
FOOT_PLACE_M = 0.02
# Axis of the calibration's world: a board that is laid on the floor by hand.
STATED_DEG = 2.0
# A floor seen by depth cameras: 11 mm of systematic error (data sheet of the Azure Kinect) over a
# patch of 1.3 m in radius.
FLOOR_DEG = 0.5
ANNOTATED_POINT_M = 0.01  # error of an annotated floor point, metres

# Segments of the body: ends, share of the mass, and place of the centre of mass between the ends.
# Means of women and men by de Leva, Adjustments to Zatsiorsky-Seluyanov's segment inertia
# parameters, 1996; head, hands and feet are added to trunk, forearms and shanks.
_SEGMENTS = (
    ("neck", "mid_hip", 0.50, 0.35),
    *(
        (f"{side}_{start}", f"{side}_{end}", share, place)
        for side in ("left", "right")
        for start, end, share, place in (
            ("hip", "knee", 0.145, 0.39),
            ("knee", "ankle", 0.058, 0.55),
            ("shoulder", "elbow", 0.026, 0.57),
            ("elbow", "wrist", 0.021, 0.60),
        )
    ),
)


@dataclass(frozen=True, eq=False)
class UpDirection:
    """Direction up, master frame."""

    direction: np.ndarray
    """(3,) unit."""
    source: str
    """Origin: "gravity", "stated", "cameras", "floor", or several, joined by ", ", of "gravity",
    "cameras", "feet" and "balance"."""
    deviation_deg: float = float("nan")
    """Standard deviation of the angle to the true direction, degrees; NaN = not estimated."""

    @property
    def cone_deg(self) -> float:
        """Largest angle of a rough direction to the true one, degrees.

        10 for an accelerometer on a tripod, or a calibration board laid on the floor. 40 for the
        mean of cameras on one side of the scene, all of which look down by this angle.
        """
        return 40.0 if self.source == "cameras" else 10.0


@dataclass(frozen=True, eq=False)
class LevelDirections:
    """Directions that are horizontal within stated deviations: evidence for the up direction."""

    directions: np.ndarray
    """(N, 3) unit vectors, master frame."""
    sigma: np.ndarray
    """(N,) standard deviations of their angles to the horizontal plane, radians."""
    source: str
    """Origin, as in :class:`UpDirection`."""


def rough_up(rig: Rig, gravity: np.ndarray, stated: np.ndarray | None = None) -> UpDirection:
    """Approximate up direction: by gravity sensors, else as stated, else by the cameras.

    The last is the mean upward direction of the images: tilts cancel around a ring of cameras.

    Args:
        gravity: (C, 3) down in each colour camera; NaN = not measured.
        stated: (3,) up in the master's frame; None or NaN = not stated.
    """
    measured = np.isfinite(gravity).all(1)
    rotations = rig.master_from_colour[:, :3, :3]
    if measured.any():
        down = np.einsum("cij,cj->ci", rotations[measured], gravity[measured])
        up = -np.median(down, axis=0)
        return UpDirection(up / np.linalg.norm(up), "gravity")
    if stated is not None and np.isfinite(stated).all():
        return UpDirection(stated, "stated", STATED_DEG)
    up = -rotations[:, :, 1].mean(0)
    return UpDirection(up / np.linalg.norm(up), "cameras")


def trunk_direction(joints: np.ndarray) -> np.ndarray:
    """Median direction (3,) from the middle of the hips to the neck, over joints (T, K, 3).

    NaN if fewer than five sets show both.
    """
    trunk = joints[:, KEYPOINT_INDEX["neck"]] - joints[:, KEYPOINT_INDEX["mid_hip"]]
    trunk = trunk[np.isfinite(trunk).all(1)]
    if len(trunk) < 5:
        return np.full(3, np.nan)
    middle = np.median(trunk / np.linalg.norm(trunk, axis=1, keepdims=True), axis=0)
    return middle / np.linalg.norm(middle)


def estimate_up(rough: UpDirection, evidence: Sequence[LevelDirections]) -> UpDirection:
    """Combine all evidence; ``rough`` only determines which of two opposite directions is up.

    The up direction u minimizes the sum of the squared sines of the directions' angles to the
    horizontal plane, divided by their variances. Weights of a Student t distribution with four
    degrees of freedom limit the effect of single directions, such as those of a camera on its side.
    The deviation grows with the residuals where these exceed their stated deviations.
    """
    levels = np.concatenate([e.directions for e in evidence])
    sigma = np.concatenate([e.sigma for e in evidence])
    up = rough.direction
    for _ in range(20):
        weight = 5 / (4 + (levels @ up / sigma) ** 2) / sigma**2
        information, axes = np.linalg.eigh((levels.T * weight) @ levels)
        up = axes[:, 0] * np.sign(axes[:, 0] @ rough.direction)
    excess = float((weight * (levels @ up) ** 2).sum()) / max(len(levels) - 2, 1)
    deviation = np.sqrt(max(1.0, excess) * (1 / np.maximum(information[1:], 1e-9)).sum())
    degrees = min(float(np.degrees(deviation)), 90.0)
    return UpDirection(up, ", ".join(e.source for e in evidence), degrees)


def camera_levels(rig: Rig, gravity: np.ndarray) -> list[LevelDirections]:
    """Evidence of cameras that are levelled by eye, and of their gravity sensors.

    The horizontal axis of each image is level. The optical axes only add a weak statement: together
    they count as one camera, because cameras on one side of the scene look down alike.

    Args:
        gravity: (C, 3) down in each colour camera; NaN = not measured.
    """
    rotations = rig.master_from_colour[:, :3, :3]
    axes = np.concatenate([rotations[:, :, 0], rotations[:, :, 2]])
    pitch = CAMERA_PITCH_DEG * np.sqrt(len(rig))
    sigma = np.repeat(np.radians([CAMERA_ROLL_DEG, pitch]), len(rig))
    result = [LevelDirections(axes, sigma, "cameras")]
    measured = np.isfinite(gravity).all(1)
    if measured.any():
        down = np.einsum("cij,cj->ci", rotations[measured], gravity[measured])
        across = np.concatenate([np.linalg.svd(one[None])[2][1:] for one in down])
        sensor = np.full(len(across), np.radians(GRAVITY_SENSOR_DEG))
        result.insert(0, LevelDirections(across, sensor, "gravity"))
    return result


def balance_levels(joints: np.ndarray) -> list[LevelDirections]:
    """Evidence of the standing person: the centre of mass is above the middle of the feet.

    A person stands if hip, knee and ankle of a leg nearly lie on a line. Returns nothing if fewer
    than five sets show a standing person. ``joints``: (T, K, 3), metres; NaN = unknown.
    """

    def of(name: str) -> np.ndarray:
        return joints[:, KEYPOINT_INDEX[name]]

    centres = np.stack([(1 - at) * of(start) + at * of(end) for start, end, _, at in _SEGMENTS])
    mass = np.array([share for *_, share, _ in _SEGMENTS])[:, None] * np.isfinite(centres[..., 0])
    centre = (mass[..., None] * np.nan_to_num(centres)).sum(0) / np.maximum(mass.sum(0), 1e-9)[
        :, None
    ]
    # all but the two arms, or one leg's lower half and an arm
    whole = mass.sum(0) > 0.9
    straight = np.zeros(len(joints), bool)
    for side in ("left", "right"):
        thigh, shank = (np.diff([of(a), of(b)], axis=0)[0] for a, b in of_side(side, LEG_BONES))
        length = np.linalg.norm(thigh, axis=1) + np.linalg.norm(shank, axis=1)
        # a knee bent by 36 degrees; the legs of sitting people are bent by 90
        straight |= np.linalg.norm(thigh + shank, axis=1) > 0.95 * length
    feet = joints[:, 19:25].reshape(len(joints), 2, 3, 3)  # side; big toe, small toe, heel
    known = np.isfinite(feet[..., :1])
    middle = np.nan_to_num(feet).sum(2) / np.maximum(known.sum(2), 1)
    whole &= (known.sum((2, 3)) > 1).all(1)  # toe and heel of both feet
    axis = (centre - middle.mean(1))[straight & whole]
    if len(axis) < 5:
        return []
    across = np.linalg.svd(axis.mean(0, keepdims=True))[2][1:]
    # the place below the centre, 1 m high, is distributed uniformly over a foot
    return [LevelDirections(across, np.full(2, FOOT_M / np.sqrt(12)), "balance")]


def floor_levels(points: np.ndarray, sigma_m: float) -> list[LevelDirections]:
    """Evidence of points (S, 3) on the floor: the two principal axes of the points are level.

    The points in a cube of a foot's length are one place. The heights of places err independently
    by ``sigma_m``. Returns nothing for fewer than three places.
    """
    cells, index = np.unique(np.floor(points / FOOT_M).astype(int), axis=0, return_inverse=True)
    if len(cells) < 3:
        return []
    count = np.bincount(index.ravel())
    places = np.stack([np.bincount(index.ravel(), axis) / count for axis in points.T], axis=1)
    _, spread, axes = np.linalg.svd(places - places.mean(0), full_matrices=False)
    # the third spread contains the actual scatter of the heights
    sigma_m = max(sigma_m, float(spread[2]) / np.sqrt(len(cells) - 2))
    return [LevelDirections(axes[:2], sigma_m / np.maximum(spread[:2], 1e-6), "feet")]


def check_stated_up(
    stated: np.ndarray, rig: Rig, gravity: np.ndarray, trunk: np.ndarray
) -> list[str]:
    """Return messages if the ``stated`` up (3,) contradicts the sensors, the cameras or the person.

    Args:
        stated: unit vector, master frame; NaN = not stated.
        gravity: (C, 3) down in each colour camera; NaN = not measured.
        trunk: see :func:`trunk_direction`.

    Raises:
        UserError: gravity was not measured, and both the cameras and the person contradict the
            statement. With a wrong up, a wall could be mistaken for the floor. The message lacks
            the name of the sequence; callers add it.
    """
    if not np.isfinite(stated).all():
        return []
    without = rough_up(rig, gravity)
    off = degrees_between(stated, without.direction)
    if without.source == "gravity":
        note = f"the stated up (calibration_up) is {off:.0f} degrees from the gravity sensors'"
        return [f"{note}, which were used"] * (off > without.cone_deg)
    leans = degrees_between(stated, trunk)
    # a wrong axis is 90 degrees off; the cameras' mean up and the trunk of a bending person less
    wrong = 60.0
    if off > wrong and leans > wrong:
        raise UserError(
            f"calibration_up is {off:.0f} degrees from the cameras' mean up and {leans:.0f} from "
            "the person's trunk, expected less than "
            f"{wrong:.0f} from one of them; state another axis of the calibration's world, "
            "or leave the column empty"
        )
    notes = []
    if off > without.cone_deg:
        notes.append(f"the stated up is {off:.0f} degrees from the cameras' mean up")
    if leans > wrong:
        notes.append(f"the stated up is {leans:.0f} degrees from the person's trunk")
    return notes


def compare_with_stated(
    point: np.ndarray, normal: np.ndarray, up: np.ndarray, floor: np.ndarray, middle: np.ndarray
) -> list[str]:
    """Return messages if a floor deviates from the stated one; all in the master's frame, metres.

    The limits are 4 degrees and 6 cm. The stated floor is a board laid by hand, a few centimetres
    thick; a floor fitted to feet is tilted by up to about 3 degrees.

    Args:
        point: (3,) point of the floor.
        normal: (3,) normal of the floor, upwards.
        up: (3,) stated up; NaN = not stated.
        floor: (3,) point of the stated floor; NaN = not stated.
        middle: (3,) where heights are compared.
    """
    notes = []
    off = degrees_between(up, normal)
    if off > 4.0:
        notes.append(f"the floor is tilted by {off:.1f} degrees from the stated up")
    higher = (point - middle) @ normal - (floor - middle) @ up
    if abs(higher) > 0.06:
        side = "above" if higher > 0 else "below"
        notes.append(f"the floor is {abs(higher):.2f} m {side} the stated one")
    return notes


def degrees_between(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two unit vectors (3,), degrees; NaN if one of them is NaN."""
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))
