"""Base class of all scripts: puppet, true object, furniture and times.

Conventions of all scripts:

- Numbers without a comment are choreography, set by eye: metres, radians, and seconds of script
  time in :func:`.ramp`, :func:`.bump`, :func:`.plateau`, steps and guides.
- Columns 0, 1, 2 of ``Trunk.bend`` and ``Trunk.head`` are rotations about the person's left, up and
  forward axes. Positive values bend forward, turn to the left and lean to the right.
- ``world[:, 9]`` is the rotation of the chest (joint spine3). Its columns are the directions to the
  person's left, up and ahead.
- Frame of a script: z up, the floor at z = 0, a person with heading 0 faces +x.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from intercap_core.geometry.camera.transforms import invert, rigid
from intercap_core.studio.controls import Footwork, Guide, Step, Wander
from intercap_core.studio.motion import Puppet, Trunk
from intercap_core.studio.objects import TrueObject
from intercap_core.studio.room import Box
from intercap_core.studio.skeleton import about_z

SCRIPT_S = 3.0  # length of a script; longer recordings play it slower


@dataclass(frozen=True)
class Performance:
    """State at N moments of a script, script frame, metres."""

    world: np.ndarray
    """(N, 55, 3, 3) script_from_rest rotations of SMPL-X's joints."""
    pelvis: np.ndarray
    """(N, 3) positions of the pelvis joint."""
    script_from_object: np.ndarray
    """(N, 4, 4) object poses; NaN without an object."""


@dataclass
class Interaction(ABC):
    """Script for one person and one object; ``object_class`` is "" without an object.

    Script time runs from 0 to ``SCRIPT_S``. The script's frame has z up and the floor at z = 0.
    """

    puppet: Puppet
    """The person."""
    prop: TrueObject
    """The object; false in a condition if there is none."""
    rng: np.random.Generator
    """Source of the script's random variations."""
    furniture: list[Box] = field(default_factory=list)
    """Furniture that ``plan`` places, script frame."""
    object_class = ""
    feet_meet_object = False  # soles or insteps touch the object
    leaves_floor = False  # the feet stand on furniture
    highlight = SCRIPT_S / 2  # short recordings show the script around this time
    centre = (0.0, 0.0)  # middle of the action on the floor, script frame

    def __post_init__(self) -> None:
        self.sway = Wander(6, 0.010, self.rng)  # rad; columns: trunk's bend, head's bend
        self.weight_shift = Wander(3, 0.0025, self.rng)  # metres, pelvis
        self.arm_swing = Wander(2, 0.006, self.rng)  # metres forward, of two hands
        self.plan()

    @abstractmethod
    def plan(self) -> None:
        """Choose places, times and grasps."""

    @abstractmethod
    def perform(self, times: np.ndarray) -> Performance:
        """Play the script at script times (N,), in any order."""

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

    def standing(self, times: np.ndarray, *, bend: float = 0.6, head: float = 1.3) -> Trunk:
        """Trunk over the feet that shifts its weight and sways, scaled by ``bend`` and ``head``."""
        track, sway = self.pelvis_track(times), self.sway(times)
        pelvis = track[:, :3] + self.weight_shift(times)
        return Trunk(pelvis, track[:, 3], bend * sway[:, :3], head * sway[:, 3:])

    def on_feet(self, trunk: Trunk, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (N, 55, 3, 3) and pelvis (N, 3) of a trunk on legs that follow the footwork."""
        feet = self.footwork.feet(times)
        trunk = self.puppet.settled(trunk, feet[0])
        world = self.puppet.trunk(trunk)
        self.puppet.legs(world, trunk.pelvis, *feet)
        return world, trunk.pelvis

    def script_times(self, times: np.ndarray, duration: float) -> np.ndarray:
        """Script times of recording times (N,), seconds from its first set.

        A recording longer than the script slows it down; a shorter one shows the part around
        the highlight at natural speed.
        """
        if duration >= SCRIPT_S:
            return times * (SCRIPT_S / duration)
        return times + np.clip(self.highlight - duration / 2, 0, SCRIPT_S - duration)


def upright(x: float, y: float, z: float, heading: float) -> np.ndarray:
    """script_from_object (4, 4) of an object that stands, turned about the vertical."""
    return rigid(about_z(heading), np.array([x, y, z]))


def shifted(pose: np.ndarray, by: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """Poses (..., 4, 4) moved by metres (..., 3)."""
    return rigid(pose[..., :3, :3], pose[..., :3, 3] + by)


def held_object(
    puppet: Puppet, world: np.ndarray, pelvis: np.ndarray, side: int, object_from_wrist: np.ndarray
) -> np.ndarray:
    """script_from_object (N, 4, 4) of an object in the hand, from the posed wrist.

    ``object_from_wrist``: (4, 4) or (N, 4, 4).
    """
    index = puppet.hands[side].wrist
    wrist = rigid(world[:, index], puppet.skeleton.forward(world, pelvis)[:, index])
    return wrist @ invert(object_from_wrist)
