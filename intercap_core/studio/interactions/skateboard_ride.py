"""Put one foot on a skateboard, push off with the other, ride until it stops, step off.

Conventions of numbers, columns and frames: :mod:`.base`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from intercap_core.studio.controls import Guide, Step, plateau, ramp
from intercap_core.studio.interactions.base import Interaction, Performance, upright
from intercap_core.studio.motion import LEFT, RIGHT, Foot, Trunk, moved, still


class SkateboardRide(Interaction):
    """The board rolls along x, to either side; the person stands behind its long side."""

    object_class = "skateboard"
    feet_meet_object = True
    highlight = 1.5
    push_s = 0.80  # start of the push, script time
    pushed_s = 1.02  # end of the push, script time
    stop_s = 2.15  # the board stops, script time
    speed_m_s = (0.85, 1.15)  # range of the speed after the push
    stance_m = 0.16  # each foot from the board's middle, metres
    turned_rad = 0.52  # the person turns this far towards the rolling direction
    pressed_m = 0.002  # depth to which the deck presses the sole, metres
    hover_share = 0.35  # share of the recordings in which the first foot stops short of the deck
    hover_m = (0.006, 0.016)  # range of the gap in them, metres
    aside_m = 0.34  # the feet on the floor from the board's middle line, metres
    lift_m = 0.08  # a foot above the deck before and after it stands there, metres

    def plan(self) -> None:
        rng, puppet = self.rng, self.puppet
        self.way = float(rng.choice((-1, 1)))  # the right foot is in front on the way to +x
        self.front = RIGHT if self.way > 0 else LEFT
        self.flipped = float(rng.choice((0.0, np.pi)))
        speed = rng.uniform(*self.speed_m_s)
        self.speed = speed
        self.rolled_m = speed * (self.stop_s - self.push_s) / 2
        self.centre = (self.way * self.rolled_m / 2, -0.10)
        heading = np.pi / 2 - self.way * self.turned_rad + rng.normal(0, 0.05)
        height = self.prop.standing_height
        self.board = upright(0.0, 0.0, height, self.flipped + rng.normal(0, 0.01))
        self.on_deck = [self._on_deck(side, heading) for side in (LEFT, RIGHT)]
        hover = rng.uniform(*self.hover_m) if rng.random() < self.hover_share else 0.0
        steps, guides, start = [], [], np.empty((2, 2))
        w = puppet.hip_width
        for side, sign in ((LEFT, -1.0), (RIGHT, 1.0)):
            behind = np.array([1.1 * w * sign, -self.aside_m + 0.02 * rng.random()])
            start[side] = behind
            shift = np.array([self.way * self.rolled_m, 0.0]) + rng.normal(0, (0.02, 0.01))
            last = behind + shift
            steps.append(Step(side, 1.30, 1.70, (float(last[0]), float(last[1])), heading))
            guides += self._guides(side, hover)
        self.walk(start, steps, heading=heading, guides=guides)

    def _on_deck(self, side: int, heading: float) -> np.ndarray:
        """The place of a foot that stands on the board, its sole lightly pressed.

        Places (5,) are ankle x, y, z, pitch and heading.
        """
        foot = Foot(self.puppet, side)
        sign = (-1.0, 1.0)[side]
        ahead = np.array([np.cos(heading), np.sin(heading)])
        at = np.array([self.stance_m * sign, 0.0]) - 0.05 * ahead
        place = np.array([*at, self.board[2, 3], 0.0, heading])

        def distance(skin: np.ndarray) -> float:
            local = (skin - self.board[:3, 3]) @ self.board[:3, :3]
            return float(self.prop.surface.signed_distance(local).min())

        return foot.backed_off(place, np.array([0, 0, 0.4, 0, 0]), -self.pressed_m, distance)

    def _guides(self, side: int, hover: float) -> list[Guide]:
        """From the floor over the deck's edge, onto the deck, and back."""
        on = self.on_deck[side]
        ride, over, up = (
            self._along(place)
            for place in (
                on,
                moved(on, 0, -0.13, self.lift_m, 0.1),
                moved(on, 0, -0.26, self.lift_m, 0.2),
            )
        )
        if side == self.front:
            late = 0.20 if hover else 0.0
            guides = [Guide(side, 0.04, 0.30, up), Guide(side, 0.20, 0.44, over)]
            if hover:
                guides.append(
                    Guide(side, 0.34, 0.54, still(moved(on, 0, 0, self.pressed_m + hover)))
                )
            guides.append(Guide(side, 0.38 + late, 0.62 + late, ride))
            leave = 2.54
        else:
            guides = [Guide(side, 0.82, 1.02, up), Guide(side, 0.93, 1.16, over)]
            guides.append(Guide(side, 1.10, 1.32, ride))
            leave = 2.16
        return [
            *guides,
            Guide(side, leave, leave + 0.22, over),
            Guide(side, leave + 0.12, leave + 0.34, up),
            Guide(side, leave + 0.24, leave + 0.48),
        ]

    def _rolled(self, times: np.ndarray) -> np.ndarray:
        """Distance (N,), metres, rolled with constant acceleration, then constant deceleration."""
        pushed = np.clip(times - self.push_s, 0, self.pushed_s - self.push_s)
        slowed = np.clip(times - self.pushed_s, 0, self.stop_s - self.pushed_s)
        first = self.speed * pushed**2 / (2 * (self.pushed_s - self.push_s))
        return first + self.speed * (slowed - slowed**2 / (2 * (self.stop_s - self.pushed_s)))

    def _along(self, place: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """A place (5,) that moves with the board."""
        return lambda times: place + (self.way * self._rolled(times))[:, None] * np.eye(5)[0]

    def _trunk(self, times: np.ndarray) -> Trunk:
        ankle, _, _ = self.footwork.feet(times)
        trunk = self.standing(times, bend=0.8)
        pelvis, bend, head = trunk.pelvis, trunk.bend, trunk.head
        ride = plateau(times, 0.70, 1.20, 2.00, 2.60)
        on_front = plateau(times, 0.72, 0.95, 1.08, 1.34) + plateau(times, 2.02, 2.25, 2.45, 2.68)
        on_back = plateau(times, 0.0, 0.12, 0.36, 0.62) + plateau(times, 2.46, 2.66, 2.84, 3.06)
        middle = ankle.mean(1)
        front, back = ankle[:, self.front], ankle[:, 1 - self.front]
        lean = on_front[:, None] * (front - middle) + on_back[:, None] * (back - middle)
        pelvis[:, :2] += 0.6 * lean[:, :2]
        pelvis[:, 2] -= 0.01 + 0.05 * ride
        bend[:, 0] += 0.06 + 0.14 * ride
        head[:, 0] += 0.40 - 0.22 * ride
        head[:, 1] -= 0.45 * self.way * ride
        return trunk

    def perform(self, times: np.ndarray) -> Performance:
        world, pelvis = self.on_feet(self._trunk(times), times)
        balance = 0.3 * ramp(times, 0.1, 0.5) + 0.7 * plateau(times, 0.7, 1.1, 2.2, 2.9)
        for side, sign in ((LEFT, 1.0), (RIGHT, -1.0)):
            outward = sign * world[:, 9, :, 0] * (1, 1, 0)
            out = balance[:, None] * (0.20 * outward + (0, 0, 0.12))
            self.puppet.swing_arm(world, pelvis, side, self.arm_swing(times)[:, side], out)
        pose = np.broadcast_to(self.board, (len(times), 4, 4)).copy()
        pose[:, 0, 3] += self.way * self._rolled(times)
        return Performance(world, pelvis, pose)
