"""Recordings with a faulty calibration, made from correct ones: are the faulty cameras named?

The faults: a camera moved before or during the recording, poses or images of two cameras exchanged,
and the calibration of another session. Only the rig and the assignment of detections change.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.formats.detections.read import Detections, PeopleOfImages
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.scene.camera_agreement import find_disagreements
from intercap_core.scene.subject_views import find_subject_views
from intercap_core.schemas import SCENE

FAULTS = ("none", "moved", "moved during", "poses exchanged", "images exchanged", "other session")


@dataclass(frozen=True)
class _Altered:
    """Detections of exchanged cameras, or of a camera that turned during the recording."""

    detections: PeopleOfImages
    rig: Rig
    source: tuple[int, ...]
    """Camera c shows the images of camera ``source[c]``."""
    turned: int = -1
    """Camera that turns in the second half of the recording; -1 = none."""
    turn: np.ndarray | None = None
    """(3, 3) its rotation, in its own frame."""

    @property
    def num_sets(self) -> int:
        """Number of frame sets."""
        return self.detections.num_sets

    def people(self, t: int, c: int) -> np.ndarray:
        """Keypoints (P, 135, 3) of the people in the image of camera c."""
        found = self.detections.people(t, self.source[c])
        if c != self.turned or self.turn is None or t < self.num_sets / 2 or not len(found):
            return found
        lens, result, seen = self.rig[c].colour, found.copy(), found[..., 2] > 0
        result[seen, :2] = lens.project(lens.unproject(found[seen][:, :2]) @ self.turn)
        return result


def faulty_cases(
    detections: PeopleOfImages, rig: Rig, master: int, seed: int
) -> Iterator[tuple[str, frozenset[int], PeopleOfImages, Rig]]:
    """Name of the fault (:data:`FAULTS`), cameras at fault, detections and rig of each case.

    Exchanges need three cameras and another session four: with fewer, the faulty one cannot be
    identified.
    """
    rng = np.random.default_rng(seed)
    count = len(rig)
    others = rng.permutation([c for c in range(count) if c != master]).tolist()
    same = tuple(range(count))
    yield "none", frozenset(), detections, rig
    kick = _displaced(rng, 5.0, 0.15)  # a kicked tripod
    poses = rig.master_from_colour.copy()
    poses[others[0]] = poses[others[0]] @ kick
    yield "moved", frozenset(others[:1]), detections, rig.moved(poses)
    turned = _Altered(detections, rig, same, others[0], kick[:3, :3])
    yield "moved during", frozenset(others[:1]), turned, rig
    if count >= 3:
        a, b = others[:2]
        poses = rig.master_from_colour.copy()
        poses[[a, b]] = poses[[b, a]]
        yield "poses exchanged", frozenset((a, b)), detections, rig.moved(poses)
        order = list(same)
        order[a], order[b] = b, a
        yield "images exchanged", frozenset((a, b)), _Altered(detections, rig, tuple(order)), rig
    if count >= 4:
        poses = rig.master_from_colour.copy()
        for c in others:  # a rig that was set up again
            poses[c] = poses[c] @ _displaced(rng, 15.0, 0.5)
        yield "other session", frozenset(others), detections, rig.moved(poses)


def _displaced(rng: np.random.Generator, degrees: float, metres: float) -> np.ndarray:
    """Displacement (4, 4) of a camera by these amounts, in random directions."""
    axis, shift = rng.normal(size=(2, 3))
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    return rigid(turn, metres * shift / np.linalg.norm(shift))


@dataclass(frozen=True)
class NamedFault:
    """Cameras that were named in one case."""

    fault: str
    """One of :data:`FAULTS`."""
    named: float
    """Share of the cameras at fault that were named; NaN without a fault."""
    false: int
    """Number of correct cameras that were named."""


def name_faults(frames: Path, detections: Path, scene: Path) -> list[NamedFault]:
    """Make faulty recordings of a correct one and check which cameras are named.

    Raises UserError if an artefact cannot be read.
    """
    with Frames.open(frames) as source:
        people, rig = Detections.load(detections), source.rig
        master, times = rig.names.index(source.master), source.time_s
    with artefacts.read(scene, SCENE) as found:
        image_of = found["image_of"]  # late images are no fault of the calibration
    seed = zlib.crc32(rig.master_from_colour.tobytes())  # another fault in each recording
    result = []
    for fault, at_fault, altered, moved in faulty_cases(people, rig, master, seed):
        subject = find_subject_views(altered, moved, times).showing(image_of, moved)
        named = {one.camera for one in find_disagreements(altered, subject, image_of, moved)}
        share = len(named & at_fault) / len(at_fault) if at_fault else float("nan")
        # without a majority, it is undetermined which camera is correct
        false = 0 if fault == "other session" else len(named - at_fault)
        result.append(NamedFault(fault, share, false))
    return result
