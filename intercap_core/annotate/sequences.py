"""The project's sequences, worst first, from what their summaries say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from intercap_core import artefacts
from intercap_core.annotate.questions import answers_path
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import stated_errors
from intercap_core.output.site.tables import sequence_table
from intercap_core.project import Project
from intercap_core.schemas import SUMMARY


class SequenceList:
    """Rows of all sequences; a summary is read again only where it is another file."""

    def __init__(self) -> None:
        self._known: dict[Path, tuple[tuple[int, int], SequenceMetrics | str]] = {}

    def rows(self, project: Project) -> list[dict[str, Any]]:
        """A row a sequence, worst first by the report's own rank, those without a result last."""
        rows, measured = [], []
        for name, row in project.sequences.items():
            found = self._summary(project.artefact(name, "summary"))
            annotation = project.annotation_path(name)
            one: dict[str, Any] = {
                "name": name, "subject": row.subject, "object": row.object or "", "rank": None,
                "annotated": annotation.is_file(),
                "answered": answers_path(annotation).is_file(),
                "frames_there": project.artefact(name, "frames").is_file(),
                "note": found if isinstance(found, str) else "",
            }  # fmt: skip
            if isinstance(found, SequenceMetrics):
                measured.append(found)
                one |= {
                    "frames": len(found),
                    "flagged": int(found.values["flagged"].sum()),
                    "errors": {
                        e.part: round(e.stated, 1) if e.stated == e.stated else None
                        for e in stated_errors(found)
                    },
                }
            rows.append(one)
        if measured:
            table = sequence_table(measured, {})
            ranks = dict(zip(table["sequence"], table["rank"], strict=True))
            for one in rows:
                one["rank"] = int(ranks[one["name"]]) if one["name"] in ranks else None
        return sorted(rows, key=lambda one: (one["rank"] is None, one["rank"] or 0))

    def _summary(self, path: Path) -> SequenceMetrics | str:
        """A sequence's figures, or why there are none."""
        try:
            stat = path.stat()
        except OSError:
            return "no result yet"
        stamp = stat.st_mtime_ns, stat.st_size
        known = self._known.get(path)
        if known is None or known[0] != stamp:
            try:
                with artefacts.read(path, SUMMARY) as artefact:
                    known = stamp, SequenceMetrics.of(artefact)
            except UserError as error:
                known = stamp, str(error)
            self._known[path] = known
        return known[1]
