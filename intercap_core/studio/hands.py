"""A puppet's hands: finger flexion, and grasps closed against the true object's surface.

Joint after joint flexes until the skin of its finger meets the object (Miller and Allen 2004,
"GraspIt!", auto-grasp). The contact term and regions of the fits are not used, so that the truth
does not favour them. The hand stays in its rest frame; the object is moved relative to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.geometry.camera.transforms import rotation_exp
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.studio.controls import bisect
from intercap_core.studio.skeleton import PuppetSkeleton, unit
from intercap_core.studio.subjects import Subject

FINGERS = ("index", "middle", "pinky", "ring", "thumb")  # in the order of SMPL-X's joints
THUMB = FINGERS.index("thumb")
# Largest flexion of MCP, PIP, DIP, and of the thumb's CMC, MCP, IP, degrees (AAOS tables)
LIMITS = {"finger": (85.0, 100.0, 65.0), "thumb": (35.0, 50.0, 65.0)}


@dataclass(frozen=True)
class HandShape:
    """Angles of a hand's joints, degrees."""

    flexion: np.ndarray
    """(5, 3) of each of ``FINGERS``, at its three joints from the knuckle to the tip."""
    spread: np.ndarray
    """(5,) of the fingers at the knuckles, positive towards the thumb; the thumb's is not used."""
    opposition: float
    """Rotation of the thumb's base towards the palm."""

    def towards(self, other: HandShape, share: float) -> HandShape:
        """Between this shape and another."""
        return HandShape(
            (1 - share) * self.flexion + share * other.flexion,
            (1 - share) * self.spread + share * other.spread,
            (1 - share) * self.opposition + share * other.opposition,
        )


def shape(
    fingers: tuple[float, float, float],
    thumb: tuple[float, float, float],
    opposition: float,
    spread: float = 3.0,
) -> HandShape:
    """A shape with nearly the same flexion in all four fingers; all angles in degrees.

    Args:
        fingers: flexion of MCP, PIP and DIP.
        thumb: flexion of CMC, MCP and IP.
        opposition: rotation of the thumb's base towards the palm.
        spread: angle between neighbouring fingers, roughly.
    """
    flexion = np.array([fingers] * 4 + [thumb], float)
    # Middle, little and ring finger: flexion grows towards the little finger.
    flexion[1:4] += np.array([[2.0, 2, 1], [6, 4, 2], [4, 3, 2]])
    return HandShape(flexion, np.array([1.0, 0, -1.4, -0.7, 0]) * spread, opposition)


RELAXED = shape((18, 26, 12), (8, 12, 15), 18)
OPEN = shape((6, 10, 5), (0, 4, 6), 35, 5)
FLAT = shape((-3, 3, 2), (0, 2, 4), 5, 4)


