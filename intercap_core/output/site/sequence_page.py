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
from intercap_core.geometry.solve.time_series import runs
from intercap_core.output.site import charts, measures
from intercap_core.output.site.drawing import EncodedImage
from intercap_core.output.site.embed import css, flag_tile, render, span, tile
from intercap_core.output.site.overlays import BODY_COLOUR, OBJECT_COLOUR
from intercap_core.output.site.preview import Preview
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
    """Summary of the joint fit."""
    energies: Sequence[tuple[str, float, float]]
    """Name of each energy term with its values before and after the joint fit."""
    closeups: Sequence[EncodedImage]
    capture: dict[str, Any]
    """Variables of the section on the capture."""
    track: dict[str, Any] | None
    """Variables of the section on the track, None without an object."""
    body: dict[str, Any]
    """Variables of the section on the body."""
    annotated: Sequence[ContactInterval] | None
    """Annotated contact."""
    made_by: Mapping[str, str]
    """Schema version and digest of settings by stage."""
    body_file: str
    """File name of the body file."""


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
        "name": s.name,
        "subject": s.subject,
        "object": s.object_,
        "intent": content.intent,
        "frames": len(s),
        "fps": s.fps,
        "tiles": _tiles(s),
        "timeline": charts.timeline(_rows(s, content.annotated), len(s)),
        "annotated": content.annotated is not None,
        "residuals": _residuals(s),
        "verdict": measures.verdict([s], {s.name}),
        "truth": measures.truth([s]),
        "flagged_runs": [
            {"frames": span(first, last), "reason": reason}
            for first, last, reason in flags.ranges(flagged)
        ],
        "flagged_text": s.flags.summary(),
        "energies": _energies(content.energies),
        "joint": content.joint,
        "physics_note": s.physics_note,
        "cameras": cameras,
        "note": content.note,
        "preview": content.preview,
        "closeups": content.closeups,
        "capture": content.capture,
        "track": content.track,
        "body": content.body,
        "colours": {"body": css(BODY_COLOUR), "object": css(OBJECT_COLOUR)},
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
    cloud = figures.cloud_figures([s])
    tiles.append(tile("body to point cloud", cloud["body_visible_mm"], "mm", "visible surface"))
    if s.has_object:
        tiles.append(
            tile("object to point cloud", cloud["object_visible_mm"], "mm", "visible surface")
        )
        depth = figures.penetration_figures([s]).get("mean_mm")
        tiles.append(tile("penetration", depth, "mm", "mean over contact frames"))
        tiles += measures.physics_tile([s])
        share = 100 * float(s.values["contact_frame"].mean())
        tiles.append(tile("in contact", share, "%", "of the frames", 0))
    return [*tiles, flag_tile(s.flags, has_object=s.has_object)]


def _rows(
    s: SequenceMetrics, annotated: Sequence[ContactInterval] | None
) -> list[charts.TimelineRow]:
    """Return rows for flags, frames in contact, and contact of each region by source."""
    rows = []
    for part in PARTS:
        found = flags.ranges(s.flags.reasons_of(part))
        marks = [(a, b, "fill flag", f"{span(a, b)}: {why}") for a, b, why in found]
        if s.has_object or part not in OF_OBJECT:
            rows.append(charts.TimelineRow(f"flagged, {part}", marks))
    annotated_runs: dict[str, list[tuple[int, int, str, str]]] = {}
    for interval in annotated or ():
        last = min(interval.end, len(s)) - 1
        if last >= interval.start:
            title = f"{span(interval.start, last)}: annotated"
            run = (interval.start, last, "fill annotated", title)
            annotated_runs.setdefault(interval.part, []).append(run)
    if not s.has_object:
        return rows
    rows.append(charts.TimelineRow("in contact", _runs(s.values["contact_frame"])))
    if "physics/carrier" in s.values:
        carriers = [str(name) for name in s.values["physics/carrier"]]
        bad = (Carrier.UNSUPPORTED, Carrier.UNKNOWN)
        runs = [
            (a, b, "fill flag" if name in bad else "fill any", f"{span(a, b)}: {name}")
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
                (a, b, "hover", f"{span(a, b)}: {100 * stated[a : b + 1].mean():.0f} %")
                for a, b, _, _ in _runs(stated >= 0.5)
            ]
            rows.append(charts.TimelineRow(f"{label}, estimated", runs, levels=stated))
        if touching.any():
            rows.append(charts.TimelineRow(f"{label}, from mesh distance", _runs(touching)))
    return rows


def _residuals(s: SequenceMetrics) -> list[tuple[str, str]]:
    """Return charts over the frames with their captions."""
    residuals = [
        _over_frames(
            s,
            (
                ("body to point cloud", "c1", "body_visible_to_cloud"),
                ("object to point cloud", "c2", "object_visible_to_cloud"),
                ("penetration", "c3", "penetration_mean"),
            ),
            "distance, mm",
            "Distance of visible surfaces to the point clouds; depth of the body in the object.",
        ),
        _over_frames(
            s,
            (("body", "c1", "acceleration_body"), ("object", "c2", "acceleration_object")),
            "acceleration, mm/frame²",
            "Second differences at 30 frames per second, which show jitter.",
        ),
    ]
    if "verdict/error_frame" in s.values:
        parts = zip(s.values["verdict/part_names"], ("c1", "c3", "c2"), strict=False)
        lines = [
            (str(part), colour, 1e3 * s.values["verdict/error_frame"][p].astype(np.float64))
            for p, (part, colour) in enumerate(parts)
        ]
        caption = "Estimated error (no ground truth) by frame; no line where there is no estimate."
        residuals.append(_chart(lines, "estimated error, mm", caption))
    return [pair for pair in residuals if pair is not None]


def _over_frames(
    s: SequenceMetrics, lines: Sequence[tuple[str, str, str]], unit: str, caption: str
) -> tuple[str, str] | None:
    return _chart(
        [(n, colour, 1e3 * s.values[key].astype(np.float64)) for n, colour, key in lines
         if key in s.values],
        unit,
        caption,
    )  # fmt: skip


def _chart(
    lines: Sequence[tuple[str, str, np.ndarray]], unit: str, caption: str
) -> tuple[str, str] | None:
    """Plot lines (name, colour, values (T,)) over the frames; None if no value is finite."""
    series = []
    for name, colour, values in lines:
        known = np.flatnonzero(np.isfinite(values))
        # a line for each run of known frames; only the first has a name in the legend
        for first, last in runs(np.isfinite(values)):
            run = np.arange(first, last + 1)
            label = name if first == known[0] else ""
            series.append(charts.Series(label, colour, run, values[run]))
    if not series:
        return None
    return charts.frame_chart(series, len(lines[0][2]), unit), caption


def _energies(terms: Sequence[tuple[str, float, float]]) -> str:
    """Plot each term's share of the initial energy before and after the joint fit."""
    if not terms:
        return ""
    total = max(sum(before for _, before, _ in terms), 1e-12)
    return charts.bar_pairs(
        [
            charts.BarPair.change(
                name.replace("_", " "), 100 * before / total, 100 * after / total, "", False
            )
            for name, before, after in terms
            if max(before, after) > 0
        ],
        "% of the energy at the start",
    )


def _runs(mask: np.ndarray) -> list[tuple[int, int, str, str]]:
    """Return the runs of set frames (T,) for a row of the timeline."""
    return [(first, last, "fill any", span(first, last)) for first, last in runs(mask)]
