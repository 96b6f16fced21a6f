"""Summaries, pages and the overview of captures whose metrics are there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from intercap_core.config import CardSettings, ExportSettings, PageSettings
from intercap_core.entries import SequenceEntry
from intercap_core.schemas import CONTACT_REGIONS
from intercap_core.stage_list import STAGES
from intercap_core.stages import dataset, page, summary
from tests.helpers import fitted_capture as fitted

TWO_CAPTURES = {"s01_o03": "football", "s01_o09": "cup"}  # sequence: object
HELD = "s01_o03"
INTENTS = {"s01_o03": "use", "s01_o09": "pass"}
FAILED = {"s03_o01": "k2.mkv: is cut after 3 s <and> more; record it again"}


def make_two_captures(folder: Path) -> None:
    """Write one sequence with truth, whose ball is held, and one without, whose cup is not."""
    for name, object_name in TWO_CAPTURES.items():
        (folder / name).mkdir(parents=True)
        made = fitted.make_capture(folder / name, name=name, object_name=object_name, total=4)
        with made.edit("joint") as file:
            hands = [CONTACT_REGIONS.index(f"{side}_hand") for side in ("left", "right")]
            for frames in (slice(2), 3):
                file["contact_probability"][frames, hands] = 0.9 if name == HELD else 0.1
        made.measure(truth=name == HELD)


def open_two_captures(folder: Path) -> dict[str, fitted.Capture]:
    """Return the captures that :func:`make_two_captures` has written."""
    return {
        name: fitted.open_capture(folder / name, object_name=object_name, total=4)
        for name, object_name in TWO_CAPTURES.items()
    }


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
    page.run(
        paths=capture.inputs(*STAGES["page"].reads),
        sequence=row(sequence, intent),
        models=capture.models,
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
        objects={of.name: of for capture in captures.values() if (of := capture.object_)},
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
