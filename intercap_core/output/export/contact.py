"""Contact by body region (probability of the joint fit) and by vertex (distance of the meshes)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from intercap_core import artefacts
from intercap_core.annotation import ContactInterval
from intercap_core.errors import UserError
from intercap_core.evaluation.contact import vertex_contact
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.time_series import runs
from intercap_core.output.export.motion import Motion
from intercap_core.schemas import CONTACT_M, JOINT, METRICS

_UNCERTAIN: dict[tuple[bool, bool], Literal["start", "end", "both"] | None] = {
    (True, True): None,
    (False, True): "start",
    (True, False): "end",
    (False, False): "both",
}  # by whether start and end are exact


@dataclass(frozen=True, eq=False)
class StatedContact:
    """Contact of R body regions with the object over T frames, as the joint stage states it."""

    sequence: str
    regions: tuple[str, ...]
    """Names of the R regions."""
    probability: np.ndarray
    """(T, R) probability that each region touches the object."""
    annotated: np.ndarray
    """(T, R) annotation: 1 touching, 0 not touching, -1 not annotated."""

    @classmethod
    def read(cls, joint: Path) -> StatedContact:
        """Read a joint artefact; raises UserError as reading does."""
        with artefacts.read(joint, JOINT) as fit:
            return cls(
                str(fit.attributes["sequence"]),
                tuple(fit.text("region_names")),
                fit["contact_probability"],
                fit["contact_annotated"],
            )

    def intervals(self) -> list[ContactInterval]:
        """Return each contact, region by region.

        In the frames from start to end - 1, the probability is at least 0.5. Ends are uncertain
        unless an annotation states them exactly.
        """
        intervals = []
        for region, p in zip(self.regions, self.probability.T, strict=True):
            steps = np.diff(np.concatenate([[0.0], p, [0.0]]))
            exact = abs(steps) == 1  # before each frame: from 0 to 1 or back
            for first, last in runs(p >= 0.5):
                uncertain = _UNCERTAIN[bool(exact[first]), bool(exact[last + 1])]
                intervals.append(
                    ContactInterval(part=region, start=first, end=last + 1, uncertain=uncertain)
                )
        return intervals


@dataclass(frozen=True, eq=False)
class VertexRuns:
    """Vertices of one surface that touch the other surface, concatenated over T frames.

    The vertices of frame t are ``vertices[offsets[t] : offsets[t + 1]]``.
    """

    offsets: np.ndarray
    """(T + 1,) int64."""
    vertices: np.ndarray
    """(N,) int32 vertex indices."""
    distance: np.ndarray
    """(N,) float32 signed distance to the faced part of the other surface, metres, negative
    inside."""

    @classmethod
    def of(cls, blocks: Iterable[np.ndarray]) -> VertexRuns:
        """Select vertices in contact by contact distances (T, V), metres, in blocks of frames."""
        parts = []
        for distance in blocks:
            touching = vertex_contact(distance)
            vertices = np.nonzero(touching)[1].astype(np.int32)
            parts.append((touching.sum(1), vertices, distance[touching].astype(np.float32)))
        counts, vertices, near = map(np.concatenate, zip(*parts, strict=True))
        return cls(np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), vertices, near)

    def at(self, t: int) -> np.ndarray:
        """Return the indices of the vertices that touch in frame ``t``."""
        return self.vertices[self.offsets[t] : self.offsets[t + 1]]


@dataclass(frozen=True, eq=False)
class ContactVertices:
    """Vertices of the body that touch the object, and of the object that touch the body."""

    body: VertexRuns
    object_: VertexRuns

    @classmethod
    def read(cls, metrics: Path, motion: Motion, mesh: ObjectMesh) -> ContactVertices:
        """Read a metrics artefact of the motion.

        Raises UserError if it was measured with another body, object or number of frames, and as
        reading does.
        """
        surfaces = []
        with artefacts.read(metrics, METRICS) as artefact:
            for name, surface, count in (
                ("body", f"the body in {motion.model.path.name}", motion.model.num_vertices),
                ("object", f"the mesh of object {mesh.name!r}", len(mesh.vertices)),
            ):
                key = f"{name}_contact_distance"
                if key not in artefact:
                    raise UserError(
                        f"{metrics}: has no {key}, although sequence {motion.sequence!r} has an "
                        "object; re-run stage 'metrics'"
                    )
                (frames, vertices), *_ = artefact.describe(key)
                if (frames, vertices) != (len(motion), count):
                    raise UserError(
                        f"{metrics}: {key} has {frames} frames of {vertices} "
                        f"vertices, but sequence {motion.sequence!r} has {len(motion)} frames and "
                        f"{surface} has {count} vertices: it was measured on another result; "
                        "re-run stage 'metrics'"
                    )
                surfaces.append(VertexRuns.of(artefact.blocks(key)))
        return cls(*surfaces)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Serialize for npz files."""
        arrays = {"contact_threshold_m": np.array(CONTACT_M)}
        for name, surface in (("body", self.body), ("object", self.object_)):
            arrays |= {
                f"{name}_contact_offsets": surface.offsets,
                f"{name}_contact_vertices": surface.vertices,
                f"{name}_contact_distance": surface.distance,
            }
        return arrays
