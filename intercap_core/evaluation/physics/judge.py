"""Physics of the object of one sequence, without truth: datasets ``physics/...`` of the metrics.

- Rest test (:mod:`.rest_test`): rests that the object track found, in frames without contact with
  the body. At most three frames of a rest are released.
- Support test (:mod:`.carriers`): every frame with a tracked object.
- Penetration: depth of the collision shape below the floor, and at rest below its support.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from intercap_core import artefacts
from intercap_core.evaluation.physics.carriers import (
    Carrier,
    Distances,
    find_carriers,
    support_acceleration,
)
from intercap_core.evaluation.physics.rest_test import FallingBody, missing_library
from intercap_core.evaluation.physics.supports import REACH_M, StaticScene, Support
from intercap_core.evaluation.proximity import REACH_M as DISTANCE_CAP_M
from intercap_core.evaluation.proximity import MeasuredCloud, PosedObject
from intercap_core.evaluation.tracks import read_object
from intercap_core.flags import OF_BODY, PARTS, Flags
from intercap_core.geometry.camera.clouds import depth_points
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.surfaces import sample_surface
from intercap_core.geometry.solve.time_series import runs
from intercap_core.schemas import CONTACT_M, JOINT, OBJECT_TRACK, SCENE
from intercap_core.sequence_inputs import SequencePaths

log = logging.getLogger(__name__)

Values = dict[str, np.ndarray | list[str]]

BAD_OBJECT_M = 0.020  # estimated error above which the images do not confirm a pose, metres
BAD_REST_M = 0.050  # displacement of a released object above which its pose counts as lost, metres
# Share of the surface above the support that a wall touches at most; an object in the background
# touches itself on a third of its surface or more (three of six cameras see each point).
LEANING_SHARE = 0.1
MAX_RELEASES = 24  # of a sequence; one takes 7 ms
_SURROUNDINGS_M = 0.15  # static points are kept up to this distance from the object's way


@dataclass(frozen=True, eq=False)
class Rest:
    """A rest of the object on a support."""

    first: int
    """First frame."""
    last: int
    """Last frame."""
    support: Support
    """The surface that carries the object."""


class PhysicsTest:
    """Tests of one object in the static scene of one sequence."""

    def __init__(self, mesh: ObjectMesh, paths: SequencePaths) -> None:
        """Read scene, joint fit and object track; raises UserError as reading does."""
        self.mesh, self.body = mesh, FallingBody(mesh)
        self._surface = PosedObject(mesh.vertices, mesh.faces, watertight=mesh.watertight)
        self._samples = sample_surface(mesh.vertices, mesh.faces, 1000).of(
            mesh.vertices, mesh.faces
        )
        track = read_object(paths.joint, "joint")
        self.poses = rigid(track.rotation, track.translation)
        """(T, 4, 4) master_from_object after ``joint``."""
        with (
            artefacts.read(paths.scene, SCENE) as scene,
            artefacts.read(paths.joint, JOINT) as joint,
            artefacts.read(paths.object_track, OBJECT_TRACK) as tracked,
        ):
            self.times, self.fps = scene["times"], float(scene.attributes["fps"])
            self.up_from_master = scene["zup_from_master"]
            rig = Rig.from_artefact(scene).moved(joint["master_from_colour"])
            way = apply(self.up_from_master, self.mesh.centre_at(self.poses))
            points = _static_points(scene, rig, joint["depth_bias"], self.up_from_master)
            floor = bool(np.isfinite(scene["ground_point"]).all())
            self.probability = np.nan_to_num(joint["contact_probability"]).max(axis=1)
            self.joint_flags = Flags.read(joint)
            carried = tracked["carried"] if "carried" in tracked else np.zeros(len(way), bool)
            self.tracked = np.isfinite(way).all(axis=1) & ~tracked["lost"] & ~carried
            """(T,) frames whose images show the object."""
            self.resting = tracked["resting"] & self.tracked
            """(T,) frames in which the object rests."""
            variance = np.trace(tracked["covariance"][:, 3:, 3:], axis1=1, axis2=2) / 3
            self.sigma = np.sqrt(np.where(self.tracked, variance, np.nan))
            """(T,) standard deviation of the position along one axis, metres."""
        margin = mesh.radius + _SURROUNDINGS_M
        self.static = StaticScene(floor, len(points) > 0, points)
        if self.tracked.any():
            low, high = way[self.tracked].min(axis=0), way[self.tracked].max(axis=0)
            points = self.static.near(low - margin, high + margin)
            self.static = replace(self.static, points=points)

    def in_scene(self, poses: np.ndarray) -> np.ndarray:
        """Poses (T, 4, 4) master_from_object as transforms from the object to z up."""
        return self.up_from_master @ poses

    def rests(self) -> list[Rest]:
        """Rests of the object with their supports, by the pose in the middle frame."""
        return [
            Rest(first, last, self.support(self.poses[t], self.sigma[t]))
            for first, last in runs(self.resting)
            for t in [(first + last) // 2]
        ]

    def leans(self, t: int, support: Support) -> bool:
        """Whether something static touches the object above its support in frame ``t``.

        An object that is seldom moved is part of the background. Its own points cover much of its
        surface, those of a wall that it leans on only a patch.
        """
        points, _ = self.static_around(t)
        placed = self.in_scene(self.poses[t])
        surface = apply(placed, self._samples)
        above = surface[surface[:, 2] > support.height + REACH_M]
        if not len(points) or not len(above):
            return False
        touched = MeasuredCloud(points).distance(above) < CONTACT_M + 2 * self.sigma[t]
        return bool(0 < touched.mean() < LEANING_SHARE)

    def static_around(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Static points (N, 3), z up, near the object in frame ``t``, and distances (N,), metres.

        Distances are signed: negative inside the object.
        """
        placed = self.in_scene(self.poses[t])
        shape = apply(placed, self.body.hull)
        margin = DISTANCE_CAP_M
        points = self.static.near(shape.min(axis=0) - margin, shape.max(axis=0) + margin)
        if not len(points):
            return points, np.zeros(0)
        local = apply(invert(placed), points)
        return points, self._surface.signed_distance(local, np.eye(3), np.zeros(3))

    def support(self, pose: np.ndarray, sigma: float) -> Support:
        """The surface under the object at a pose (4, 4) master_from_object."""
        placed = self.in_scene(pose)
        return self.static.support_under(
            apply(placed, self.body.hull), self.mesh.centre_at(placed), sigma
        )

    def displacement(self, pose: np.ndarray, sigma: float) -> float:
        """Displacement of the object released at a pose (4, 4) master_from_object, metres.

        NaN if the scene does not hold its support.
        """
        support = self.support(pose, sigma)
        if not support.known:
            return float("nan")
        placed = self.in_scene(pose).copy()
        placed[2, 3] -= support.height
        return self.body.displacement(placed, self.fps)


