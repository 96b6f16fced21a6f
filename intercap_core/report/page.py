"""The dataset's report: one HTML page that needs nothing beside itself."""

from __future__ import annotations

import base64
import importlib.metadata
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from markupsafe import Markup

from intercap_core.metrics import figures, flags
from intercap_core.metrics.figures import SequenceMetrics
from intercap_core.metrics.verdict_figures import mean_stated
from intercap_core.report import body, capture, charts, measures, verdict
from intercap_core.report import track as tracks
from intercap_core.report.body import BodyFacts
from intercap_core.report.capture import CaptureFacts
from intercap_core.report.capture_pictures import CapturePicture
from intercap_core.report.closeups import CloseUp
from intercap_core.report.heat_pictures import COLOUR_STOPS, HeatPicture
from intercap_core.report.overlays import BODY_COLOUR, OBJECT_COLOUR, Overlay
from intercap_core.report.sheets import Sheet
from intercap_core.report.track import TrackFacts
from intercap_core.schemas import METRIC_REGIONS

_TEMPLATES = Path(__file__).parent / "templates"
_WORST = 10
_MAX_RUNS = 400  # rows of the list of flagged frames
_LIBRARIES = ("numpy", "torch", "open3d", "opencv-python-headless", "h5py", "scipy")


@dataclass(frozen=True, eq=False)
class Detail:
    """What the page shows of one sequence: overlays by camera, or why there are none, how the joint
    fit went, in words, and close-ups of hands that hold."""

    name: str
    overlays: Sequence[Overlay]
    note: str = ""
    closeups: Sequence[CloseUp] = ()
    joint: str = ""


@dataclass(frozen=True, eq=False)
class ObjectHeat:
    """Pictures of one object's heatmap and the likelihood that its last colour stands for."""

    name: str
    pictures: Sequence[HeatPicture]
    top: float
    frames: int


@dataclass(frozen=True, eq=False)
class Content:
    """All that the page is made from.

    ``captures``, ``tracks`` and ``bodies`` of the sequences that are shown. ``residuals`` by
    sequence: name, before and after of each camera pair, metres. ``trace`` by sequence: what to
    print of each stage. ``failed``: sequences without a result and why.
    """

    dataset: str
    sequences: Sequence[SequenceMetrics]
    table: pd.DataFrame
    details: Sequence[Detail]
    captures: Sequence[CaptureFacts]
    tracks: Sequence[TrackFacts]
    bodies: Sequence[BodyFacts]
    body_heat: Sequence[HeatPicture]
    body_top: float
    body_frames: int
    object_heat: Sequence[ObjectHeat]
    objects_left_out: int
    residuals: Mapping[str, Sequence[tuple[str, float, float]]]
    trace: Mapping[str, Mapping[str, str]]
    body_model: str
    failed: Mapping[str, str] = field(default_factory=dict)


