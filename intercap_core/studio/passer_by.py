"""A second person in the room, who walks past the subject or stands near the subject.

The path is drawn until it fits: 0.8 to 1.6 m from the subject at the nearest point, clear of the
object, furniture and cameras. Walls have no doors: the person walks through them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.errors import UserError
from intercap_core.studio.controls import Footwork, Step, Wander
from intercap_core.studio.motion import PersonState, Puppet, Trunk
from intercap_core.studio.noise import NoiseSource
from intercap_core.studio.room import FLOOR_HALF_M, Room
from intercap_core.studio.skeleton import about_z
from intercap_core.studio.subjects import Subject, body_colours, subject_names

CELL_M = 0.05  # grid of the floor plan


@dataclass(frozen=True)
class Passing(PersonState):
    """State of the second person at N moments."""

    present: np.ndarray
    """(N,) bool: the person is inside the room; other values are 0 if not."""


@dataclass(frozen=True)
class Way:
    """A straight path, or the place of a person who stands."""

    place: np.ndarray
    """(2,) x, y on the floor at time ``when``, metres."""
    heading: float
    """Direction in which the person faces and walks, rad."""
    when: float
    """Recording time, seconds."""

    def at(self, times: np.ndarray, speed: float) -> np.ndarray:
        """Places (N, 2) at recording times (N,) for a walking speed, m/s."""
        ahead = np.array([np.cos(self.heading), np.sin(self.heading)])
        return self.place + speed * (times - self.when)[:, None] * ahead


class PasserBy:
    """The second person of a recording.

    Args:
        eyes: (C, 2) places of the cameras on the floor plan.
        times: (N,) recording times, s.
        pelvis: (N, 2) places of the subject at ``times``.
        prop: (N, 2) places of the object.
        stands: whether the person stands; else walks.
    """

    passes_m = (0.8, 1.6)  # range of the least distance from the subject's pelvis, metres
    # of the walker's middle from the object, metres; half the shoulders are 0.23
    clear_of_object_m = 0.65
    clear_of_furniture_m = 0.33  # from furniture, metres
    clear_of_cameras_m = 0.45  # from cameras, metres
    passes_within = (0.3, 0.7)  # range of the time of least distance, share of the recording
    tries = 3000  # random ways that are tried
    step_range_s = (0.46, 0.54)  # duration of a step
    stride_range = (0.72, 0.84)  # stride, in leg lengths
    swing_share = 0.94  # share of a step's time in which the foot is in the air
    arm_swing_m = 0.16  # amplitude of the wrist, metres
    lean_rad = 0.05  # of the trunk
    counter_turn_rad = 0.08  # of the trunk against the pelvis
    sway_rad = 0.01  # of trunk and head, RMS
    place_s = 0.03  # time step at which a way is tested

    def __init__(
        self,
        noise: NoiseSource,
        subject: Subject,
        room: Room,
        eyes: np.ndarray,
        times: np.ndarray,
        pelvis: np.ndarray,
        prop: np.ndarray,
        *,
        stands: bool = False,
    ) -> None:
        rng = noise.rng("passer-by")
        others = [name for name in subject_names() if name != subject.name]
        self.subject = Subject.load(others[rng.integers(len(others))])
        self.puppet = Puppet(self.subject)
        self.colours = _other_colours(noise, self.subject, subject)
        self.step_s = rng.uniform(*self.step_range_s)
        stride = rng.uniform(*self.stride_range) * self.puppet.leg
        self.stands, self.speed = stands, 0.0 if stands else stride / self.step_s
        self.sway = Wander(6, self.sway_rad, noise.rng("passer-by sways"))
        self.way = self._way(rng, _obstacles(room), eyes, times, pelvis, prop)
        self._walk(stride)

    def _way(
        self,
        rng: np.random.Generator,
        obstacles: np.ndarray,
        eyes: np.ndarray,
        times: np.ndarray,
        pelvis: np.ndarray,
        prop: np.ndarray,
    ) -> Way:
        """Draw a path that fits; raises UserError if none does."""
        fine = np.linspace(times[0], times[-1], 1 + int(np.ptp(times) / self.place_s))
        for _ in range(self.tries):
            heading, far = rng.uniform(0, 2 * np.pi), rng.uniform(*self.passes_m)
            moment = round(rng.uniform(*self.passes_within) * (len(times) - 1))
            left = np.array([-np.sin(heading), np.cos(heading)])
            looks = heading - np.pi / 2 if self.stands else heading  # at the subject
            way = Way(pelvis[moment] + far * left, looks, float(times[moment]))
            path, places = way.at(times, self.speed), way.at(fine, self.speed)
            nearest = np.linalg.norm(path - pelvis, axis=1).min()
            if (
                self.passes_m[0] <= nearest <= self.passes_m[1]
                and np.linalg.norm(path - prop, axis=1).min() > self.clear_of_object_m
                and _gap(places, obstacles) > self.clear_of_furniture_m
                and _gap(places, eyes) > self.clear_of_cameras_m
            ):
                return way
        raise UserError(
            "studio: this room has no free path near the subject; set passer_by: nobody, "
            "another seed or room: bare"
        )

    def _walk(self, stride: float) -> None:
        """Plan footsteps along x of the person's own frame, from x = 0 at time 0.

        A standing person has no steps and the feet side by side.
        """
        puppet, across = self.puppet, 0.7 * self.puppet.hip_width
        count = 0 if self.stands else int(np.ceil(2 * (FLOOR_HALF_M + 1) / stride))
        apart = 0.0 if self.stands else 0.5 * stride
        start = np.array([[-apart, across], [apart, -across]])
        steps = []
        for k in range(count):
            begin, foot = k * self.step_s, k % 2
            place = ((k + 1.5) * stride, (across, -across)[foot])
            steps.append(Step(foot, begin, begin + self.swing_share * self.step_s, place))
        self.seconds = count * self.step_s
        self.footwork = Footwork(start, 0.0, steps, puppet.ankle_height, self.seconds)
        self.track = puppet.pelvis_track(self.footwork, across)

    def at(self, times: np.ndarray) -> Passing:
        """State at recording times (N,); present while inside the room."""
        count, points = len(times), len(self.subject.rest)
        present = (np.abs(self.way.at(times, self.speed)) < FLOOR_HALF_M - 0.3).all(1)
        body, clothed = np.zeros((2, count, points, 3))
        joints, pelvis = np.zeros((count, 55, 3)), np.zeros((count, 3, 3))
        if present.any():
            world, root = self._pose(times[present])
            posed = self.puppet.skin(world, root)
            body[present], clothed[present] = posed.vertices, posed.clothed
            joints[present], pelvis[present] = posed.joints, world[:, 0]
        return Passing(body, clothed, joints, pelvis, present)

    def _pose(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint rotations (N, 55, 3, 3) and pelvis (N, 3) in the stage."""
        puppet = self.puppet
        # the middle of the walk is at ``way.place`` at time ``way.when``
        own = times - self.way.when + self.seconds / 2
        track, feet = self.track(own), self.footwork.feet(own)
        phase = np.pi * own / self.step_s  # a half turn is a step, the left foot's first
        bend, walks, sway = np.zeros((len(own), 3)), 0.0 if self.stands else 1.0, self.sway(times)
        bend[:, 0] = self.lean_rad * walks
        bend[:, 1] = walks * self.counter_turn_rad * np.sin(phase - np.pi / 2)
        bend, head = bend + sway[:, :3], sway[:, 3:]
        trunk = puppet.settled(Trunk(track[:, :3], track[:, 3], bend, head), feet[0])
        world = puppet.trunk(trunk)
        puppet.legs(world, trunk.pelvis, *feet)
        # an arm is ahead while the foot of its side is behind
        for side, sign in enumerate((1.0, -1.0)):
            swing = sign * walks * self.arm_swing_m * np.cos(phase)
            puppet.swing_arm(world, trunk.pelvis, side, swing)
        middle = self.speed * self.seconds / 2
        turned = about_z(self.way.heading)
        place = np.array([*self.way.place, 0.0])
        return turned @ world, (trunk.pelvis - [middle, 0, 0]) @ turned.T + place


