"""A person alone: walk up, turn to the side, raise a hand and wave it."""

from __future__ import annotations

import numpy as np

from intercap_core.studio.controls import Footwork, Pose, Step, plateau
from intercap_core.studio.hands import RELAXED, shape
from intercap_core.studio.interactions.base import SCRIPT_S, Interaction, Performance
from intercap_core.studio.motion import LEG_REACH, Trunk
from intercap_core.studio.skeleton import unit

LEFT, RIGHT = 0, 1
RAISED_S = (1.05, 1.65, 2.55, 3.05)  # the hand goes up, is up, goes down, is down
WAVE_HZ, WAVE_M = 1.6, 0.09  # of the raised hand, to the sides
FLAT = shape((4, 2, 2), (8, 3, -8), 10, 0)


class WalkAndWave(Interaction):
    """Four steps with swinging arms, two of them into a turn, then one hand up."""

    highlight = 1.5
    centre = (0.0, 0.0)

    def plan(self) -> None:
        rng, puppet = self.rng, self.puppet
        self.side = int(rng.integers(2))
        stride, turned = rng.uniform(0.40, 0.48), rng.uniform(0.5, 1.0) * rng.choice((-1.0, 1.0))
        self.turned = turned
        w = puppet.hip_width * 0.95
        across = np.array([-np.sin(turned), np.cos(turned)])
        end = np.array([stride * 0.9, 0.0])
        start = np.array([[-2 * stride, w], [-2 * stride + 0.04, -w]])
        steps = [
            Step(RIGHT, 0.05, 0.46, (-stride, -w)),
            Step(LEFT, 0.44, 0.86, (0.0, w)),
            Step(RIGHT, 0.84, 1.28, tuple(end - w * across), turned),
            Step(LEFT, 1.26, 1.66, tuple(end + w * across), turned),
        ]
        self.footwork = Footwork(start, 0.0, steps, puppet.ankle_height, SCRIPT_S)
        self.pelvis_track = self.footwork.pelvis(
            LEG_REACH * puppet.leg, puppet.hip_width, puppet.hip_drop, puppet.stand
        )

    def _trunk(self, times: np.ndarray) -> Trunk:
        track, sway = self.pelvis_track(times), self.sway(times)
        pelvis = track[:, :3] + self.weight_shift(times)
        pelvis[:, 2] -= 0.01
        bend, head = 0.6 * sway[:, :3], 1.3 * sway[:, 3:]
        bend[:, 0] += 0.03
        head[:, 0] += 0.05
        head[:, 1] += 0.3 * np.sign(self.turned) * plateau(times, 0.5, 0.9, 1.4, 1.8)
        return Trunk(pelvis, track[:, 3], bend, head)

    def _waving(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> Pose:
        """The raised wrist (N), the palm ahead."""
        puppet, sign = self.puppet, (1.0, -1.0)[self.side]
        left, up, ahead = (world[:, 9, :, axis] for axis in range(3))
        wave = WAVE_M * np.sin(2 * np.pi * WAVE_HZ * (times - RAISED_S[1]))[:, None]
        place = puppet.arm_root(world, pelvis, self.side) + puppet.arm * (
            0.32 * sign * left + 0.48 * up + 0.42 * ahead
        )
        fingers = unit(up + (wave / puppet.arm) * left + 0.15 * ahead)
        rotation = puppet.wrist_rotation(self.side, fingers, unit(ahead - 0.15 * up))
        return Pose(place + wave * left, rotation)

    def perform(self, times: np.ndarray) -> Performance:
        puppet, feet = self.puppet, self.footwork.feet(times)
        trunk = puppet.settled(self._trunk(times), feet[0])
        world, pelvis = puppet.trunk(trunk), trunk.pelvis
        puppet.legs(world, pelvis, *feet)
        up = plateau(times, *RAISED_S)
        walking = plateau(times, -0.4, 0.1, 1.1, 1.5)
        stride = 0.13 * walking * np.sin(2 * np.pi * (times - 0.05) / 0.82)
        for side, sign in ((LEFT, 1.0), (RIGHT, -1.0)):
            swing = sign * stride + self.arm_swing(times)[:, side]
            wrist, raised = puppet.idle_wrist(world, pelvis, side, swing), np.zeros(len(times))
            keys = []
            if side == self.side:
                wrist, raised = wrist.towards(self._waving(world, pelvis, times), up), 0.3 * up
                keys = [(up, FLAT)]
            puppet.arm_to(world, pelvis, side, wrist, raised)
            puppet.fingers(world, side, puppet.finger_track(side, RELAXED, keys))
        return Performance(world, pelvis, np.full((len(times), 4, 4), np.nan))
