"""Which vertices touch, frame by frame: of the body the object, of the object the body."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.evaluation.contact import CONTACT_M, vertex_contact
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export.motion import Motion
from intercap_core.schemas import METRICS


@dataclass(frozen=True, eq=False)
class Touching:
    """Vertices of one surface by frame, end to end: those of frame t are
    ``vertices[offsets[t] : offsets[t + 1]]``.

    ``offsets`` (T + 1,) int64, ``vertices`` (N,) int32 numbers from 0, ``distance`` (N,) float32 m,
    signed, to the other surface: negative inside it.
    """

    offsets: np.ndarray
    vertices: np.ndarray
    distance: np.ndarray

    @classmethod
    def of(cls, distance: np.ndarray) -> Touching:
        """From signed distances (T, V), metres: what is within ``CONTACT_M``, or inside."""
        touching = vertex_contact(distance)
        offsets = np.concatenate([[0], np.cumsum(touching.sum(1))])
        return cls(
            offsets.astype(np.int64),
            np.nonzero(touching)[1].astype(np.int32),
            distance[touching].astype(np.float32),
        )

    def at(self, t: int) -> np.ndarray:
        """Numbers of the vertices that touch in frame ``t``."""
        return self.vertices[self.offsets[t] : self.offsets[t + 1]]


@dataclass(frozen=True, eq=False)
class TouchingSurfaces:
    """Of ``body`` and ``object_`` what touches the other."""

    body: Touching
    object_: Touching

    @classmethod
    def read(cls, metrics: Path, motion: Motion, mesh: ObjectMesh) -> TouchingSurfaces:
        """From a metrics artefact of the motion.

        Raises UserError where it was measured with another body, another object or on other frames
        than the motion's, besides what reading raises.
        """
        found = []
        with artefacts.read(metrics, METRICS) as artefact:
            for key, what, count in (
                (
                    "body_to_object",
                    f"the body in {motion.model.path.name}",
                    motion.model.num_vertices,
                ),
                ("object_to_body", f"the mesh of object {mesh.name!r}", len(mesh.vertices)),
            ):
                if key not in artefact:
                    raise UserError(
                        f"{metrics}: holds no {key}, though sequence {motion.sequence!r} has an "
                        "object; re-run stage 'metrics'"
                    )
                distance = artefact[key]
                if distance.shape != (len(motion), count):
                    raise UserError(
                        f"{metrics}: {key} has {distance.shape[0]} frames of {distance.shape[1]} "
                        f"vertices, but sequence {motion.sequence!r} has {len(motion)} frames and "
                        f"{what} {count} vertices: it was measured on another result; re-run stage "
                        "'metrics'"
                    )
                found.append(Touching.of(distance))
        return cls(*found)

    def arrays(self) -> dict[str, np.ndarray]:
        """As arrays, by the names that go with every export."""
        found = {"contact_threshold_m": np.array(CONTACT_M)}
        for name, surface in (("body", self.body), ("object", self.object_)):
            found |= {
                f"{name}_contact_offsets": surface.offsets,
                f"{name}_contact_vertices": surface.vertices,
                f"{name}_contact_distance": surface.distance,
            }
        return found

    def told(self) -> dict[str, Any]:
        """In the words of JSON; distances by vertex are left to the arrays."""
        found: dict[str, Any] = {"contact_threshold_mm": 1e3 * CONTACT_M}
        for name, surface in (("body", self.body), ("object", self.object_)):
            found |= {
                f"{name}_contact_offsets": surface.offsets.tolist(),
                f"{name}_contact_vertices": surface.vertices.tolist(),
            }
        return found
