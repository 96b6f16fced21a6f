"""Page of one sequence: an HTML file, which loads the 4D viewer from the same folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from markupsafe import Markup

from intercap_core.annotation import ContactInterval
from intercap_core.evaluation import figures, flags
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.physics.carriers import Carrier
from intercap_core.evaluation.verdict.figures import stated_errors
from intercap_core.flags import OF_OBJECT, PARTS
from intercap_core.geometry.solve import time_series
from intercap_core.output.site import charts, measures
from intercap_core.output.site.drawing import EncodedImage
from intercap_core.output.site.embed import css, render, span, tile
from intercap_core.output.site.overlays import BODY_COLOUR, OBJECT_COLOUR, Preview
from intercap_core.output.viewer import page as viewer
from intercap_core.schemas import METRIC_REGIONS
from intercap_core.versions import versions


@dataclass(frozen=True, eq=False)
class SequenceContent:
    """Content of a sequence's page."""

    metrics: SequenceMetrics
    intent: str
    """Instruction to the person, "" if not stated."""
    overlays: Mapping[str, Mapping[int, EncodedImage]]
    """Fit over the images, by camera and frame."""
    preview: Preview | None
    """Animation at the top of the page; None without images."""
    note: str
    """Why there are no overlays."""
    joint: str
    energies: Sequence[tuple[str, float, float]]
    """Name of each energy term with its values before and after the joint fit."""
    closeups: Sequence[EncodedImage]
    capture: dict[str, Any]
    track: dict[str, Any] | None
    """Variables of the section on the track, None without an object."""
    body: dict[str, Any]
    annotated: Sequence[ContactInterval] | None
    made_by: Mapping[str, str]
    """Schema version and digest of settings by stage."""
    body_file: str


def page(content: SequenceContent) -> str:
    """Return the HTML of the page."""
    s = content.metrics
    flagged = s.flags.texts()
    cameras = [
        [
            replace(
                picture,
                caption=f"camera {camera}, frame {t}"
                + (f", not reliable: {flagged[t]}" if flagged[t] else ""),
            )
            for t, picture in pictures.items()
        ]
        for camera, pictures in content.overlays.items()
    ]
    context = {
        **vars(content),
        "name": s.name,
        "subject": s.subject,
        "object": s.object_,
        "frames": len(s),
        "fps": s.fps,
        "tiles": _tiles(s),
        "timeline": charts.timeline(_rows(s, content.annotated), len(s)),
        "annotated": content.annotated is not None,
        "residuals": _residuals(s),
        "verdict": measures.verdict([s], {s.name}),
        "truth": measures.truth([s]),
        "flagged_runs": [
            (span(first, last), reason) for first, last, reason in flags.ranges(flagged)
        ],
        "flagged_text": s.flags.summary(),
        "energies": _energies(content.energies),
        "physics_note": s.physics_note,
        "cameras": cameras,
        "colours": [
            ("body", css(BODY_COLOUR)),
            *([("object", css(OBJECT_COLOUR))] if s.object_ else []),
        ],
        "made_by": list(content.made_by.items()),
        "versions": [*versions(), ("body file", content.body_file)],
        "policy": viewer.POLICY,
        "viewer_style": Markup(viewer.style()),
        "viewer": {"element": Markup(viewer.element()), "load": Markup(viewer.load())},
    }
    return render("sequence.html.j2", context)


def _tiles(s: SequenceMetrics) -> list[dict[str, str]]:
    tiles = [
        tile(
            f"{error.part}, estimated error",
            error.stated,
            "mm",
            error.silent or f"without ground truth; range {measures.error_range(error)} mm",
        )
        for error in stated_errors(s)
    ]
    if s.has_truth:
        errors = figures.truth_figures([s], "joint")
        tiles.append(
            tile("body error", errors.get("body_pve_mm"), "mm", "per vertex, against ground truth")
        )
        if s.has_object:
            centre = errors.get("object_translation_mm")
            tiles.append(tile("object error", centre, "mm", "centre, median, against ground truth"))
    if s.has_object:
        share = 100 * float(s.values["contact_frame"].mean())
        tiles.append(tile("in contact", share, "%", "of the frames", 0))
    return tiles + measures.quality_tiles([s])


