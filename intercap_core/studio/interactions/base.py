"""What every scripted interaction has: a puppet, the true object, furniture, and times."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from intercap_core.geometry.camera.transforms import invert
from intercap_core.studio.controls import Footwork, Guide, Step, Wander
from intercap_core.studio.motion import Puppet
from intercap_core.studio.objects import TrueObject
from intercap_core.studio.room import Box

SCRIPT_S = 3.0  # a script's own length; longer recordings play it slower


@dataclass(frozen=True)
class Performance:
    """N moments: joint rotations (N, 55, 3, 3), pelvis (N, 3), stage_from_object (N, 4, 4), NaN
    where there is no object."""

    world: np.ndarray
    pelvis: np.ndarray
    stage_from_object: np.ndarray


@dataclass
class Interaction(ABC):
    """One script for one person and one object, or none where ``object_class`` is "".

    Script time runs from 0 to ``SCRIPT_S``. ``centre`` is the middle of the action on the floor,
    in the script's frame: z up, the floor at z = 0. ``highlight`` is the script time around which a
    recording shorter than the script is taken. ``feet_meet_object``: feet touch it on
    purpose. ``leaves_floor``: feet stand on furniture.
    """

    puppet: Puppet
    prop: TrueObject
    rng: np.random.Generator
    furniture: list[Box] = field(default_factory=list)
    object_class = ""
    feet_meet_object = False
    leaves_floor = False
    highlight = SCRIPT_S / 2
    centre = (0.0, 0.0)

    def __post_init__(self) -> None:
        self.sway = Wander(6, 0.010, self.rng)  # rad, trunk and head
        self.weight_shift = Wander(3, 0.0025, self.rng)  # metres, pelvis
        self.arm_swing = Wander(2, 0.006, self.rng)  # metres
        self.plan()

    @abstractmethod
    def plan(self) -> None:
        """Decide on places, times and grasps."""

    @abstractmethod
    def perform(self, times: np.ndarray) -> Performance:
        """Play the script at script times (N,), any order."""

    def walk(
        self,
        start: np.ndarray,
        steps: Sequence[Step],
        *,
        heading: float = 0.0,
        guides: Sequence[Guide] = (),
    ) -> None:
        """Stand at ``start`` (2, 2), left and right, with ``heading`` rad, then take the steps."""
        self.footwork = Footwork(start, heading, steps, self.puppet.ankle_height, SCRIPT_S, guides)
        self.pelvis_track = self.puppet.pelvis_track(self.footwork)

    def script_times(self, times: np.ndarray, duration: float) -> np.ndarray:
        """Script times of recording times (N,), seconds from its first set.

        A recording longer than the script slows it down; a shorter one shows the part around
        the highlight at natural speed.
        """
        if duration >= SCRIPT_S:
            return times * (SCRIPT_S / duration)
        return times + np.clip(self.highlight - duration / 2, 0, SCRIPT_S - duration)


def transform(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(4, 4) of a rotation (3, 3) and translation (3,)."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, translation
    return result


def upright(x: float, y: float, z: float, heading: float) -> np.ndarray:
    """stage_from_object (4, 4) of an object that stands, turned about the vertical."""
    cos, sin = np.cos(heading), np.sin(heading)
    return transform(np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]), np.array([x, y, z]))


def held_object(
    puppet: Puppet,
    world: np.ndarray,
    pelvis: np.ndarray,
    side: int,
    object_from_wrist: np.ndarray,
) -> np.ndarray:
    """stage_from_object (N, 4, 4) of what a hand holds: the posed wrist's own place decides."""
    wrist = np.broadcast_to(np.eye(4), (len(world), 4, 4)).copy()
    index = puppet.hands[side].wrist
    wrist[:, :3, :3] = world[:, index]
    wrist[:, :3, 3] = puppet.skeleton.forward(world, pelvis)[:, index]
    return wrist @ invert(object_from_wrist)
