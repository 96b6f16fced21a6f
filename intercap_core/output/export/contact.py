"""Contact as the joint stage states it, a table by frame and a draft of the annotation; and by the
meshes, vertex by vertex."""

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
from intercap_core.schemas import JOINT, METRICS

TOUCHING = 0.5  # a region is said to touch where this or more is its probability

_DRAFT_HEAD = """\
# Draft of the contact of {sequence}, as the joint stage states it: correct it, and copy it to
# annotations/{sequence}.yaml. Frames are numbered from 0; an interval's end is the first frame
# after it. Beside each interval: mean and least probability over its frames{annotated}.
"""


@dataclass(frozen=True, eq=False)
class StatedContact:
    """``probability`` (T, R) that each of the ``regions`` touches, and ``annotated`` (T, R): 1
    touching, 0 not, -1 not annotated."""

    sequence: str
    regions: tuple[str, ...]
    probability: np.ndarray
    annotated: np.ndarray

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

    def intervals(self) -> list[tuple[str, int, int]]:
        """Region, first frame and first frame after it, of each stated contact, by region."""
        found = []
        for r, region in enumerate(self.regions):
            on = np.concatenate([[False], self.probability[:, r] >= TOUCHING, [False]])
            changes = np.flatnonzero(np.diff(on.astype(np.int8)))
            found += [(region, int(a), int(b)) for a, b in changes.reshape(-1, 2)]
        return found


def write(folder: Path, stated: StatedContact, touching: TouchingSurfaces) -> None:
    """Write ``contact.tsv``, ``annotation_draft.yaml`` and ``contact_vertices.npz``, which says by
    frame which vertices ``touching`` has, into the new ``folder``."""
    folder.mkdir()
    np.savez(
        folder / "contact_vertices.npz",
        allow_pickle=False,
        **touching.arrays(),
        frame=np.array("none: numbers of vertices, and signed distances"),
        units=np.array("metres"),
    )
    (folder / "contact.tsv").write_text(table(stated), encoding="utf-8")
    (folder / "annotation_draft.yaml").write_text(draft(stated), encoding="utf-8")


def table(stated: StatedContact) -> str:
    """Tab-separated: one row a frame and region; what was not annotated has no label."""
    labels = {1: "1", 0: "0", -1: ""}
    rows = ["frame\tregion\tprobability\tannotated"]
    for t, (probability, annotated) in enumerate(
        zip(stated.probability, stated.annotated, strict=True)
    ):
        rows += [
            f"{t}\t{region}\t{p:.4f}\t{labels[int(label)]}"
            for region, p, label in zip(stated.regions, probability, annotated, strict=True)
        ]
    return "\n".join(rows) + "\n"


def draft(stated: StatedContact) -> str:
    """An annotation file with the stated contact, which the project's reader takes."""
    known = (stated.annotated >= 0).any()
    head = _DRAFT_HEAD.format(
        sequence=stated.sequence,
        annotated=";\n# this sequence's annotation is part of the evidence" if known else "",
    )
    intervals = stated.intervals()
    if not intervals:
        return head + "# Nothing touches.\ncontact: []\n"
    lines = []
    for region, start, end in intervals:
        p = stated.probability[start:end, stated.regions.index(region)]
        lines.append(
            f"  - {{part: {region}, start: {start}, end: {end}}}"
            f"  # {p.mean():.2f}, least {p.min():.2f}\n"
        )
    return head + "contact:\n" + "".join(lines)


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
