"""Summaries, pages and the overview of captures whose metrics are there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from intercap_core.config import CardSettings, ExportSettings, PageSettings, SequenceEntry
from intercap_core.metrics.figures import SequenceMetrics
from intercap_core.stage_list import STAGES
from intercap_core.stages import dataset, page, summary
from tests.helpers import fitted_capture as fitted


def write_summaries(
    captures: Mapping[str, fitted.Capture], out: Path, intents: Mapping[str, str] | None = None
) -> dict[str, Path]:
    """One summary artefact a capture, in ``out``."""
    paths = {}
    out.mkdir(parents=True, exist_ok=True)
    for name, capture in captures.items():
        paths[name] = out / f"{name}.h5"
        summary.run(
            **capture.inputs(*STAGES["summary"].reads),
            sequence=row(name, (intents or {}).get(name)),
            output=paths[name],
        )
    return paths


def write_site(
    captures: Mapping[str, fitted.Capture],
    out: Path,
    *,
    name: str = "demo",
    settings: PageSettings | None = None,
    failed: Mapping[str, str] | None = None,
    intents: Mapping[str, str] | None = None,
) -> Path:
    """Everything that is beside the artefacts of a dataset, in the folder ``out``."""
    for sequence, capture in captures.items():
        measured = SequenceMetrics.read(capture.paths["metrics"])
        page.run(
            **capture.inputs(*STAGES["page"].reads),
            sequence=row(sequence, (intents or {}).get(sequence)),
            object_=capture.object_ if measured.object_ else None,
            subject=fitted.SUBJECT,
            body_models=fitted.BODY_MODELS,
            contact=None,
            settings=settings or PageSettings(),
            output=out / "site" / "sequences" / sequence,
            truth=capture.paths["truth"],
        )
    merge(write_summaries(captures, out / "summaries", intents), captures, out, name, failed)
    return out


def merge(
    summaries: Mapping[str, Path],
    captures: Mapping[str, fitted.Capture],
    out: Path,
    name: str = "demo",
    failed: Mapping[str, str] | None = None,
    card: CardSettings | None = None,
) -> Path:
    """The overview and what lies beside it; returns the page."""
    return dataset.run(
        dataset=name,
        summaries=summaries,
        objects={capture.object_.name: capture.object_ for capture in captures.values()},
        body_models=fitted.BODY_MODELS,
        site=out / "site",
        summary=out / "summary.json",
        heatmaps=out / "heatmaps.h5",
        tables_folder=out / "tables",
        card=card or CardSettings(),
        formats=ExportSettings().formats,
        failed=failed,
    )


def row(name: str, intent: str | None = None) -> SequenceEntry:
    """The sequence's row of the table, of which pages and summaries read the intent alone."""
    return SequenceEntry(
        sequence=name, subject="p01", recordings=Path("none"), calibration=Path("none"),
        intent=intent,
    )  # fmt: skip
