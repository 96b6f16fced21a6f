"""Step up to a ball, put the sole on it, swing back, kick it; it rolls until it stops.

Conventions of numbers, columns and frames: :mod:`.base`.
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.camera.transforms import rotation_exp
from intercap_core.studio.controls import Guide, Step, bisect, bump, plateau, ramp
from intercap_core.studio.interactions.base import SCRIPT_S, Interaction, Performance
from intercap_core.studio.motion import LEFT, RIGHT, Foot, Trunk, moved, still
from intercap_core.studio.skeleton import unit


class FootballKick(Interaction):
    """The ball lies before the right foot and leaves about ahead."""

    object_class = "football"
    feet_meet_object = True
    highlight = 1.7
    centre = (0.50, -0.05)
    sole_s = 0.80  # the sole comes to rest on the ball, script time
    sole_off_s = 1.02  # the sole leaves the ball, script time
    swing_s = 1.28  # start of the kicking swing, script time
    swung_s = 2.00  # end of the kicking swing, script time
    pressed_m = 0.001  # depth to which the ball presses the skin, metres
    hover_share = 0.35  # share of the recordings in which the sole stops short of the ball
    hover_m = (0.006, 0.016)  # range of the gap between sole and ball in them, metres
    toe_clear_m = 0.012  # toes above the floor as the foot swings through, metres
    backswing_m = 0.27  # ankle behind the place where it meets the ball, metres
    through_m = 0.37  # ankle beyond that place at the end of the swing, metres
    integration_s = 0.004  # time step of the rolling ball
    near_m = 0.01  # from farther off, the ball is treated as a sphere, metres
    gravity = 9.81  # m/s^2
    sliding_friction = (0.40, 0.55)  # coefficient of a ball on a hard floor
    rolling_friction = (0.13, 0.18)  # coefficient on a thick carpet
    spin_up = 1.5  # m r^2 over the moment of inertia of a thin shell

    def plan(self) -> None:
        rng, puppet = self.rng, self.puppet
        self.radius = float(np.linalg.norm(self.prop.vertices, axis=1).mean())
        self.first_turn = rotation_exp(unit(rng.normal(size=3)) * rng.uniform(0, np.pi))
        lowest = float((self.prop.vertices @ self.first_turn[2]).min())
        self.spot = np.array([0.24 + rng.uniform(0, 0.04), -puppet.hip_width, -lowest])
        direction = rng.normal(0, 0.06)
        self.ahead = np.array([np.cos(direction), np.sin(direction), 0.0])
        sole_gap = (
            rng.uniform(*self.hover_m) if rng.random() < self.hover_share else -self.pressed_m
        )
        sliding, rolling = rng.uniform(*self.sliding_friction), rng.uniform(*self.rolling_friction)
        self.foot = Foot(puppet, RIGHT)
        self._footwork(sole_gap)
        self._roll(self.gravity * sliding, self.gravity * rolling)

    def _gap(self, skin: np.ndarray, rolled: float = 0.0) -> float:
        """Least signed distance of skin (n, 3) to the ball that was moved by ``rolled`` metres."""
        local = (skin - self.spot - rolled * self.ahead) @ self.first_turn
        far = float(np.linalg.norm(local, axis=1).min()) - self.radius
        return far if far > self.near_m else float(self.prop.surface.signed_distance(local).min())

    def _pushed(self, skin: np.ndarray, rolled: float) -> float:
        """Distance, metres, of the ball from its first place after the foot has pushed it away."""
        if self._gap(skin, rolled) >= -self.pressed_m:
            return rolled
        return bisect(
            rolled, rolled + 0.02, 10, lambda way: self._gap(skin, way) < -self.pressed_m
        )[1]

    def _footwork(self, sole_gap: float) -> None:
        """Plan the steps and the right foot's path; ``sole_gap`` is between sole and ball, metres.

        Places of a foot are ankle x, y, z, pitch (positive: toes down) and heading.
        """
        puppet, w, (x, y, _) = self.puppet, self.puppet.hip_width, self.spot
        sole = puppet.ankle_height[RIGHT]
        on_ball = np.array([x - 0.11, y, self.radius, -0.10, 0.0])
        on_ball = self.foot.backed_off(on_ball, np.array([0, 0, 0.4, 0, 0]), sole_gap, self._gap)
        strike = np.array([x, y - 0.01, 0.5, 0.62, 0.0])
        strike[2] += self.toe_clear_m - self.foot.skin(strike[None])[0, :, 2].min()
        self.strike = self.foot.backed_off(strike, np.array([-0.5, 0, 0, 0, 0]), 0.0, self._gap)
        self.back = moved(self.strike, -self.backswing_m, 0, sole + 0.20 - self.strike[2], 0.12)
        self.through = moved(self.strike, self.through_m, 0.03, sole + 0.17 - self.strike[2], -0.1)
        ankle_x = self.strike[0] + 0.03
        start = np.array([[ankle_x - 0.36, w], [ankle_x - 0.30, -w]])
        steps = [
            Step(LEFT, 0.02, 0.38, (ankle_x, w)),
            Step(RIGHT, 0.28, 2.50, (ankle_x + 0.17, -w)),
        ]
        over = moved(on_ball, 0, 0, 0.06)
        guides = [
            Guide(RIGHT, 0.26, 0.58, still(moved(over, -0.16, 0, 0.02, 0.2))),
            Guide(RIGHT, 0.46, 0.74, still(over)),
            Guide(RIGHT, 0.66, self.sole_s, still(on_ball)),
            Guide(RIGHT, self.sole_off_s, 1.16, still(over)),
            Guide(RIGHT, 1.04, 1.38, self._swing),
            Guide(RIGHT, self.swung_s - 0.08, 2.50),
        ]
        self.walk(start, steps, guides=guides)

    def _swing(self, times: np.ndarray) -> np.ndarray:
        """The kicking foot (N, 5): from behind down to the ball and up again beyond it."""
        share = ramp(times, self.swing_s, self.swung_s)
        met = self.backswing_m / (self.backswing_m + self.through_m)
        path = self.back + share[:, None] * (self.through - self.back)
        straight = self.back + met * (self.through - self.back)
        beyond = (share - met) / np.where(share < met, met, 1 - met)
        low = (1 + np.cos(np.pi * beyond)) / 2
        path[:, 1:4] += low[:, None] * (self.strike - straight)[1:4]
        return path

    def _roll(self, sliding: float, rolling: float) -> None:
        """Integrate how far the ball has moved, metres, and turned, rad, at the times ``clock``.

        Each step applies friction with the floor, which slows the ball and spins it up until it
        rolls. Then the foot pushes the ball out of the way, and the ball gets at least the speed
        of the push. ``sliding`` and ``rolling`` are the decelerations by friction, m/s^2.
        """
        self.clock = np.arange(self.swing_s, SCRIPT_S + 1.0, self.integration_s)
        self.moved, self.turned = np.zeros((2, len(self.clock)))
        swing = self.clock[self.clock < self.swung_s]
        skin = self.foot.skin(self._swing(swing))
        speed = spin = 0.0
        for n in range(1, len(self.clock)):
            slips = spin * self.radius < speed - 1e-9
            speed = max(speed - (sliding if slips else rolling) * self.integration_s, 0.0)
            spin = min(
                spin + self.spin_up * sliding / self.radius * self.integration_s,
                speed / self.radius,
            )
            if n < len(swing):
                pushed = self._pushed(skin[n], self.moved[n - 1]) - self.moved[n - 1]
                speed = max(speed, pushed / self.integration_s)
            self.moved[n] = self.moved[n - 1] + speed * self.integration_s
            self.turned[n] = self.turned[n - 1] + spin * self.integration_s

    def _ball(self, times: np.ndarray) -> np.ndarray:
        """script_from_object (N, 4, 4): the lowest point of the ball is on the floor."""
        pose = np.broadcast_to(np.eye(4), (len(times), 4, 4)).copy()
        axis = np.cross([0, 0, 1.0], self.ahead)
        turned = np.interp(times, self.clock, self.turned)
        pose[:, :3, :3] = rotation_exp(turned[:, None] * axis) @ self.first_turn
        moved = np.interp(times, self.clock, self.moved)
        pose[:, :2, 3] = (self.spot + moved[:, None] * self.ahead)[:, :2]
        pose[:, 2, 3] = -(pose[:, 2, :3] @ self.prop.vertices.T).min(1)
        return pose

    def _trunk(self, times: np.ndarray) -> Trunk:
        """Trunk (N): bends forward and turns right in the backswing, turns left in the kick."""
        trunk = self.standing(times)
        pelvis, bend, head = trunk.pelvis, trunk.bend, trunk.head
        back = bump(times, 1.05, 1.62)
        kick = plateau(times, 1.40, 1.75, 1.85, 2.40)
        pelvis[:, 0] += 0.05 * back
        pelvis[:, 1] += 0.03 * plateau(times, 0.30, 0.60, 2.10, 2.50)
        pelvis[:, 2] -= 0.015 + 0.02 * (back + kick)
        bend[:, 0] += 0.04 + 0.16 * back - 0.05 * kick
        bend[:, 1] += -0.20 * back + 0.18 * kick
        bend[:, 2] -= 0.05 * plateau(times, 0.30, 0.60, 2.10, 2.50)
        head[:, 0] += 0.48 - 0.22 * ramp(times, 1.80, 2.60)
        return trunk

    def perform(self, times: np.ndarray) -> Performance:
        world, pelvis = self.on_feet(self._trunk(times), times)
        back = bump(times, 1.00, 1.66)
        kick = plateau(times, 1.42, 1.80, 1.85, 2.50)
        balance = plateau(times, 0.30, 0.70, 2.00, 2.60)
        for side, sign in ((LEFT, 1.0), (RIGHT, -1.0)):
            swing = sign * (0.16 * back - 0.20 * kick) + self.arm_swing(times)[:, side]
            out = (0.10 * balance)[:, None] * np.array([0, sign, 0])
            out[:, 2] += 0.05 * balance
            self.puppet.swing_arm(world, pelvis, side, swing, out)
        return Performance(world, pelvis, self._ball(times))
