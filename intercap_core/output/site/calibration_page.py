"""Page on a calibration: the cameras from above and from the side, their accuracy, what to do."""

from __future__ import annotations

from html import escape

import numpy as np

from intercap_core.calibrate.found_rig import FoundRig
from intercap_core.output.site import embed
from intercap_core.output.site.capture_pictures import camera_colour

_SIZE = (460, 400)  # px of a drawing
_LONG_M = 0.45  # length of a drawn camera's view


def calibration_page(
    name: str, found: FoundRig, up: np.ndarray, rows: list[dict[str, str]], advice: list[str]
) -> str:
    """HTML page of a calibration.

    Args:
        up: (3,) up direction, master frame.
        rows: table of the cameras.
        advice: sentences on what to record for weak cameras.
    """
    pairs = [
        {
            "name": " and ".join(found.rig.names[c] for c in pair.cameras),
            "joints": str(pair.joints),
            "boards": str(pair.boards or ""),
            "error": "–" if np.isnan(pair.error_px) else f"{pair.error_px:.1f}",
        }
        for pair in found.pairs
    ]
    return embed.render(
        "calibration.html.j2",
        {
            "name": name,
            "drawings": [
                ("from above", _draw(found, up, 0)),
                ("from the side", _draw(found, up, 1)),
            ],
            "legend": [(n, camera_colour(c)) for c, n in enumerate(found.rig.names)],
            "scale": found.scale,
            "cameras": rows,
            "pairs": pairs,
            "advice": advice,
        },
    )


def _axes(found: FoundRig, up: np.ndarray) -> np.ndarray:
    """Rows (3, 3): right, ahead and up of the drawings in the master's frame."""
    ahead = found.rig.master_from_colour[0, :3, 2]
    ahead = ahead - (ahead @ up) * up
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    return np.stack([np.cross(ahead, up), ahead, up])


def _draw(found: FoundRig, up: np.ndarray, side: int) -> str:
    """SVG of cameras and the person's way, from above (0) or from the side (1)."""
    axes = _axes(found, up)[[0, 1] if side == 0 else [0, 2]]
    poses = found.rig.master_from_colour
    walk = found.walk[np.isfinite(found.walk[:, 0])]
    corners = []
    for camera, pose in zip(found.rig, poses, strict=True):
        lens = camera.colour
        u, v = lens.width - 1.0, lens.height - 1.0
        rays = lens.unproject(np.array([[0, 0], [u, 0], [u, v], [0, v]]))
        ends = pose[:3, 3] + _LONG_M * rays @ pose[:3, :3].T
        corners.append(np.concatenate([pose[None, :3, 3], ends]))
    everything = np.concatenate([*corners, walk]) @ axes.T
    low, high = everything.min(0), everything.max(0)
    margin = 30
    scale = min(
        (size - 2 * margin) / max(e, 0.5) for size, e in zip(_SIZE, high - low, strict=True)
    )

    def at(points: np.ndarray) -> np.ndarray:
        flat = (points @ axes.T - (low + high) / 2) * scale
        return np.asarray(_SIZE) / 2 + flat * (1, -1)

    view = "from above" if side == 0 else "from the side"
    parts = [f'<svg viewBox="0 0 {_SIZE[0]} {_SIZE[1]}" role="img" aria-label="Cameras {view}">']
    if len(walk):
        way = " ".join(f"{x:.1f},{y:.1f}" for x, y in at(walk))
        parts.append(f'<polyline points="{way}" fill="none" stroke="currentColor" opacity="0.35"/>')
    for c, outline in enumerate(corners):
        points, colour = at(outline), camera_colour(c)
        for k in range(4):
            triangle = points[[0, 1 + k, 1 + (k + 1) % 4]]
            shape = " ".join(f"{x:.1f},{y:.1f}" for x, y in triangle)
            parts.append(
                f'<polygon points="{shape}" fill="{colour}" fill-opacity="0.25" stroke="{colour}"/>'
            )
        x, y = points[0]
        parts.append(
            f'<text x="{x:.1f}" y="{y - 8:.1f}" text-anchor="middle" fill="currentColor" '
            f'font-size="12">{escape(found.rig.names[c])}</text>'
        )
    bar = scale  # one metre
    bottom = _SIZE[1] - 10
    parts.append(
        f'<path d="M10 {bottom}h{bar:.1f}" stroke="currentColor"/>'
        f'<text x="10" y="{bottom - 5}" fill="currentColor" font-size="11">1 m</text></svg>'
    )
    return "".join(parts)