def judge_physics(
    mesh: ObjectMesh,
    paths: SequencePaths,
    body_distance: np.ndarray,
    flags: Flags,
    estimated: np.ndarray | None,
) -> tuple[Values, str]:
    """Datasets ``physics/...`` by name, without the prefix, and a note; no truth is read.

    The note names what is not judged, and why. Without the library or for a mesh that is not
    closed there is only the note. Raises UserError if an artefact cannot be used.

    Args:
        body_distance: (T,) smallest distance of skin and object, metres.
        flags: flags of the joint result.
        estimated: (T,) error of the object that the verdict estimates, metres, NaN = none; None =
            no verdict.
    """
    if why := missing_library() or without_volume(mesh):
        log.warning("physics is left out: %s", why)
        return {}, why
    test = PhysicsTest(mesh, paths)
    rests = test.rests()
    gap = test.body.gap(test.in_scene(test.poses))
    near = CONTACT_M + 2 * test.sigma
    touched = test.probability >= 0.5
    frames, displacements, supports, notes = _release(
        test, rests, free=(body_distance > near) & ~touched
    )
    floor = gap if test.static.floor else np.full(len(gap), np.nan)
    height = mesh.centre_at(test.in_scene(test.poses))[:, 2]
    acceleration, deviation = support_acceleration(height, test.sigma, test.times)
    apart = (body_distance > near) & ~touched & ~(floor <= near) & test.tracked
    distances = Distances(
        body=body_distance,
        floor=floor,
        furniture=_furniture_distances(test, apart),
        sigma=test.sigma,
        touched=touched,
        body_known=np.logical_not(flags.flagged[:, np.isin(PARTS, OF_BODY[:2])].any(axis=1)),
    )
    confirmed = ~flags.flagged[:, PARTS.index("object")] & (np.sqrt(3) * test.sigma < BAD_OBJECT_M)
    if estimated is not None:
        confirmed &= estimated < BAD_OBJECT_M
    carrier = find_carriers(distances, acceleration, deviation, confirmed, test.times)
    for rest in rests:
        if rest.support.name == "furniture":
            at_rest = np.arange(rest.first, rest.last + 1)
            open_ = np.isin(carrier[at_rest], (Carrier.UNDETERMINED, Carrier.UNSUPPORTED))
            carrier[at_rest[open_]] = str(Carrier.FURNITURE)
    held = runs(carrier == Carrier.UNKNOWN)
    notes += [f"frames {a} to {b}: {Carrier.UNKNOWN}" for a, b in held]
    bad = carrier == Carrier.UNSUPPORTED
    for rest in rests:
        own = (frames >= rest.first) & (frames <= rest.last)
        if own.any() and (displacements[own] > BAD_REST_M).all():
            bad[rest.first : rest.last + 1] = True
    return {
        "carrier": [str(name) for name in carrier],
        "support_acceleration": acceleration.astype(np.float32),
        "support_acceleration_sigma": deviation.astype(np.float32),
        "penetration": _penetration(gap, floor, rests).astype(np.float32),
        "release_frame": frames,
        "release_displacement": displacements,
        "release_support": supports,
        "bad": bad,
    }, "; ".join(notes)


