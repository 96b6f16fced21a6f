"""Contact as the joint stage states it, a table by frame and a draft of the annotation; and by the
meshes, vertex by vertex."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.output.export.touching import TouchingSurfaces
from intercap_core.schemas import JOINT

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
