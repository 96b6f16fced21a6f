"""Scripts in which the held object moves in the hand: glide, turn, re-grasp.

``slide`` states the motion between hand and object; true contact and slip follow from it.
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.camera.transforms import rigid, rotation_exp
from intercap_core.studio.controls import PoseTrack, plateau, ramp
from intercap_core.studio.hands import HandShape
from intercap_core.studio.interactions.presenting import Checking
from intercap_core.studio.interactions.swinging import Swinging
from intercap_core.studio.motion import RIGHT


def along_and_about(along: np.ndarray, about: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Transforms (N, 4, 4): ``along`` (N,) metres along z, ``about`` (N,) rad around z.

    The rotation axis goes through ``axis`` (2,), metres.
    """
    vectors = np.zeros((len(along), 3))
    vectors[:, 2] = about
    rotation, place = rotation_exp(vectors), np.array([*axis, 0.0])
    result = rigid(rotation, place - rotation @ place)
    result[:, 2, 3] += along
    return result


class GlidingSwing(Swinging):
    """The hand glides along the grip towards the head as the racquet goes back, and back to the
    butt as it swings through."""

    glide_s = (1.14, 1.44, 1.66, 1.98)  # start and end of gliding, and of gliding back, script time
    glide_m = 0.032  # along the grip, towards the head and back, metres

    def slide(self, times: np.ndarray) -> np.ndarray:
        """Along the grip, which has the same thickness everywhere."""
        along = self.glide_m * plateau(times, *self.glide_s)
        return along_and_about(along, np.zeros(len(times)), np.zeros(2))


class TurningSwing(Swinging):
    """The straight handle turns in the fingers while it points ahead, and back."""

    turn_s = (1.16, 1.50, 1.62, 2.02)  # start and end of turning, and of turning back, script time
    turn_deg = 55.0  # about the handle, and back

    def slide(self, times: np.ndarray) -> np.ndarray:
        """About the middle of the handle where it is held; the object turns the other way."""
        near = np.abs(self.prop.vertices[:, 2] - self.handle_m) < 0.03
        handle = self.prop.vertices[near, :2]
        axis = (handle.min(0) + handle.max(0)) / 2
        about = np.radians(self.turn_deg) * plateau(times, *self.turn_s)
        return along_and_about(np.zeros(len(times)), about, axis)


class Regrasp(Checking):
    """The hand lets go of the bottle and grasps it higher up and turned, then lifts it.

    The bottle stands on the plinth meanwhile. The right hand alone turns it before the eyes.
    """

    regrasp_s = (1.04, 1.12, 1.26, 1.36)  # opens from, is open, closes from, is closed
    rests_until_s = 1.36  # the bottle stands on the plinth until then, script time
    regrasp_up_m = 0.022  # shift of the hand along the bottle, metres
    regrasp_deg = 28.0  # turn of the hand about the bottle
    regrasp_off_m = 0.012  # gap between the open hand and the bottle meanwhile, metres

    def raised(self, times: np.ndarray, side: int) -> np.ndarray:
        """Zeros: no arm helps."""
        return np.zeros(len(times))

    def slide(self, times: np.ndarray) -> np.ndarray:
        """From the first place to the second while the hand is open."""
        opens, off, back, closed = self.regrasp_s
        share = ramp(times, (opens + off) / 2, (back + closed) / 2)
        about = np.radians(self.regrasp_deg) * share
        moved = along_and_about(self.regrasp_up_m * share, about, np.zeros(2))
        hand = self.puppet.hands[RIGHT]
        away = self.grips[RIGHT].object_from_wrist[:3, :3] @ -hand.palm
        away = away * self.regrasp_off_m * plateau(times, *self.regrasp_s)[:, None]
        moved[:, :3, 3] += np.einsum("nij,nj->ni", moved[:, :3, :3], away)
        return moved

    def path(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> PoseTrack:
        """As in the base script, but the bottle rests until the second grasp."""
        way = super().path(world, pelvis, times)
        return PoseTrack.of(self.pick_pose).through(times, (way, self.rests_until_s, 1.80))

    def finger_keys(self, side: int, times: np.ndarray) -> list[tuple[np.ndarray, HandShape]]:
        """The hand opens and closes a second time."""
        keys = super().finger_keys(side, times)
        if side != RIGHT:
            return keys
        opens, off, back, closed = self.regrasp_s
        grip = self.grips[RIGHT]
        again = [(ramp(times, opens, off), grip.open), (ramp(times, back, closed), grip.closed)]
        return [*keys[:2], *again, *keys[2:]]
