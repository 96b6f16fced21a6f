"""Up direction before a floor is known: from gravity sensors, the user, or the cameras' poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig

# Largest error of an accelerometer on a tripod, or of a calibration board laid on the floor.
GRAVITY_CONE_DEG = 10.0
# Largest error of the cameras' mean up direction: that of cameras on one side of the scene, all of
# which look down by this angle.
CAMERA_UP_CONE_DEG = 40.0


@dataclass(frozen=True, eq=False)
class UpDirection:
    """Approximate direction up, master frame."""

    direction: np.ndarray
    """(3,) unit."""
    cone_deg: float
    """Largest angle to the true direction, degrees."""
    source: Literal["gravity", "stated", "cameras"]
    """Origin of the direction."""


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
        return UpDirection(up / np.linalg.norm(up), GRAVITY_CONE_DEG, "gravity")
    if stated is not None and np.isfinite(stated).all():
        return UpDirection(stated, GRAVITY_CONE_DEG, "stated")
    up = -rotations[:, :, 1].mean(0)
    return UpDirection(up / np.linalg.norm(up), CAMERA_UP_CONE_DEG, "cameras")


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
        return [f"{note}, which were believed"] * (off > GRAVITY_CONE_DEG)
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
    if off > CAMERA_UP_CONE_DEG:
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
