"""Points of moving stick people, and their projections into cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.keypoints import KEYPOINT_NAMES, LEFT_HAND, RIGHT_HAND
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import reproject
from intercap_core.schemas import DETECTIONS

_HEIGHTS = {
    "nose": 1.6, "neck": 1.45, "shoulder": 1.42, "elbow": 1.15, "wrist": 0.95, "mid_hip": 0.95,
    "hip": 0.93, "knee": 0.5, "ankle": 0.09, "eye": 1.64, "ear": 1.62, "big_toe": 0.02,
    "small_toe": 0.02, "heel": 0.03,
}  # fmt: skip
_ASIDE = {"shoulder": 0.19, "elbow": 0.27, "wrist": 0.32, "eye": 0.035, "ear": 0.08}
_AHEAD = {"nose": 0.12, "eye": 0.1, "wrist": 0.15, "big_toe": 0.2, "small_toe": 0.17, "heel": -0.05}


@dataclass(frozen=True)
class DelayedPeople:
    """Detections of cameras that were started late."""

    images: list[list[list[np.ndarray] | None]]
    """(T, C) lists of people (135, 3); None = no image."""
    late: np.ndarray
    """(C,) frame sets by which each camera's images are late."""

    @property
    def num_sets(self) -> int:
        return len(self.images)

    def people(self, t: int, c: int) -> np.ndarray:
        """People (P, 135, 3) in camera ``c``'s image of set ``t``."""
        image = t - int(self.late[c])
        people = self.images[image][c] if 0 <= image < len(self.images) else None
        return np.array(people or []).reshape(-1, 135, 3)

    @property
    def available(self) -> np.ndarray:
        """(T, C) bool: the image shows a person."""
        views = range(len(self.late))
        return np.array([[len(self.people(t, c)) > 0 for c in views] for t in range(self.num_sets)])


def stick_person() -> np.ndarray:
    """(135, 3) metres, z up, facing +x, left towards +y."""
    points = np.zeros((135, 3))
    for index, name in enumerate(KEYPOINT_NAMES[:25]):
        side = 1 if name.startswith("left_") else -1 if name.startswith("right_") else 0
        part = name.removeprefix("left_").removeprefix("right_")
        points[index] = (
            _AHEAD.get(part, 0), side * _ASIDE.get(part, 0.11), _HEIGHTS[part]
        )  # fmt: skip
    spread = np.random.default_rng(5).uniform(-0.05, 0.05, (21, 3))
    points[LEFT_HAND] = spread + np.array([0.2, 0.33, 0.88])
    points[RIGHT_HAND] = spread * (1, -1, 1) + np.array([0.2, -0.33, 0.88])
    face = np.random.default_rng(6).uniform(-0.06, 0.06, (68, 3))
    points[67:] = face + np.array([0.1, 0, 1.58])
    return points


def walking(
    sets: int, start: np.ndarray, step: np.ndarray, turn: float = 0.02, size: float = 1.0
) -> np.ndarray:
    """(T, 135, 3), z up: the stick person, ``size`` times as large, from ``start`` (2,), ``step``
    (2,) metres a set."""
    person = size * stick_person()
    result = np.empty((sets, *person.shape))
    for t in range(sets):
        c, s = np.cos(turn * t), np.sin(turn * t)
        result[t] = person @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        result[t, :, :2] += start + t * step
    return result


def walker(times: np.ndarray) -> np.ndarray:
    """(T, 135, 3), z up, at ``times`` (T,) s: the stick person walks to and fro, swinging the
    arms."""
    person = stick_person()
    result = np.broadcast_to(person, (len(times), 135, 3)).copy()
    result[:, :, 0] += 0.4 * np.sin(1.9 * times)[:, None]
    result[:, :, 1] += 0.2 * np.sin(3.1 * times + 1)[:, None]
    swing = 0.2 * np.sin(5.0 * times)[:, None]
    result[:, 2:5, 0] += swing
    result[:, 5:8, 0] -= swing
    return result


def seen_by(points_up: np.ndarray, rig: Rig, zup_from_master: np.ndarray) -> np.ndarray:
    """Keypoints (T, C, 135, 3) of points (T, 135, 3) z up, confidence 0.9."""
    in_master = apply(invert(zup_from_master), points_up.reshape(-1, 3))
    pixels = reproject(in_master, rig).reshape(len(points_up), -1, len(rig), 2)
    confidence = np.full((*pixels.shape[:3], 1), 0.9)
    return np.swapaxes(np.concatenate([pixels, confidence], -1), 1, 2)


def write_detections(
    path: Path,
    rig: Rig,
    people: list[list[list[np.ndarray]]],
    candidates: dict[tuple[int, int], list[tuple[str, bytes]]] | None = None,
    note: str = "",
    sequence: str = "test",
) -> Path:
    """Write a detections artefact; ``people[t][c]`` lists (135, 3) arrays, ``note`` is of the
    second camera."""
    sets, views = len(people), len(rig)
    with artefacts.write(path, DETECTIONS, sequence=sequence) as writer:
        writer.put("camera_names", list(rig.names))
        writer.put("colour_size", np.array([(c.colour.width, c.colour.height) for c in rig]))
        writer.put("note", [note if c == 1 else "" for c in range(views)])
        writer.put("keypoints_found", np.ones((sets, views), bool))
        writer.put("candidates_found", np.ones((sets, views), bool))
        for c, name in enumerate(rig.names):
            group = f"cameras/{name}"
            found = [p for t in range(sets) for p in people[t][c]]
            kept = [i for t in range(sets) for i in (candidates or {}).get((t, c), [])]
            counts = [len((candidates or {}).get((t, c), [])) for t in range(sets)]
            offsets, rle = artefacts.pack_ragged([i[1] for i in kept])
            writer.put(
                f"{group}/people_offsets", np.cumsum([0] + [len(people[t][c]) for t in range(sets)])
            )
            writer.put(f"{group}/people", np.array(found).reshape(-1, 135, 3))
            writer.put(f"{group}/candidate_offsets", np.cumsum([0, *counts]))
            writer.put(f"{group}/candidate_labels", [i[0] for i in kept])
            writer.put(f"{group}/candidate_scores", np.full(len(kept), 0.5))
            writer.put(f"{group}/candidate_boxes", np.zeros((len(kept), 4)))
            writer.put(f"{group}/rle_offsets", offsets)
            writer.put(f"{group}/rle", rle)
    return path