class Hand:
    """One hand of a subject: ``side`` 0 left, 1 right."""

    scan_deg = 5.0  # step at which flexion is scanned for contact

    def __init__(self, subject: Subject, side: int) -> None:
        self.side = side
        self.name = ("left", "right")[side]
        self.first = 25 + 15 * side  # SMPL-X: joints 25 to 39 are left fingers, 40 to 54 right ones
        self.wrist = JOINT_INDEX[f"{self.name}_wrist"]
        self.rest = PuppetSkeleton(subject.rest_joints)
        self.out = np.array([1.0 if side == 0 else -1.0, 0, 0])  # where the fingers point at rest
        self.palm = np.array([0.0, -1, 0])  # where the palm faces at rest
        self.radial = np.array([0.0, 0, 1])  # where the thumb is at rest
        bones = [self.wrist, *range(self.first, self.first + 15)]
        share = np.asarray(subject.weights[:, bones].todense())
        self.vertex_ids = np.flatnonzero(share.sum(1) > 0.5)
        self._part = part_of(subject, self.vertex_ids)
        finger = share[self.vertex_ids, 1:].reshape(-1, 5, 3)
        distal = finger[..., ::-1].cumsum(-1)[..., ::-1]  # moved by this joint or a further one
        # vertices that move with joint j of finger f
        self.moved = [[np.flatnonzero(distal[:, f, j] > 0.5) for j in range(3)] for f in range(5)]
        self.palm_ids = np.flatnonzero(share[self.vertex_ids, 0] > 0.6)
        self.thumb_ids = self.moved[THUMB][0]
        self.but_thumb_ids = np.setdiff1d(np.arange(len(self.vertex_ids)), self.thumb_ids)
        self._tips = subject.rest_tips[5 * side : 5 * side + 5]

    @cached_property
    def knuckles(self) -> np.ndarray:
        """Knuckles (4, 3) of index, middle, pinky, ring relative to the wrist, rest frame."""
        return self.rest.rest[self.first : self.first + 12 : 3] - self.rest.rest[self.wrist]

    @cached_property
    def _axes(self) -> np.ndarray:
        """Flexion axes (5, 3, 3), unit, rest frame."""
        rest = self.rest.rest
        axes = np.empty((5, 3, 3))
        for f in range(5):
            chain = np.vstack([rest[self.first + 3 * f : self.first + 3 * f + 3], self._tips[f]])
            # the thumb bends towards the palm's middle
            bend_to = self.palm if f < 4 else unit(0.55 * self.palm - self.radial)
            axes[f] = unit(np.cross(np.diff(chain, axis=0), bend_to))
        return axes

    def _finger(self, f: int, flexion: np.ndarray, hand: HandShape) -> np.ndarray:
        """Rotation vectors (B, 3, 3) of one finger for flexions (B, 3), degrees."""
        vectors = self._axes[f] * np.radians(flexion)[..., None]
        bent = Rotation.from_rotvec(vectors[:, 0])
        if f < 4:
            sideways = np.cross(self.out, self.radial) * np.radians(hand.spread[f])
            first = Rotation.from_rotvec(sideways) * bent
        else:
            # The thumb's first bone rolls about itself and is lifted to the palm; then it flexes.
            bone = self.rest.rest[self.first + 13] - self.rest.rest[self.first + 12]
            lift = unit(np.cross(bone, self.palm)) * np.radians(hand.opposition)
            roll = unit(bone) * np.radians(0.5 * hand.opposition) * self.out[0]
            first = bent * (Rotation.from_rotvec(lift) * Rotation.from_rotvec(roll))
        vectors[:, 0] = first.as_rotvec()
        return vectors

    def local(self, hand: HandShape) -> np.ndarray:
        """Rotation vectors (15, 3) of a shape, in the order of the joints."""
        fingers = [self._finger(f, hand.flexion[f][None], hand)[0] for f in range(5)]
        return np.concatenate(fingers)

    def skin(self, vectors: np.ndarray) -> np.ndarray:
        """Vertices (B, n, 3) relative to the wrist, rest frame, of finger poses (B, 15, 3)."""
        local = np.broadcast_to(np.eye(3), (len(vectors), 55, 3, 3)).copy()
        local[:, self.first : self.first + 15] = rotation_exp(vectors)
        posed = self._part.skin(local, np.zeros((len(vectors), 3)))
        return posed.vertices - self.rest.rest[self.wrist]

    def close(
        self,
        start: HandShape,
        limits: dict[str, tuple[float, float, float]],
        surface: DistanceField,
        object_from_wrist: np.ndarray,
        tissue: float = 0.0012,
        fingers: tuple[int, ...] = (1, 3, 0, 2, THUMB),
    ) -> tuple[HandShape, np.ndarray]:
        """Flex joint after joint until the skin meets the object or the limit is reached.

        Args:
            object_from_wrist: (4, 4) from the hand's rest frame at the wrist.
            tissue: depth to which the skin is pressed in, metres.
            limits: largest flexions of "finger" and "thumb", as ``LIMITS``.
            fingers: indices in ``FINGERS`` of the fingers that are closed, in this order.

        Returns:
            The shape, and the least signed distance (5,) of each finger to the object, metres.
        """
        flexion = start.flexion.copy()
        for f in fingers:
            largest = limits["finger" if f < 4 else "thumb"]
            for j in range(3):
                moved = self.moved[f][j]

                def least(
                    angles: np.ndarray, f: int = f, j: int = j, moved: np.ndarray = moved
                ) -> np.ndarray:
                    trial = np.tile(flexion[f], (len(angles), 1))
                    trial[:, j] = angles
                    poses = np.tile(self.local(replace(start, flexion=flexion)),
                                    (len(angles), 1, 1))  # fmt: skip
                    poses[:, 3 * f : 3 * f + 3] = self._finger(f, trial, start)
                    points = self.skin(poses)[:, moved]
                    return self._distance(points, surface, object_from_wrist)

                angles = np.arange(flexion[f, j], largest[j] + self.scan_deg, self.scan_deg)
                if len(angles) < 2:
                    continue
                hits = np.flatnonzero(least(angles) < -tissue)
                if len(hits) == 0:
                    flexion[f, j] = max(largest[j], flexion[f, j])
                    continue
                low = angles[max(hits[0] - 1, 0)]
                high = angles[hits[0]] if hits[0] else low
                flexion[f, j], _ = bisect(
                    low, high, 8, lambda angle: not least(np.array([angle]))[0] < -tissue
                )
        closed = replace(start, flexion=flexion)
        skin = self.skin(self.local(closed)[None])
        gaps = [
            self._distance(skin[:, self.moved[f][0]], surface, object_from_wrist)[0]
            for f in range(5)
        ]
        return closed, np.array(gaps)

    def gap(
        self,
        hand: HandShape,
        surface: DistanceField,
        object_from_wrist: np.ndarray,
        ids: np.ndarray | slice = slice(None),
    ) -> float:
        """Least signed distance of the hand, or of its vertices ``ids``, to the object, metres.

        Negative: the hand penetrates the object.
        """
        skin = self.skin(self.local(hand)[None])[:, ids]
        return float(self._distance(skin, surface, object_from_wrist)[0])

    @staticmethod
    def _distance(points: np.ndarray, surface: DistanceField, pose: np.ndarray) -> np.ndarray:
        """(B, n, 3) -> least signed distance (B,)."""
        at = points @ pose[:3, :3].T + pose[:3, 3]
        return surface.signed_distance(at.reshape(-1, 3)).reshape(at.shape[:2]).min(1)


def part_of(subject: Subject, ids: np.ndarray) -> Subject:
    """The same person reduced to the vertices ``ids`` (n,) and the faces between them."""
    place = np.full(len(subject.rest), -1)
    place[ids] = np.arange(len(ids))
    faces = place[subject.faces]
    return replace(
        subject,
        rest=subject.rest[ids],
        faces=np.ascontiguousarray(faces[(faces >= 0).all(1)]),
        weights=subject.weights[ids],
        bulges=subject.bulges[:, ids],
        clothing=subject.clothing[ids],
    )