def render(content: Content) -> str:
    """The whole page as text."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    return environment.get_template("report.html.j2").render(_context(content))


def _context(content: Content) -> dict[str, Any]:
    rows = _rows(content)
    runs = [
        {"sequence": s.name, "frames": _span(first, last), "reason": reason}
        for s in content.sequences
        for first, last, reason in flags.ranges(list(s.values["flag_reason"]))
    ]
    return {
        "dataset": content.dataset,
        "style": Markup((_TEMPLATES / "style.css").read_text(encoding="utf-8")),
        "script": Markup((_TEMPLATES / "script.js").read_text(encoding="utf-8")),
        "headline": _headline(content),
        "tiles": _tiles(content),
        "rows": rows,
        "failed": sorted(content.failed.items()),
        "truth": measures.truth(content.sequences),
        "verdict": verdict.context(content.sequences, {detail.name for detail in content.details}),
        "penetration": measures.penetration(content.sequences),
        "clouds": measures.clouds(content.dataset, content.sequences),
        "heat": _heat(content),
        "cameras": measures.cameras(content.sequences, content.residuals),
        "captures": [_capture(facts) for facts in content.captures],
        "tracks": [_with_sheet(tracks.context(facts)) for facts in content.tracks],
        "bodies": [_with_sheet(body.context(facts)) for facts in content.bodies],
        "worst": sorted(rows, key=lambda row: row["rank"])[:_WORST],
        "flagged_runs": runs[:_MAX_RUNS],
        "flagged_left_out": max(0, len(runs) - _MAX_RUNS),
        "flagged_frames": sum(int(s.values["flagged"].sum()) for s in content.sequences),
        "details": [_detail(content, detail) for detail in content.details],
        "not_shown": len(content.sequences) - len(content.details),
        "colours": {"body": _css(BODY_COLOUR), "object": _css(OBJECT_COLOUR)},
        "versions": _versions(content),
        "trace": _trace(content),
    }


def _headline(content: Content) -> str:
    frames = sum(len(s) for s in content.sequences)
    seconds = sum(len(s) / s.fps for s in content.sequences)
    subjects = len({s.subject for s in content.sequences})
    objects = len({s.object_ for s in content.sequences if s.object_})
    parts = [
        _counted(len(content.sequences), "sequence"),
        _counted(frames, "frame"),
        f"{seconds / 60:.1f} minutes" if seconds >= 120 else f"{seconds:.0f} seconds",
        _counted(subjects, "subject"),
        _counted(objects, "object") if objects else "people alone",
    ]
    if content.failed:
        parts.append(f"{len(content.failed)} failed")
    return ", ".join(parts)


def _tiles(content: Content) -> list[dict[str, str]]:
    depth = figures.penetration_figures(content.sequences)
    cloud = figures.cloud_figures(content.sequences)
    flagged = np.concatenate([s.values["flagged"] for s in content.sequences])
    tiles = []
    if any(s.has_truth for s in content.sequences):
        joint = figures.truth_figures(content.sequences, "joint")
        for key, name, unit, note in (
            ("body_pve_mm", "body error", "mm", "per vertex, against truth"),
            ("object_translation_mm", "object error", "mm", "centre, median, against truth"),
            ("object_rotation_deg", "object rotation error", "°", "median, against truth"),
            ("contact_region_f1", "contact", "", "F1 by body region"),
        ):
            if key in joint:
                digits = 2 if unit in ("", "°") else 1
                tiles.append(_tile(name, joint[key], unit, note, digits))
    tiles += [
        _tile(f"{part}, stated", value, "mm", "mean error, without truth")
        for part, value in mean_stated(content.sequences).items()
    ]
    handling = any(s.has_object for s in content.sequences)
    if handling:
        tiles.append(_tile("penetration", depth.get("mean_mm"), "mm", "mean over contact frames"))
    tiles.append(_tile("body to cloud", cloud["body_visible_mm"], "mm", "visible surface"))
    if handling:
        tiles.append(_tile("object to cloud", cloud["object_visible_mm"], "mm", "visible surface"))
    share, count = 100 * float(flagged.mean()), int(flagged.sum())
    return [*tiles, _tile("flagged", share, "%", f"{count} not trusted")]


def _tile(name: str, value: float | None, unit: str, note: str, digits: int = 1) -> dict[str, str]:
    known = value is not None and np.isfinite(value)
    text = f"{value:.{digits}f}{'' if unit == '°' else ' '}{unit}".rstrip() if known else "–"
    return {"name": name, "value": text, "note": note}


def _rows(content: Content) -> list[dict[str, Any]]:
    shown = {detail.name for detail in content.details}
    columns = {
        "penetration": "penetration.mean_mm",
        "penetration_p98": "penetration.p98_mm",
        "body_visible": "vertex_to_cloud.body_visible_mm",
        "object_visible": "vertex_to_cloud.object_visible_mm",
        "acceleration_body": "acceleration_body_mm",
        "acceleration_object": "acceleration_object_mm",
        "pve": "joint.body_pve_mm",
        "object_mm": "joint.object_translation_mm",
        "object_deg": "joint.object_rotation_deg",
    }
    rows = []
    for record in content.table.to_dict("records"):
        row = {name: record.get(column) for name, column in columns.items()}
        for name in ("sequence", "subject", "object", "frames", "rank"):
            row[name] = record[name]
        row["flagged"] = 100 * record["flagged_frames"] / record["frames"]
        row["contact"] = 100 * record["contact_frames"] / record["frames"]
        row["shown"] = record["sequence"] in shown
        rows.append(row)
    return rows


def _heat(content: Content) -> dict[str, Any]:
    stops = ", ".join(
        f"{_css(colour)} {100 * at:g}%"
        for colour, at in zip(COLOUR_STOPS, (0, 0.25, 0.6, 1), strict=True)
    )
    return {
        "gradient": f"linear-gradient(90deg, {stops})",
        "body": [_embedded(p, p.caption) for p in content.body_heat],
        "body_top": content.body_top,
        "body_frames": content.body_frames,
        "left_out": content.objects_left_out,
        "objects": [
            {
                "name": heat.name,
                "top": heat.top,
                "frames": heat.frames,
                "pictures": [_embedded(p, p.caption) for p in heat.pictures],
            }
            for heat in content.object_heat
        ],
    }


def _capture(facts: CaptureFacts) -> dict[str, Any]:
    found = capture.context(facts)
    found["pictures"] = [[_embedded(p, p.caption) for p in row] for row in found["pictures"]]
    return found


def _with_sheet(found: dict[str, Any]) -> dict[str, Any]:
    """A section's context with its sheet, where it has one, as the page embeds it."""
    sheet = found["sheet"]
    if sheet is not None:
        rows = ", ".join(map(str, sheet.frames))
        found["sheet"] = _embedded(sheet, f"{found['name']}, frames {rows} in every camera")
    return found


