"""Curves of which the studio's interactions are made: ramps, plateaus, footsteps, small sway.

Everything is a smooth function of script time in seconds, vectorised over moments (N,). Positions
are in the script's frame (z up, the floor at z = 0), in metres. Headings turn about z, 0 faces +x.
Numbers without a comment shape the motion and are set by eye.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from intercap_core.geometry.camera.transforms import rigid
from intercap_core.studio.skeleton import blend


def ramp(times: np.ndarray, start: float, end: float) -> np.ndarray:
    """0 before ``start``, 1 after ``end``, minimum jerk between (Flash and Hogan 1985)."""
    u = np.clip((np.asarray(times, float) - start) / max(end - start, 1e-9), 0, 1)
    return u**3 * (10 - 15 * u + 6 * u * u)


def bump(times: np.ndarray, start: float, end: float) -> np.ndarray:
    """0 outside, 1 in the middle, smooth: sin^2 of the share of time that has passed."""
    u = np.clip((np.asarray(times, float) - start) / max(end - start, 1e-9), 0, 1)
    return np.sin(np.pi * u) ** 2


def plateau(times: np.ndarray, start: float, full: float, wane: float, end: float) -> np.ndarray:
    """Rises from ``start`` to ``full``, holds, falls from ``wane`` to ``end``."""
    return ramp(times, start, full) - ramp(times, wane, end)


def bisect(
    low: float, high: float, steps: int, is_below: Callable[[float], bool]
) -> tuple[float, float]:
    """Bounds of the value at which ``is_below`` changes from True to False, halved ``steps`` times.

    ``is_below`` is taken to be True at ``low`` and False at ``high``.
    """
    for _ in range(steps):
        middle = (low + high) / 2
        if is_below(middle):
            low = middle
        else:
            high = middle
    return low, high


class Wander:
    """Involuntary motion: a sum of slow sines with random phases.

    Args:
        channels: number of independent values.
        size: RMS of each value, in the caller's unit.
    """

    frequencies = np.array((0.23, 0.41, 0.67, 1.13))  # Hz

    def __init__(self, channels: int, size: float, rng: np.random.Generator) -> None:
        shape = (channels, len(self.frequencies))
        self._phase = rng.uniform(0, 2 * np.pi, shape)
        weight = rng.uniform(0.5, 1.5, shape) / self.frequencies
        weight /= np.linalg.norm(weight, axis=1, keepdims=True)
        self._weight = weight * np.sqrt(2) * size

    def __call__(self, times: np.ndarray) -> np.ndarray:
        """(N,) -> (N, channels)."""
        angle = 2 * np.pi * np.asarray(times)[:, None, None] * self.frequencies
        return (np.sin(angle + self._phase) * self._weight).sum(-1)


@dataclass(frozen=True)
class PoseTrack:
    """Rigid poses of a wrist or an object over N moments, script frame."""

    position: np.ndarray
    """(N, 3) metres, or (3,) if constant."""
    rotation: np.ndarray
    """(N, 3, 3), of a wrist from the T-pose; (3, 3) if constant."""

    @property
    def matrices(self) -> np.ndarray:
        """(N, 4, 4)."""
        return rigid(self.rotation, self.position)

    @classmethod
    def of(cls, matrices: np.ndarray) -> PoseTrack:
        """From (N, 4, 4) or a constant pose (4, 4)."""
        return cls(matrices[..., :3, 3], matrices[..., :3, :3])

    def towards(
        self, goal: PoseTrack, share: np.ndarray, arc: np.ndarray | None = None
    ) -> PoseTrack:
        """Move to ``goal`` by ``share`` (N,), with a detour of ``arc`` (3,) metres halfway."""
        s = share[:, None]
        position = (1 - s) * self.position + s * goal.position
        if arc is not None:
            position = position + 4 * s * (1 - s) * arc
        return PoseTrack(position, blend(self.rotation, goal.rotation, share))

    def through(self, times: np.ndarray, *goals: tuple[Any, ...]) -> PoseTrack:
        """Move to each goal in turn.

        Args:
            times: (N,) script times.
            goals: track or constant pose (4, 4), start and end of the motion to it, and optionally
                its detour as in :meth:`towards`.
        """
        track = self
        for goal, start, end, *arc in goals:
            goal = goal if isinstance(goal, PoseTrack) else PoseTrack.of(goal)
            track = track.towards(goal, ramp(times, start, end), *arc)
        return track


@dataclass(frozen=True)
class Step:
    """One step of a foot."""

    foot: int
    """0 left, 1 right."""
    start: float
    """Seconds."""
    end: float
    """Seconds."""
    place: tuple[float, float]
    """x, y of the ankle at the end, metres."""
    heading: float = 0.0
    """Heading of the foot at the end, rad."""
    height: float = 0.0
    """Of the support above the floor, metres."""
    aside: float = 0.0
    """Sideways detour, around the support of the other foot, metres."""


@dataclass(frozen=True)
class Guide:
    """A foot that leaves its steps: it blends into ``path`` and then follows it."""

    foot: int
    """0 left, 1 right."""
    start: float
    """Start of the blend, seconds."""
    end: float
    """End of the blend, seconds."""
    path: Callable[[np.ndarray], np.ndarray] | None = None
    """Function of times (N,) that returns ankle x, y, z, pitch, heading (N, 5); None: blend back to
    the steps."""


@dataclass(frozen=True)
class Footwork:
    """Feet that stand without sliding, step, and carry a pelvis along."""

    start: np.ndarray
    """(2, 2) first places of the ankles, left and right."""
    heading: float
    """First heading of both feet, rad."""
    steps: Sequence[Step]
    """Steps in order of time."""
    ankle_height: np.ndarray
    """(2,) height of a standing foot's ankle above its support, metres."""
    end_s: float
    """End of the script, seconds."""
    guides: Sequence[Guide] = ()
    """Motions of feet that are no steps, in order of time."""
    grid_step_s = 0.005  # sampling of the pelvis track
    grid_margin_s = 1.0  # of the track before and after the script
    # standard deviation of the smoothing by which the trunk follows the feet, without delay
    body_smoothing_s = 0.11
    sway_to_stance = 0.35  # share of the way to the standing foot that the pelvis shifts in a step
    step_lift_m = 0.075  # height of a foot in the middle of a step, metres
    step_up_share = 0.55  # share of a step's time in which a foot is brought up, or down, an edge
    sole_front_m = 0.12  # the ball of the foot, ahead of the ankle, metres

    def feet(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ankles (N, 2, 3), headings (N, 2), pitch (N, 2; positive: toes down) at ``times``."""
        count = len(times)
        ankle = np.empty((count, 2, 3))
        ankle[:, :, :2] = self.start
        ankle[:, :, 2] = self.ankle_height
        heading = np.full((count, 2), self.heading)
        pitch = np.zeros((count, 2))
        placed, turned, raised = self.start.copy(), [self.heading, self.heading], [0.0, 0.0]
        for step in self.steps:
            share = ramp(times, step.start, step.end)
            u = np.clip((times - step.start) / (step.end - step.start), 0, 1)
            ankle[:, step.foot, :2] += share[:, None] * (np.array(step.place) - placed[step.foot])
            heading[:, step.foot] += share * (step.heading - turned[step.foot])
            length = float(np.linalg.norm(np.array(step.place) - placed[step.foot]))
            # toes down as the foot leaves, up as it lands; less in steps below 0.4 m
            roll = np.sin(np.pi * u) ** 3 * np.cos(np.pi * u) * min(1.0, length / 0.4)
            roll = np.where((u > 0) & (u < 1), roll * (0.9 + 0.25 * np.cos(np.pi * u)), 0)
            pitch[:, step.foot] += roll
            lift = self.step_lift_m * min(1.0, 0.4 + length / 0.5) * np.sin(np.pi * u) ** 2
            # the ball or the heel stays above the floor as the foot rolls
            ankle[:, step.foot, 2] += lift + self.sole_front_m * roll**2 / np.hypot(roll, 0.12)
            ankle[:, step.foot, 2] += self._rise(times, step, raised[step.foot])
            if step.aside:
                out = (step.aside, -step.aside)[step.foot] * np.sin(np.pi * u) ** 2
                across = np.array([-np.sin(step.heading), np.cos(step.heading)])
                ankle[:, step.foot, :2] += out[:, None] * across
            placed[step.foot] = step.place
            raised[step.foot] = step.height
            turned[step.foot] = step.heading
        stepped = np.concatenate([ankle, pitch[..., None], heading[..., None]], 2)
        guided = stepped.copy()
        for guide in self.guides:
            foot = guide.foot
            goal = guide.path(times) if guide.path else stepped[:, foot]
            share = ramp(times, guide.start, guide.end)[:, None]
            guided[:, foot] += share * (goal - guided[:, foot])
        return guided[..., :3], guided[..., 4], guided[..., 3]

    @staticmethod
    def _rise(times: np.ndarray, step: Step, before: float) -> np.ndarray:
        """Height (N,) that a step adds to ``before``, metres: up first, down last."""
        rise, reach = step.height - before, Footwork.step_up_share * (step.end - step.start)
        if rise > 0:
            return rise * ramp(times, step.start, step.start + reach)
        return rise * ramp(times, step.end - reach, step.end)

    def _level(self, times: np.ndarray) -> np.ndarray:
        """Height (N,) of the higher of both supports, metres."""
        levels, raised = np.zeros((len(times), 2)), [0.0, 0.0]
        for step in self.steps:
            levels[:, step.foot] += self._rise(times, step, raised[step.foot])
            raised[step.foot] = step.height
        return levels.max(1)

    def pelvis(self, leg: float, hip_width: float, hip_drop: float, stand: float) -> CubicSpline:
        """Pelvis position and heading (4 channels) over time, low enough for both legs to reach.

        The pelvis is above the middle of both ankles, shifted towards the standing foot in a step,
        and smoothed. It is as high as the straighter leg permits, at most ``stand``.

        Args:
            leg: usable length from hip to ankle, metres.
            hip_width: from the midline to each hip, metres.
            hip_drop: height of the pelvis above the hips, metres.
            stand: largest height of the pelvis above the support, metres.
        """
        grid = np.arange(-self.grid_margin_s, self.end_s + self.grid_margin_s, self.grid_step_s)
        ankle, heading, _ = self.feet(grid)
        middle = ankle[:, :, :2].mean(1)
        for step in self.steps:
            stance = ankle[:, 1 - step.foot, :2] - middle
            middle = (
                middle + self.sway_to_stance * bump(grid, step.start, step.end)[:, None] * stance
            )
        sigma = self.body_smoothing_s / self.grid_step_s
        middle = gaussian_filter1d(middle, sigma, axis=0, mode="nearest")
        facing = gaussian_filter1d(heading.mean(1), sigma, mode="nearest")
        across = np.stack([-np.sin(facing), np.cos(facing)], 1)
        top = stand + self._level(grid)
        for foot, sign in ((0, 1.0), (1, -1.0)):
            hip = middle + sign * hip_width * across
            far = np.linalg.norm(ankle[:, foot, :2] - hip, axis=1)
            reach = np.sqrt(np.maximum(leg**2 - far**2, 0.01)) + ankle[:, foot, 2] + hip_drop
            top = np.minimum(top, reach)
        # smoothed by 0.05 s; the minimum over the filter's width keeps the result within reach
        window = int(6 * 0.05 / self.grid_step_s) | 1
        lowest = minimum_filter1d(top, window, mode="nearest")
        top = gaussian_filter1d(lowest, 0.05 / self.grid_step_s, mode="nearest", truncate=3.0)
        return CubicSpline(grid, np.column_stack([middle, top, facing]))