def _obstacles(room: Room) -> np.ndarray:
    """Floor points (N, 2), on a grid, below surfaces above the floor and inside the walls.

    Each triangle is sampled at 15 points; the nearest walls are 3 m from the middle.
    """
    shares = np.array([[a, b, 4 - a - b] for a in range(5) for b in range(5 - a)]) / 4
    corners = room.vertices[room.faces]
    points = np.einsum("sk,fkc->fsc", shares, corners).reshape(-1, 3)
    standing = points[:, 2] > 0.03
    inside = np.linalg.norm(points[:, :2], axis=1) < 2.8
    cells = np.round(points[standing & inside, :2] / CELL_M).astype(int)
    return CELL_M * np.unique(cells, axis=0)


def _gap(path: np.ndarray, obstacles: np.ndarray) -> float:
    """Least distance of a path (N, 2) from obstacles (M, 2), metres."""
    if not len(obstacles):
        return np.inf
    return float(np.linalg.norm(path[:, None] - obstacles, axis=2).min())


def _other_colours(noise: NoiseSource, passer_by: Subject, subject: Subject) -> np.ndarray:
    """Colours (V, 3) with clothes that differ from the subject's."""
    worn = body_colours(subject, noise.rng("looks"))[subject.clothing > 0.001].mean(0)
    rng = noise.rng("passer-by looks")
    dressed = passer_by.clothing > 0.001
    drawn = [body_colours(passer_by, rng) for _ in range(8)]
    away = [float(np.linalg.norm(colours[dressed].mean(0) - worn)) for colours in drawn]
    far = next((k for k, distance in enumerate(away) if distance > 0.25), None)
    return drawn[int(np.argmax(away)) if far is None else far]