def _detail(content: Content, detail: Detail) -> dict[str, Any]:
    s = next(s for s in content.sequences if s.name == detail.name)
    cameras: dict[str, list[dict[str, Any]]] = {}
    for overlay in detail.overlays:
        caption = f"camera {overlay.camera}, frame {overlay.frame}"
        if s.values["flagged"][overlay.frame]:
            caption += f" (flagged: {s.values['flag_reason'][overlay.frame]})"
        cameras.setdefault(overlay.camera, []).append(_embedded(overlay, caption))
    reasons = list(s.values["flag_reason"])
    bands = [
        charts.Band(
            "flagged",
            "flag",
            [(a, b, f"{_span(a, b)}: {why}") for a, b, why in flags.ranges(reasons)],
        ),
        *(_contact_bands(s) if s.has_object else ()),
    ]
    return {
        "name": s.name,
        "subject": s.subject,
        "object": s.object_,
        "contact": s.has_object,
        "frames": len(s),
        "fps": s.fps,
        "cameras": list(cameras.values()),
        "note": detail.note,
        "joint": detail.joint,
        "closeups": [_embedded(picture, picture.hold.caption) for picture in detail.closeups],
        "timeline": charts.timeline(bands, len(s)),
    }


def _contact_bands(s: SequenceMetrics) -> list[charts.Band]:
    """Frames in contact, and of each region that touches, as stated and as the meshes have it."""
    bands = [charts.Band("in contact", "any", _runs(s.values["contact_frame"]))]
    names = list(s.values["region_names"])
    for region in METRIC_REGIONS:
        says = region.replace("_", " ")
        stated = s.values["contact_probability"][:, names.index(region)]
        if (stated >= 0.5).any():
            bands.append(charts.Band(f"{says}, stated", "touch", _stated_runs(stated)))
        touching = s.values["region_contact"][:, names.index(region)]
        if touching.any():
            bands.append(charts.Band(f"{says}, meshes", "any", _runs(touching)))
    return bands


def _versions(content: Content) -> list[tuple[str, str]]:
    rows = [("intercap-core", importlib.metadata.version("intercap-core"))]
    rows.append(("Python", platform.python_version()))
    for name in _LIBRARIES:
        try:
            rows.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            continue
    rows.append(("body file", content.body_model))
    return rows


def _trace(content: Content) -> dict[str, Any]:
    stages = list(next(iter(content.trace.values()), {}))
    return {
        "stages": stages,
        "rows": [
            {"sequence": name, "cells": [by_stage[stage] for stage in stages]}
            for name, by_stage in content.trace.items()
        ],
    }


def _runs(mask: np.ndarray) -> list[tuple[int, int, str]]:
    runs = flags.ranges(["x" if value else "" for value in mask])
    return [(first, last, _span(first, last)) for first, last, _ in runs]


def _stated_runs(probability: np.ndarray) -> list[tuple[int, int, str]]:
    """Runs in which contact is likelier than not, with the mean probability (T,) in words."""
    return [
        (first, last, f"{span}: {100 * probability[first : last + 1].mean():.0f} %")
        for first, last, span in _runs(probability >= 0.5)
    ]


def _span(first: int, last: int) -> str:
    return f"{first}" if first == last else f"{first}–{last}"


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def _embedded(
    picture: HeatPicture | Overlay | CapturePicture | CloseUp | Sheet, caption: str
) -> dict[str, Any]:
    if isinstance(picture, CapturePicture):
        kind, data = picture.kind, picture.data
    elif isinstance(picture, Overlay | CloseUp | Sheet):
        kind, data = "jpeg", picture.jpeg
    else:
        kind, data = "png", picture.png
    return {
        "data": f"image/{kind};base64,{base64.b64encode(data).decode()}",
        "width": picture.width,
        "height": picture.height,
        "caption": caption,
    }


def _css(colour: Sequence[float]) -> str:
    return "#" + "".join(f"{round(255 * c):02x}" for c in colour)
