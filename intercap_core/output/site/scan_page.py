"""Page on a scanned object: its colours and its unmeasured parts from six sides, and figures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.output.site import drawing, embed
from intercap_core.scan.result import ScannedMesh

_SIZE = 320  # px of a picture
_MEASURED, _UNMEASURED = (0.75, 0.75, 0.75), (0.90, 0.35, 0.05)  # grey and orange
_SIDES = {
    "from the front": (0, 1, 0),
    "from the right": (-1, 0, 0),
    "from behind": (0, -1, 0),
    "from the left": (1, 0, 0),
    "from above": (0, 0, -1),
    "from below": (0, 0, 1),
}


def scan_page(name: str, sequences: Sequence[str], mesh: ScannedMesh) -> str:
    """HTML page of a scan: pictures in the object's colours, then in those of the measurement."""
    measurement = np.where(mesh.measured[:, None], _MEASURED, _UNMEASURED)
    return embed.render(
        "scan.html.j2",
        {
            "name": name,
            "sequences": sequences,
            "pictures": [_picture(mesh, mesh.colours / 255.0, side) for side in _SIDES],
            "measurement": [_picture(mesh, measurement, side) for side in _SIDES],
            "figures": mesh.figures(),
        },
    )


def _picture(mesh: ScannedMesh, colours: np.ndarray, side: str) -> drawing.EncodedImage:
    """Picture of the mesh from one side; ``colours``: (V, 3) RGB in 0..1."""
    away = 2.5 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    direction = np.array(_SIDES[side], float)
    up = np.array([0.0, 1, 0]) if direction[2] else np.array([0.0, 0, 1])
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    pose = drawing.look_at(middle, direction, up, away)
    lens = drawing.pinhole(_SIZE, _SIZE, 2.2 * _SIZE)
    drawn = drawing.draw(
        [drawing.ColouredMesh(mesh.vertices, mesh.faces, pose, colours=colours)], lens
    )
    return drawing.encode_jpeg(drawn.over(np.ones((_SIZE, _SIZE, 3))), side)
