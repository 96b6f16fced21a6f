"""Summaries, pages and the overview of captures whose metrics are there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import h5py

from intercap_core.config import CardSettings, ExportSettings, MetricsSettings, PageSettings
from intercap_core.entries import SequenceEntry
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.schemas import CONTACT_REGIONS
from intercap_core.stage_list import STAGES
from intercap_core.stages import dataset, metrics, page, summary
from tests.helpers import fitted_capture as fitted

MEASURED = ("frames", "scene", "detections", "person", "object_track", "body_fit", "joint")
TWO_CAPTURES = {"s01_o03": "football", "s01_o09": "cup"}  # sequence: object
INTENTS = {"s01_o03": "use", "s01_o09": "pass"}
FAILED = {"s03_o01": "k2.mkv: is cut after 3 s <and> more; record it again"}


def make_two_captures(folder: Path) -> None:
    """Write one sequence with truth, whose ball is held, and one without, whose cup is not."""
    for name, object_name in TWO_CAPTURES.items():
        (folder / name).mkdir(parents=True)
        made = fitted.make_capture(folder / name, name=name, object_name=object_name, total=4)
        with h5py.File(made.paths["joint"], "r+") as file:
            hands = [CONTACT_REGIONS.index(f"{side}_hand") for side in ("left", "right")]
            file["contact_probability"][:2, hands] = 0.9 if object_name == "football" else 0.1
            file["contact_probability"][3, hands] = 0.9 if object_name == "football" else 0.1
        measure(made, truth=object_name == "football")


def open_two_captures(folder: Path) -> dict[str, fitted.Capture]:
    """Return the captures that :func:`make_two_captures` has written."""
    return {
        name: fitted.open_capture(folder / name, object_name=object_name, total=4)
        for name, object_name in TWO_CAPTURES.items()
    }


def measure(capture: fitted.Capture, *, truth: bool = False) -> None:
    """The capture's metrics."""
    metrics.run(
        paths=capture.inputs(*MEASURED),
        output=capture.paths["metrics"],
        models=capture.models,
        settings=MetricsSettings(),
        fit_settings=fitted.FIT_SETTINGS,
        truth=capture.paths["truth"] if truth else None,
    )


def write_summaries(
    captures: Mapping[str, fitted.Capture], out: Path, intents: Mapping[str, str] | None = None
) -> dict[str, Path]:
    """One summary artefact a capture, in ``out``."""
    paths = {}
    out.mkdir(parents=True, exist_ok=True)
    for name, capture in captures.items():
        paths[name] = out / f"{name}.h5"
        summary.run(
            paths=capture.inputs(*STAGES["summary"].reads),
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
    """Write summaries, pages and the overview of a dataset into the folder ``out``."""
    for sequence, capture in captures.items():
        write_page(capture, out, sequence, (intents or {}).get(sequence), settings)
    merge(write_summaries(captures, out / "summaries", intents), captures, out, name, failed)
    return out


def write_page(
    capture: fitted.Capture,
    out: Path,
    sequence: str,
    intent: str | None = None,
    settings: PageSettings | None = None,
) -> None:
    """A sequence's page, in the site of the folder ``out``."""
    measured = SequenceMetrics.read(capture.paths["metrics"])
    page.run(
        paths=capture.inputs(*STAGES["page"].reads),
        sequence=row(sequence, intent),
        models=replace(capture.models, object_=capture.object_ if measured.object_ else None),
        contact=None,
        settings=settings or PageSettings(),
        output=out / "site" / "sequences" / sequence,
        truth=capture.paths["truth"],
    )


def merge(
    summaries: Mapping[str, Path],
    captures: Mapping[str, fitted.Capture],
    out: Path,
    name: str = "demo",
    failed: Mapping[str, str] | None = None,
    card: CardSettings | None = None,
) -> Path:
    """Write the overview, summary and tables of a dataset; returns the page."""
    return dataset.run(
        dataset=name,
        summaries=summaries,
        objects={capture.object_.name: capture.object_ for capture in captures.values()},
        body_models=fitted.BODY_MODELS,
        results=out,
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
