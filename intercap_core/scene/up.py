"""Which way is up before a floor is known: gravity sensors, what the user states, the cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig

GRAVITY_CONE_DEG = 10.0  # of an accelerometer and its mounting, on a tripod; a bound, no data sheet
STATED_UP_CONE_DEG = 10.0  # of a calibration's axis from the floor's normal: a board laid on it
CAMERA_UP_CONE_DEG = 40.0  # of the mean of the cameras' own up directions; tuned on the studio
# How far a measured floor may be from what is stated of the calibration's world before it is said:
# a board is laid by hand and is a few centimetres thick, feet tell a tilt to about 3 degrees.
STATED_UP_DEG = 4.0
STATED_FLOOR_M = 0.06
WRONG_UP_DEG = 60.0  # another axis is 90 degrees away; who bends for long leans by less
MIN_TRUNK_SETS = 5  # that show neck and hips


NECK, MID_HIP = 1, 8  # among the body's keypoints


@dataclass(frozen=True, eq=False)
class UpDirection:
    """``direction`` (3,), unit, master frame; up is within ``cone_deg`` of it."""

    direction: np.ndarray
    cone_deg: float
    source: Literal["gravity", "stated", "cameras"]


def rough_up(rig: Rig, gravity: np.ndarray, stated: np.ndarray | None = None) -> UpDirection:
    """Roughly up.

    ``gravity`` (C, 3) points down in each colour camera, NaN where not known; where no sensor
    measured it, ``stated`` (3,), master frame, None or NaN = not stated; else the images' upward
    directions, whose tilts cancel around a ring.
    """
    measured = np.isfinite(gravity).all(1)
    rotations = rig.master_from_colour[:, :3, :3]
    if measured.any():
        down = np.einsum("cij,cj->ci", rotations[measured], gravity[measured])
        up = -np.median(down, axis=0)
        return UpDirection(up / np.linalg.norm(up), GRAVITY_CONE_DEG, "gravity")
    if stated is not None and np.isfinite(stated).all():
        return UpDirection(stated, STATED_UP_CONE_DEG, "stated")
    up = -rotations[:, :, 1].mean(0)
    return UpDirection(up / np.linalg.norm(up), CAMERA_UP_CONE_DEG, "cameras")


def trunk_direction(joints: np.ndarray) -> np.ndarray:
    """From the middle of the hips to the neck, (3,) unit: the median over joints (T, K, 3).

    NaN where fewer than ``MIN_TRUNK_SETS`` sets show it.
    """
    trunk = joints[:, NECK] - joints[:, MID_HIP]
    trunk = trunk[np.isfinite(trunk).all(1)]
    if len(trunk) < MIN_TRUNK_SETS:
        return np.full(3, np.nan)
    middle = np.median(trunk / np.linalg.norm(trunk, axis=1, keepdims=True), axis=0)
    return middle / np.linalg.norm(middle)


def check_stated_up(
    stated: np.ndarray, rig: Rig, gravity: np.ndarray, trunk: np.ndarray
) -> list[str]:
    """Say where the ``stated`` up (3,) is not that of the sensors, or of the cameras and a person.

    ``trunk`` (3,) is :func:`trunk_direction`. Raises UserError, to be prefixed with the sequence,
    where nothing measured gravity and both the cameras and the person deny it: whatever lies flat
    that way would be taken for the floor.
    """
    if not np.isfinite(stated).all():
        return []
    without = rough_up(rig, gravity)
    off = degrees_between(stated, without.direction)
    if without.source == "gravity":
        said = f"the stated up (calibration_up) is {off:.0f} degrees from the gravity sensors'"
        return [f"{said}, which were believed"] * (off > GRAVITY_CONE_DEG)
    leans = degrees_between(stated, trunk)
    if off > WRONG_UP_DEG and leans > WRONG_UP_DEG:
        raise UserError(
            f"calibration_up is {off:.0f} degrees from the cameras' mean up and {leans:.0f} from "
            "the person's trunk, expected less than "
            f"{WRONG_UP_DEG:.0f} from one of them; state another axis of the calibration's world, "
            "or leave the column empty"
        )
    notes = []
    if off > CAMERA_UP_CONE_DEG:
        notes.append(f"the stated up is {off:.0f} degrees from the cameras' mean up")
    if leans > WRONG_UP_DEG:
        notes.append(f"the stated up is {leans:.0f} degrees from the person's trunk")
    return notes


def compare_with_stated(
    point: np.ndarray, normal: np.ndarray, up: np.ndarray, floor: np.ndarray, middle: np.ndarray
) -> list[str]:
    """Say where a floor, its ``point`` and ``normal`` (3,), is not the one that is stated.

    ``up`` and a point of the stated ``floor`` (3,), NaN = not stated; heights are compared at
    ``middle`` (3,). All in the master's frame.
    """
    notes = []
    off = degrees_between(up, normal)
    if off > STATED_UP_DEG:
        notes.append(f"the floor is tilted by {off:.1f} degrees from the stated up")
    higher = (point - middle) @ normal - (floor - middle) @ up
    if abs(higher) > STATED_FLOOR_M:
        side = "above" if higher > 0 else "below"
        notes.append(f"the floor is {abs(higher):.2f} m {side} the stated one")
    return notes


def degrees_between(a: np.ndarray, b: np.ndarray) -> float:
    """The angle of two unit vectors (3,); NaN where one is."""
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))
