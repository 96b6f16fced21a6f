"""Scripts without an object: balance along a beam; walk up and wave a hand.

Conventions of numbers, columns and frames: :mod:`.base`.
"""

from __future__ import annotations

import numpy as np

from intercap_core.studio.controls import PoseTrack, Step, plateau
from intercap_core.studio.hands import shape
from intercap_core.studio.interactions.base import Interaction, Performance
from intercap_core.studio.motion import LEFT, RIGHT, SIDES, Foot, Trunk
from intercap_core.studio.room import Box
from intercap_core.studio.skeleton import unit


class BeamWalk(Interaction):
    """Two steps up, two along, two down; the beam lies along x, its middle at the origin."""

    leaves_floor = True
    highlight = 1.3
    centre = (0.0, 0.0)
    beam_half_m = 0.05  # half the beam's width, metres
    beam_height_m = (0.15, 0.30)  # range, metres
    stride_m = (0.32, 0.38)  # range along the beam, metres
    toe_gap_m = 0.10  # from the toes on the floor to the beam's end, metres
    margin_m = 0.06  # from heels and toes on the beam to its ends, metres
    aside_m = 0.11  # sideways detour of a foot around the standing foot, metres
    # start and end of each step, script time
    step_s = ((0.05, 0.52), (0.50, 0.94), (0.92, 1.32), (1.30, 1.70), (1.68, 2.18), (2.16, 2.60))

    def plan(self) -> None:
        rng, puppet = self.rng, self.puppet
        self.height = float(rng.uniform(*self.beam_height_m))
        stride, first = rng.uniform(*self.stride_m), int(rng.integers(2))
        heel, toe = self._soles()
        length = heel + toe + 3 * stride + 2 * self.margin_m
        low = -length / 2
        self.furniture.append(
            Box((low, -self.beam_half_m, 0.0), (-low, self.beam_half_m, self.height), 0.0, "wood")
        )
        w = puppet.hip_width * 0.9
        sides = np.array([w, -w])
        before, after = low - self.toe_gap_m - toe, -low + self.toe_gap_m + heel
        start = np.stack([np.full(2, before) + rng.normal(0, 0.01, 2), sides], 1)
        steps = []
        for count, (begin, end) in enumerate(self.step_s):
            foot = first if count % 2 == 0 else 1 - first
            if count < 4:
                x = low + self.margin_m + heel + count * stride
                place = (float(x), float(rng.normal(0, 0.005)))
                aside = self.aside_m if count else 0.0
                steps.append(Step(foot, begin, end, place, 0.0, self.height, aside))
            else:
                place = (float(after + rng.uniform(0, 0.03)), float(sides[foot]))
                steps.append(Step(foot, begin, end, place, 0.0, 0.0, self.aside_m))
        self.walk(start, steps)

    def _soles(self) -> tuple[float, float]:
        """How far heels and toes reach behind and ahead of the ankles, metres."""
        level = np.zeros((1, 5))
        skins = [Foot(self.puppet, side).skin(level)[0] for side in range(len(SIDES))]
        return (
            max(float(-skin[:, 0].min()) for skin in skins),
            max(float(skin[:, 0].max()) for skin in skins),
        )

    def _trunk(self, times: np.ndarray, balance: np.ndarray) -> Trunk:
        track, sway = self.pelvis_track(times), self.sway(times)
        pelvis = track[:, :3] + self.weight_shift(times)
        pelvis[:, 2] -= 0.01
        unsteady = 1 + 2.5 * balance[:, None]
        bend, head = 0.6 * unsteady * sway[:, :3], 1.3 * sway[:, 3:]
        bend[:, 0] += 0.04
        head[:, 0] += 0.12 + 0.22 * balance  # the person looks down
        return Trunk(pelvis, track[:, 3], bend, head)

    def perform(self, times: np.ndarray) -> Performance:
        puppet, balance = self.puppet, plateau(times, 0.2, 0.7, 1.9, 2.5)
        world, pelvis = self.on_feet(self._trunk(times, balance), times)
        swing = self.arm_swing(times)
        for side, sign in ((LEFT, 1.0), (RIGHT, -1.0)):
            outward = sign * world[:, 9, :, 0] * (1, 1, 0)  # to the chest's (spine3) side, level
            # on the beam the wrists go 26 cm out and 16 cm up, and bob by four times their swing
            out = balance[:, None] * (0.26 * outward + (0, 0, 0.16))
            unsteady = 4 * balance[:, None] * swing[:, [side]] * (0, 0, 1)
            puppet.swing_arm(world, pelvis, side, swing[:, side], out, unsteady)
        return Performance(world, pelvis, np.full((len(times), 4, 4), np.nan))


WAVING = shape((4, 2, 2), (8, 3, -8), 10, 0)  # straight, closed fingers


class WalkAndWave(Interaction):
    """Four steps with swinging arms, two of them into a turn, then one hand up."""

    highlight = 1.5
    centre = (0.0, 0.0)
    # start and end of raising and of lowering the hand, script time
    raised_s = (1.05, 1.65, 2.55, 3.05)
    wave_hz = 1.6  # frequency of the wave
    wave_m = 0.09  # amplitude of the wave to the sides, metres

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
        self.walk(start, steps)

    def _trunk(self, times: np.ndarray) -> Trunk:
        trunk = self.standing(times)
        trunk.pelvis[:, 2] -= 0.01
        trunk.bend[:, 0] += 0.03
        trunk.head[:, 0] += 0.05
        trunk.head[:, 1] += 0.3 * np.sign(self.turned) * plateau(times, 0.5, 0.9, 1.4, 1.8)
        return trunk

    def _waving(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> PoseTrack:
        """Poses (N) of the raised wrist, the palm facing ahead."""
        puppet, sign = self.puppet, (1.0, -1.0)[self.side]
        left, up, ahead = (world[:, 9, :, axis] for axis in range(3))
        wave = self.wave_m * np.sin(2 * np.pi * self.wave_hz * (times - self.raised_s[1]))[:, None]
        place = puppet.shoulder(world, pelvis, self.side) + puppet.arm * (
            0.32 * sign * left + 0.48 * up + 0.42 * ahead
        )
        fingers = unit(up + (wave / puppet.arm) * left + 0.15 * ahead)
        rotation = puppet.wrist_rotation(self.side, fingers, unit(ahead - 0.15 * up))
        return PoseTrack(place + wave * left, rotation)

    def perform(self, times: np.ndarray) -> Performance:
        puppet = self.puppet
        world, pelvis = self.on_feet(self._trunk(times), times)
        up = plateau(times, *self.raised_s)
        walking = plateau(times, -0.4, 0.1, 1.1, 1.5)
        # arms swing by 13 cm; one period is two steps (0.82 s) and begins with the first
        stride = 0.13 * walking * np.sin(2 * np.pi * (times - 0.05) / 0.82)
        for side, sign in ((LEFT, 1.0), (RIGHT, -1.0)):
            swing = sign * stride + self.arm_swing(times)[:, side]
            wrist, raised = puppet.idle_wrist(world, pelvis, side, swing), np.zeros(len(times))
            keys = []
            if side == self.side:
                wrist, raised = wrist.towards(self._waving(world, pelvis, times), up), 0.3 * up
                keys = [(up, WAVING)]
            puppet.arm_to(world, pelvis, side, wrist, raised)
            puppet.fingers(world, side, puppet.finger_track(side, keys))
        return Performance(world, pelvis, np.full((len(times), 4, 4), np.nan))