def without_volume(mesh: ObjectMesh) -> str:
    """Why a mesh has no defined mass; "" for a closed mesh."""
    if mesh.watertight:
        return ""
    return (
        f"the mesh of {mesh.name} is not closed, so it has no volume and no centre of mass "
        "(`intercap close-mesh` closes small holes)"
    )


def _release(
    test: PhysicsTest, rests: Sequence[Rest], *, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[str], list[str]]:
    """Release the object in some frames (S,) of its rests.

    Returns the frames, the displacements (S,) in metres, the names of the supports, and notes on
    rests that are not judged. ``free``: (T,) bool, no contact with the body.
    """
    frames: list[int] = []
    moved: list[float] = []
    supports: list[str] = []
    notes = []
    for rest in rests:
        usable = np.flatnonzero(free[rest.first : rest.last + 1]) + rest.first
        if not len(usable):
            continue
        reason = rest.support.reason
        some = np.unique(usable[[0, len(usable) // 2, -1]])[: MAX_RELEASES - len(frames)]
        own = [] if reason else [test.displacement(test.poses[t], test.sigma[t]) for t in some]
        if len(own) and max(own) > BAD_REST_M and test.leans(int(some[0]), rest.support):
            reason = "it may lean on something"
        if reason:
            notes.append(f"frames {rest.first} to {rest.last} not judged: {reason}")
            continue
        known = np.isfinite(own)
        frames += some[known].tolist()
        moved += np.array(own)[known].tolist()
        supports += [rest.support.name] * int(known.sum())
    return np.array(frames, np.int32), np.array(moved, np.float64), supports, notes


def _furniture_distances(test: PhysicsTest, wanted: np.ndarray) -> np.ndarray:
    """Distances (T,) of the object to the static points, at most ``DISTANCE_CAP_M``; metres.

    NaN in frames outside the mask ``wanted`` (T,), and without background depth.
    """
    found = np.full(len(wanted), np.nan)
    if not test.static.measured:
        return found
    for t in np.flatnonzero(wanted).tolist():
        found[t] = test.static_around(t)[1].min(initial=DISTANCE_CAP_M)
    return found


def _penetration(gap: np.ndarray, floor: np.ndarray, rests: Sequence[Rest]) -> np.ndarray:
    """Depth (T,) of the collision shape below the floor, or at rest below its support, metres.

    Args:
        gap: (T,) height of the lowest point.
        floor: (T,) the same; NaN without a floor.
    """
    depth = np.where(np.isfinite(floor), np.maximum(-floor, 0.0), np.nan)
    for rest in rests:
        if rest.support.name == "furniture":
            own = slice(rest.first, rest.last + 1)
            depth[own] = np.maximum(rest.support.height - gap[own], 0.0)
    return depth


def _static_points(
    scene: artefacts.Artefact, rig: Rig, depth_bias: np.ndarray, up_from_master: np.ndarray
) -> np.ndarray:
    """Background points (N, 3) of all cameras, z up, metres; empty without depth."""
    found = [np.empty((0, 3))]
    for camera, bias in zip(rig, depth_bias, strict=True):
        key = f"cameras/{camera.name}/background"
        if camera.depth is None or key not in scene:
            continue
        points = depth_points(scene[key], camera).points.astype(np.float64)
        points *= 1 - bias / points[:, 2:]
        found.append(apply(up_from_master @ camera.master_from_depth, points))
    return np.concatenate(found)
