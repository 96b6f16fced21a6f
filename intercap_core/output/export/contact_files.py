"""Contact as files: a table by frame and body region, vertices in contact, a draft annotation."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core.output.export.contact import StatedContact
from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.motion import Coordinates

_DRAFT_HEADER = """\
# Draft of the contact of {sequence}, as the joint stage states it: correct it, and copy it to
# annotations/{sequence}.yaml. Frames are numbered from 0; an interval's end is the first frame
# after it. Ends marked "uncertain" may be moved by the observed distance; remove the mark from ends
# that you correct. The comment after an interval is its mean and least probability{annotated}.
"""


def _write(folder: Path, content: Content) -> Coordinates:
    stated, touching = content.about.contact, content.about.touching
    assert stated is not None and touching is not None
    np.savez(
        folder / "contact_vertices.npz",
        allow_pickle=False,
        **touching.to_arrays(),
        frame=np.array("none: numbers of vertices, and signed distances"),
        units=np.array("metres"),
    )
    (folder / "contact.tsv").write_text(table(stated), encoding="utf-8")
    (folder / "annotation_draft.yaml").write_text(draft(stated), encoding="utf-8")
    return Coordinates(
        "none: numbers of vertices and regions, distances in metres", np.full(3, np.nan)
    )


def table(stated: StatedContact) -> str:
    """Format as tab-separated text with a row per frame and region."""
    labels = {1: "1", 0: "0", -1: ""}
    rows = [
        f"{t}\t{region}\t{p:.4f}\t{labels[int(label)]}\n"
        for t, frame in enumerate(zip(stated.probability, stated.annotated, strict=True))
        for region, p, label in zip(stated.regions, *frame, strict=True)
    ]
    return "frame\tregion\tprobability\tannotated\n" + "".join(rows)


def draft(stated: StatedContact) -> str:
    """Format as an annotation file that the project can read."""
    known = (stated.annotated >= 0).any()
    header = _DRAFT_HEADER.format(
        sequence=stated.sequence,
        annotated=";\n# this sequence's annotation is part of the evidence" if known else "",
    )
    intervals = stated.intervals()
    if not intervals:
        return header + "# Nothing touches.\ncontact: []\n"
    lines = []
    for interval in intervals:
        start, end = interval.start, interval.end
        p = stated.probability[start:end, stated.regions.index(interval.part)]
        doubt = f", uncertain: {interval.uncertain}" if interval.uncertain else ""
        lines.append(
            f"  - {{part: {interval.part}, start: {start}, end: {end}{doubt}}}"
            f"  # {p.mean():.2f}, least {p.min():.2f}\n"
        )
    return header + "contact:\n" + "".join(lines)


_README = """
contact/contact.tsv           by frame and body region: probability that it touches the object, as
  the joint stage states it; annotated = 1 touching, 0 not, empty = not annotated
contact/contact_vertices.npz  by frame the vertices that touch, by the meshes, as below
contact/annotation_draft.yaml the same as intervals, in the format of an annotation file
"""
FORMATS = (
    ExportFormat(
        name="contact",
        content="contact by frame and region, and the vertices that touch",
        includes="*/export/contact/*.tsv",
        media_type="text/tab-separated-values",
        readme=_README,
        write=_write,
        needs_object=True,
    ),
)
