"""Page on a calibration: the cameras from above and from the side, their accuracy, what to do."""

from __future__ import annotations

from typing import Any

import numpy as np

from intercap_core.calibrate.advice import Advice
from intercap_core.calibrate.found_rig import FoundRig
from intercap_core.output.site import embed
from intercap_core.output.site.capture_pictures import camera_colour

_SIZE = (460, 400)  # px of a drawing
_LONG_M = 0.45  # length of a drawn camera's view


def calibration_page(
    name: str,
    found: FoundRig,
    up: np.ndarray,
    rows: list[dict[str, str]],
    advice: list[Advice],
    floor: str,
) -> str:
    """HTML page of a calibration.

    Args:
        up: (3,) up direction, master frame.
        rows: table of the cameras.
        advice: what to record for weak cameras; its places are marked in the pictures.
        floor: sentence on the up direction and the floor.
    """
    pairs = [
        (
            " and ".join(found.rig.names[c] for c in pair.cameras),
            f"{1e3 * found.pair_sigma_m(*pair.cameras):.1f}",
            pair.joints,
            _number(pair.joint_px),
            pair.boards or "",
            _number(pair.corner_px),
            _number(1e3 * pair.background_m),
        )
        for pair in found.residuals.pairs
    ]
    return embed.render(
        "calibration.html.j2",
        {
            "name": name,
            "drawings": [
                ("from above", _drawing(found, up, 0, advice)),
                ("from the side", _drawing(found, up, 1, advice)),
            ],
            "legend": [(n, camera_colour(c)) for c, n in enumerate(found.rig.names)],
            "scale": found.scale,
            "cameras": [list(row.values()) for row in rows],
            "pairs": pairs,
            "advice": [item.text for item in advice],
            "floor": floor,
        },
    )


def _drawing(found: FoundRig, up: np.ndarray, side: int, advice: list[Advice]) -> dict[str, Any]:
    """Shapes, px, of the cameras, the person's way and the advised places.

    ``side``: from above (0) or from the side (1).
    """
    ahead = found.rig.master_from_colour[0, :3, 2]
    ahead = ahead - (ahead @ up) * up
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    axes = np.stack([np.cross(ahead, up), ahead if side == 0 else up])  # right, upwards (2, 3)
    poses = found.rig.master_from_colour
    walk = found.residuals.walk
    walk = walk[np.isfinite(walk[:, 0])]
    corners = []
    for camera, pose in zip(found.rig, poses, strict=True):
        lens = camera.colour
        u, v = lens.width - 1.0, lens.height - 1.0
        rays = lens.unproject(np.array([[0, 0], [u, 0], [u, v], [0, v]]))
        ends = pose[:3, 3] + _LONG_M * rays @ pose[:3, :3].T
        corners.append(np.concatenate([pose[None, :3, 3], ends]))
    marked = [item for item in advice if item.place is not None]
    places = np.array([item.place for item in marked]).reshape(-1, 3)
    everything = np.concatenate([*corners, walk, places]) @ axes.T
    low, high = everything.min(0), everything.max(0)
    margin = 30
    scale = min(
        (size - 2 * margin) / max(e, 0.5) for size, e in zip(_SIZE, high - low, strict=True)
    )

    def at(points: np.ndarray) -> np.ndarray:
        flat = (points @ axes.T - (low + high) / 2) * scale
        return np.asarray(_SIZE) / 2 + flat * (1, -1)

    cameras = []
    for c, outline in enumerate(corners):
        points = at(outline)
        sides = [_points(points[[0, 1 + k, 1 + (k + 1) % 4]]) for k in range(4)]
        cameras.append((found.rig.names[c], camera_colour(c), sides, points[0]))
    return {
        "size": _SIZE,
        "way": _points(at(walk)),
        "cameras": cameras,
        "marks": [(item.camera, xy) for item, xy in zip(marked, at(places), strict=True)],
        "metre": scale,
    }


def _points(places: np.ndarray) -> str:
    """Points (N, 2) of an SVG shape."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in places)


def _number(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.1f}"
