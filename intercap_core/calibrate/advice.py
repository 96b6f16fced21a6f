"""Instructions for cameras that are known inaccurately: where to walk or to hold a board."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.calibrate.found_rig import WEAK_M, FoundRig
from intercap_core.geometry.camera.rig import Camera, ring_centre
from intercap_core.geometry.camera.transforms import apply
from intercap_core.scene.ground import GroundPlane

_BODY_HEIGHTS_M = (0.1, 0.9, 1.7)  # points of a standing person
_BOARD_HEIGHT_M = 1.2  # of a board that is held
_NEAR_M, _FAR_M = 0.8, 6.0  # distance at which a person or a board is detected
_REACH_M, _STEP_M = 4.0, 0.25  # half side and step of the grid of places
_NEW_M = 0.5  # from the person's way; nearer places add the same views
_MIDDLE_M = 1.0  # height of the rig's centre if the floor is unknown: the middle of a body


@dataclass(frozen=True, eq=False)
class Advice:
    """One instruction."""

    text: str
    camera: str = ""
    """Name of the weak camera; "" = not about one camera."""
    place: np.ndarray | None = None
    """(3,) place on the floor, master frame, metres; None = no place."""


def advise(found: FoundRig, ground: GroundPlane, up: np.ndarray) -> list[Advice]:
    """Notes, then an instruction for the scale if it is weak, then one for each weak camera.

    Args:
        ground: floor; without one, the rig's centre is assumed 1 m above the floor.
        up: (3,) up direction, master frame.
    """
    advice = [Advice(note) for note in found.notes]
    poses = found.rig.master_from_colour
    by_scale = found.scale_sigma * np.linalg.norm(poses[:, :3, 3], axis=1)
    sigma = np.array([found.sigma_m(c) for c in range(len(poses))])
    if (by_scale > WEAK_M).any():
        advice.append(
            Advice(
                f"The scale is known to {100 * found.scale_sigma:.1f} % only. State the measured "
                "distance of two cameras (--distance), show a board, or state the subject's height "
                "if the table of subjects lacks it."
            )
        )
    places = _floor_places(found, ground, up)
    apart = np.sqrt(np.maximum(sigma**2 - by_scale**2, 0))  # from the scale
    for c in np.flatnonzero(apart > WEAK_M).tolist():
        advice.append(_advise_camera(found, c, 1e3 * apart[c], places, up))
    return advice


def _floor_places(found: FoundRig, ground: GroundPlane, up: np.ndarray) -> np.ndarray:
    """Grid (N, 3) on the floor around the rig's centre, master frame."""
    centre = ring_centre(found.rig)
    height = (centre - ground.point) @ ground.normal if ground.found else _MIDDLE_M
    along = np.linalg.svd(up[None])[2][1:]
    steps = np.arange(-_REACH_M, _REACH_M + _STEP_M / 2, _STEP_M)
    grid = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    return np.asarray(centre - height * up + grid @ along)


def _sees(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Mask (N,) of places all of whose points (N, H, 3), master frame, are in the image."""
    lens = camera.colour
    x, y, z = np.moveaxis(
        apply(camera.colour_from_master, points.reshape(-1, 3)).reshape(points.shape), -1, 0
    )
    ahead = np.maximum(z, 1e-6)
    u, v = lens.fx * x / ahead + lens.cx, lens.fy * y / ahead + lens.cy
    inside = (u > 0) & (u < lens.width) & (v > 0) & (v < lens.height)
    return np.asarray((inside & (z > _NEAR_M) & (z < _FAR_M)).all(1))


def _advise_camera(
    found: FoundRig, c: int, sigma_mm: float, places: np.ndarray, up: np.ndarray
) -> Advice:
    """Instruct to walk, or else to hold a board, where camera c and another one see.

    The other one is the camera with which it shares the least evidence.

    Args:
        sigma_mm: standard deviation of the camera, without that of the scale.
        places: (N, 3) candidates on the floor, master frame, metres.
        up: (3,) up direction, master frame.
    """
    name, names = found.rig.names[c], found.rig.names
    known = f"{name} is known to {sigma_mm:.0f} mm only"
    known += ", without the error of the scale." if found.scale_sigma else "."
    shared = {pair.cameras: (pair.boards, pair.joints) for pair in found.residuals.pairs}
    for heights in (_BODY_HEIGHTS_M, (_BOARD_HEIGHT_M,)):
        points = places[:, None] + np.array(heights)[:, None] * up
        seen = np.array([_sees(camera, points) for camera in found.rig])
        partners = [p for p in range(len(names)) if p != c and (seen[c] & seen[p]).sum() >= 4]
        if not partners:
            continue
        partner = min(partners, key=lambda p: sum(shared.get((min(c, p), max(c, p)), (0, 0))))
        boards, joints = shared.get((min(c, partner), max(c, partner)), (0, 0))
        place = _choose(places[seen[c] & seen[partner]], found.residuals.walk, up)
        where = _describe_place(found.rig[c], place, up)
        todo = f"Hold a board {_BOARD_HEIGHT_M:g} m above the floor, {where}, where both see it."
        if heights == _BODY_HEIGHTS_M:
            todo = (
                f"Walk to and fro {where} (cross in the picture), where both see the whole body, "
                "or hold a board there."
            )
        few = f"It shares least with {names[partner]}: {joints} joints and {boards} boards."
        return Advice(f"{known} {few} {todo}", name, place)
    return Advice(f"{known} No other camera sees a place that it sees: turn it, or add a camera.")


def _choose(places: np.ndarray, walk: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The middle one of places (N, 3) away from the person's way (T, 3), or of all places."""
    walk = walk[np.isfinite(walk[:, 0])]
    if len(walk):
        apart = places[:, None] - walk
        apart -= (apart @ up)[..., None] * up
        new = np.linalg.norm(apart, axis=-1).min(1) > _NEW_M
        places = places[new] if new.any() else places
    return np.asarray(places[np.linalg.norm(places - places.mean(0), axis=1).argmin()])


def _describe_place(camera: Camera, place: np.ndarray, up: np.ndarray) -> str:
    """Describe a place (3,) relative to a camera's view, along the floor."""
    pose = camera.master_from_colour
    ahead = pose[:3, 2] - (pose[:3, 2] @ up) * up
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    offset = place - pose[:3, 3]
    aside = float(offset @ np.cross(ahead, up))
    side = "right" if aside > 0 else "left"
    return f"{offset @ ahead:.1f} m in front of {camera.name} and {abs(aside):.1f} m to its {side}"


def describe_floor(ground: GroundPlane, source: str, deviation_deg: float, master: str) -> str:
    """State how the up direction is known, and the floor's height below the master's lens."""
    text = f"up by {source}"
    if np.isfinite(deviation_deg):
        text += f", to {deviation_deg:.1f} degrees"
    if not ground.found:
        return f"{text}; the floor is unknown, since no feet were seen"
    height = -ground.point @ ground.normal
    return f"{text}; the floor under the feet is {height:.2f} m below the lens of {master}"