def _rows(
    s: SequenceMetrics, annotated: Sequence[ContactInterval] | None
) -> list[charts.TimelineRow]:
    """Return rows for flags, frames in contact, and contact of each region by source."""
    rows = []
    for part in PARTS:
        if s.has_object or part not in OF_OBJECT:
            found = flags.ranges(s.flags.reasons_of(part))
            marks = [(a, b, "fill flag", why) for a, b, why in found]
            rows.append(charts.TimelineRow(f"flagged, {part}", marks))
    annotated_runs: dict[str, list[tuple[int, int, str, str]]] = {}
    for interval in annotated or ():
        last = min(interval.end, len(s)) - 1
        if last >= interval.start:
            run = (interval.start, last, "fill annotated", "annotated")
            annotated_runs.setdefault(interval.part, []).append(run)
    if not s.has_object:
        return rows
    rows.append(charts.TimelineRow("in contact", _runs(s.values["contact_frame"])))
    if "physics/carrier" in s.values:
        carriers = [str(name) for name in s.values["physics/carrier"]]
        bad = (Carrier.UNSUPPORTED, Carrier.UNKNOWN)
        runs = [
            (a, b, "fill flag" if name in bad else "fill any", name)
            for a, b, name in flags.ranges(carriers)
        ]
        rows.append(charts.TimelineRow("carried by", runs))
    names = list(s.values["region_names"])
    if "any" in annotated_runs:
        rows.append(charts.TimelineRow("any part, annotated", annotated_runs["any"]))
    for region in METRIC_REGIONS:
        label = region.replace("_", " ")
        if region in annotated_runs:
            rows.append(charts.TimelineRow(f"{label}, annotated", annotated_runs[region]))
        stated = s.values["contact_probability"][:, names.index(region)]
        touching = s.values["region_contact"][:, names.index(region)]
        if (stated >= 0.5).any() or touching.any() or region in annotated_runs:
            runs = [
                (a, b, "hover", f"{100 * stated[a : b + 1].mean():.0f} %")
                for a, b in time_series.runs(stated >= 0.5)
            ]
            rows.append(charts.TimelineRow(f"{label}, estimated", runs, levels=stated))
        if touching.any():
            rows.append(charts.TimelineRow(f"{label}, from mesh distance", _runs(touching)))
    return rows


def _residuals(s: SequenceMetrics) -> list[tuple[str, str]]:
    """Return charts over the frames with their captions."""
    values = s.values
    stated = zip(
        values.get("verdict/part_names", ()), ("c1", "c3", "c2"),
        values.get("verdict/error_frame", ()), strict=False,
    )  # fmt: skip
    plots = []
    for lines, unit, caption in (
        (
            [
                ("body to point cloud", "c1", values.get("body_visible_to_cloud")),
                ("object to point cloud", "c2", values.get("object_visible_to_cloud")),
                ("penetration", "c3", values.get("penetration_mean")),
            ],
            "distance, mm",
            "Distance of visible surfaces to the point clouds; depth of the body in the object.",
        ),
        (
            [
                ("body", "c1", values.get("acceleration_body")),
                ("object", "c2", values.get("acceleration_object")),
            ],
            "acceleration, mm/frame²",
            "Second differences at 30 frames per second, which show jitter.",
        ),
        (
            list(stated),
            "estimated error, mm",
            "Estimated error (no ground truth) by frame; no line where there is no estimate.",
        ),
    ):
        series = [
            charts.Series(name, colour, np.arange(len(s)), 1e3 * metres.astype(np.float64))
            for name, colour, metres in lines
            if metres is not None and np.isfinite(metres).any()
        ]
        if series:
            plots.append((charts.frame_chart(series, len(s), unit), caption))
    return plots


def _energies(terms: Sequence[tuple[str, float, float]]) -> str:
    """Plot each term's share of the initial energy before and after the joint fit."""
    if not terms:
        return ""
    total = max(sum(before for _, before, _ in terms), 1e-12)
    return charts.bar_pairs(
        [
            charts.BarPair.change(name.replace("_", " "), 100 * before / total, 100 * after / total)
            for name, before, after in terms
            if max(before, after) > 0
        ],
        "% of the energy at the start",
    )


def _runs(mask: np.ndarray) -> list[tuple[int, int, str, str]]:
    """Return the runs of set frames (T,) for a row of the timeline."""
    return [(first, last, "fill any", "") for first, last in time_series.runs(mask)]
