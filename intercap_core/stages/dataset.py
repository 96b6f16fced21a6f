"""Stage ``dataset``: tables, heatmaps, summary, dataset card and first page of the site."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.body.artefact import file_digest
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel
from intercap_core.config import BodyModels, CardSettings
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.evaluation import figures
from intercap_core.evaluation.summary import Heatmaps, SequenceSummary, collect_heatmaps
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.release.card import facts, markdown, split_table
from intercap_core.output.release.croissant import croissant
from intercap_core.output.release.datasheet import datasheet
from intercap_core.output.site import overview, tables
from intercap_core.output.site.heat_pictures import body_surfaces, highest, object_pictures
from intercap_core.output.site.measures import median_residuals
from intercap_core.output.site.overview import DatasetContent, Heat
from intercap_core.schemas import CONTACT_M, HEATMAPS

log = logging.getLogger(__name__)


def run(
    *,
    dataset: str,
    summaries: Mapping[str, Path],
    objects: Mapping[str, ObjectEntry],
    body_models: BodyModels,
    results: Path,
    card: CardSettings,
    formats: Sequence[str],
    failed: Mapping[str, str] | None = None,
    changed: Sequence[tuple[str, str, str]] = (),
) -> Path:
    """Merge the sequences' summaries; returns the path of the site's first page.

    Summaries that are missing or broken are logged, left out and listed on the page. Raises
    UserError if no sequence is left.

    Args:
        dataset: name of the dataset.
        summaries: summary artefacts by sequence, in the order of the table.
        objects: the list of objects, by name.
        body_models: body model files of the settings.
        results: folder of the outputs, which ``pipeline.plan.DATASET_OUTPUTS`` lists.
        card: statements of the dataset card.
        formats: formats of the exports, for the card.
        failed: for sequences without a result, the reason.
        changed: name, value and default of each setting that differs from its default.
    """
    found, broken = _read(summaries)
    unreported = {**(failed or {}), **broken}
    if not found:
        reasons = "".join(f"\n  {name}: {why}" for name, why in unreported.items())
        raise UserError(
            f"dataset {dataset!r}: no sequence has a result to report; look into the logs of the "
            f"sequences that failed{reasons}"
        )
    measured = [s.metrics for s in found]
    intents = {s.name: s.intent for s in found}
    by_sequence = tables.sequence_table(
        measured, {s.name: median_residuals(s.residuals) for s in found}, intents
    )
    groups = {
        "objects": tables.group_table(measured, "object", {s.name: s.object_ for s in measured}),
        "subjects": tables.group_table(measured, "subject", {s.name: s.subject for s in measured}),
        "intents": tables.group_table(measured, "intent", intents),
    }
    cameras = tables.camera_table(found)
    rig = tables.camera_groups(cameras)
    written = {
        "sequences": by_sequence,
        "frames": tables.frame_table(measured),
        "cameras": cameras,
        "splits": split_table(found, card),
        "rig": rig,
        **groups,
    }
    tables.write(results / "tables", written)
    heat = collect_heatmaps(found)
    common = None
    if card.heatmap_scale == "common":
        common = max(
            highest(map_) for map_ in (heat.body, *(o.likelihood for o in heat.objects.values()))
        )
    surfaces, doubts = _body_heat(found, heat, body_models, common)
    doubts |= _unlisted(found, objects)
    remarks = {name: "; ".join(reasons) for name, reasons in heat.left_out.items()} | doubts
    for name, why in remarks.items():
        log.warning("sequence %s: %s", name, why)
    _write_heatmaps(results / "heatmaps.h5", dataset, heat)
    _replace(results / "summary.json", _json(figures.summary(dataset, measured)))
    stated = facts(dataset, card, found, groups, formats=formats, failed=unreported)
    _replace(results / "README.md", markdown(stated))
    _replace(results / "datasheet.md", datasheet(stated))
    _replace(results / "card.json", _json(stated))
    _replace(results / "croissant.json", _json(croissant(stated, results, written)))
    content = DatasetContent(
        dataset=dataset,
        sequences=found,
        table=by_sequence,
        groups={name: table for name, table in [*groups.items(), ("cameras", rig)] if len(table)},
        surfaces=surfaces,
        objects=[
            _object_heat(name, heat, objects, common) for name in heat.objects if name in objects
        ],
        common_scale=common,
        body_frames=heat.body_frames,
        page_of={s.name: f"sequences/{s.name}/index.html" for s in found},
        failed=unreported,
        remarks=remarks,
        changed=changed,
    )
    first = results / "site" / "index.html"
    _replace(first, overview.page(content))
    return first


def _read(summaries: Mapping[str, Path]) -> tuple[list[SequenceSummary], dict[str, str]]:
    """Readable summaries, and the reason by sequence for the others."""
    found, broken = [], {}
    for name, path in summaries.items():
        try:
            found.append(SequenceSummary.read(path))
        except UserError as error:
            log.warning("sequence %s is left out: %s", name, error)
            broken[name] = str(error)
    return found, broken


def _body_heat(
    summaries: Sequence[SequenceSummary],
    heat: Heatmaps,
    body_models: BodyModels,
    common: float | None,
) -> tuple[list[Heat], dict[str, str]]:
    """Pictures of the heatmaps of the body and both hands, and remarks by sequence.

    They are drawn on the body of the first sequence whose body file still exists unchanged.
    ``common``: likelihood of the last colour; None = each map's own maximum.
    """
    doubts: dict[str, str] = {}
    if not heat.body_frames:
        return [], doubts
    for summary in summaries:
        if summary.body_contact is None or len(summary.body_contact) != len(heat.body):
            continue
        path = body_models.of(summary.body.gender) or OPEN_BODY
        if file_digest(path) == summary.body.digest:
            body = summary.body
            model = BodyModel.load(
                path, num_betas=body.num_betas, num_expression=body.num_expression
            )
            surfaces = body_surfaces(model, heat.body, common)
            return [Heat(*surface, heat.body_frames) for surface in surfaces], doubts
        doubts[summary.name] = (
            f"{path} is not the body file of the fit (digest {summary.body.digest}): the body's "
            "heatmap has no picture of it; set body_models to that file, or run the sequence again"
        )
    return [], doubts


def _unlisted(
    summaries: Sequence[SequenceSummary], objects: Mapping[str, ObjectEntry]
) -> dict[str, str]:
    """Remarks on sequences whose object is no longer in the list of objects."""
    return {
        summary.name: f"its object {summary.metrics.object_} has no entry in the list of objects: "
        "the object's heatmap has no picture; put the entry back, or correct the sequence's row"
        for summary in summaries
        if summary.metrics.object_ and summary.metrics.object_ not in objects
    }


def _object_heat(
    name: str, heat: Heatmaps, objects: Mapping[str, ObjectEntry], common: float | None
) -> Heat:
    """Pictures of the heatmap of one object; ``common`` as in :func:`_body_heat`."""
    mesh = ObjectMesh.load(objects[name])
    found = heat.objects[name]
    top = highest(found.likelihood)
    return Heat(
        name, object_pictures(mesh.vertices, mesh.faces, found, common or top), top, found.frames
    )


def _write_heatmaps(path: Path, dataset: str, heat: Heatmaps) -> None:
    """Write the heatmaps artefact; objects are concatenated, with offsets."""
    objects = list(heat.objects.values())
    ends = np.cumsum([len(o.likelihood) for o in objects], dtype=np.int64)
    with artefacts.write(
        path, HEATMAPS, dataset=dataset, contact_m=CONTACT_M, body_frames=heat.body_frames
    ) as writer:
        writer.put("body_likelihood", heat.body)
        writer.put("object_names", list(heat.objects))
        writer.put("object_frames", np.array([o.frames for o in objects], np.int64))
        writer.put("object_offsets", np.concatenate([np.zeros(1, np.int64), ends]))
        writer.put(
            "object_points", np.concatenate([np.zeros((0, 3)), *(o.points for o in objects)])
        )
        writer.put("object_likelihood", np.concatenate([[], *(o.likelihood for o in objects)]))


def _json(values: Any) -> str:
    return json.dumps(values, indent=2, ensure_ascii=False) + "\n"


def _replace(path: Path, text: str) -> None:
    """Write a text file atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = artefacts.part_of(path)
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)
