"""All sequences together: tables, heatmaps, the summary and the report."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.artefacts import Schema
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.camera.rig import Rig
from intercap_core.capture.frames import Frames
from intercap_core.config import BodyModels, ObjectEntry, ReportSettings, SubjectEntry
from intercap_core.detections.read import Detections
from intercap_core.errors import UserError
from intercap_core.metrics import figures
from intercap_core.metrics.contact import CONTACT_M
from intercap_core.metrics.extrinsics import displacement
from intercap_core.metrics.figures import SequenceMetrics
from intercap_core.metrics.heatmaps import Heatmaps, collect
from intercap_core.report import tables
from intercap_core.report.body import read_fit
from intercap_core.report.capture import read_capture
from intercap_core.report.closeups import CloseUp, closeup, holds, read_handling
from intercap_core.report.heat_pictures import body_pictures, object_pictures
from intercap_core.report.overlays import Fit, choose_cameras, choose_frames, overlays
from intercap_core.report.page import Content, Detail, ObjectHeat, render
from intercap_core.report.track import TrackFacts, read_track
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.schemas import BODY_FIT, FRAMES, HEATMAPS, JOINT, METRICS, OBJECT_TRACK, SCENE

log = logging.getLogger(__name__)

_MAX_OBJECTS = 12  # objects whose heatmaps are drawn; all are in heatmaps.h5

_MAX_CLOSEUPS = 2  # holds drawn of each sequence; `intercap closeups` draws all

SequenceArtefacts = Mapping[str, Path]  # of one sequence, by the stage that wrote each


def run(
    *,
    dataset: str,
    sequences: Mapping[str, SequenceArtefacts],
    objects: Mapping[str, ObjectEntry],
    subjects: Mapping[str, SubjectEntry],
    body_models: BodyModels,
    settings: ReportSettings,
    report: Path,
    summary: Path,
    heatmaps: Path,
    tables_folder: Path,
    failed: Mapping[str, str] | None = None,
    truths: Mapping[str, Path] | None = None,
) -> None:
    """Write the report, summary.json, heatmaps.h5 and the tables of a dataset.

    ``sequences`` by name, in the order of the table; ``failed`` are sequences without a result,
    with the reason; ``truths``, where known, are drawn beside close-ups of hands. Raises UserError
    where there is no sequence at all or an artefact is broken.
    """
    if not sequences:
        raise UserError(
            f"dataset {dataset!r}: no sequence has a result to report; look into the logs of the "
            "sequences that failed"
        )
    measured = [SequenceMetrics.read(s["metrics"]) for s in sequences.values()]
    residuals = {name: _residuals(s["scene"]) for name, s in sequences.items()}
    by_sequence = tables.sequence_table(measured, {n: _medians(p) for n, p in residuals.items()})
    tables.write(tables_folder, by_sequence, tables.frame_table(measured))
    heat = collect([s["metrics"] for s in sequences.values()])
    _write_heatmaps(heatmaps, dataset, heat)
    text = json.dumps(figures.summary(dataset, measured), indent=2) + "\n"
    _replace(summary, text)

    ranked = by_sequence.sort_values("rank")["sequence"].tolist()
    shown = set(ranked[: settings.max_sequences])
    details = [
        replace(
            _detail(name, sequences[name], s, objects, subjects, body_models, settings),
            closeups=[]
            if not s.has_object
            else _closeups(
                sequences[name],
                objects[s.object_],
                body_models,
                subjects[s.subject].gender,
                (truths or {}).get(name),
            ),
        )
        for name, s in zip(sequences, measured, strict=True)
        if name in shown
    ]
    captures = [
        read_capture(s["frames"], s["scene"]) for name, s in sequences.items() if name in shown
    ]
    tracks = [
        _track(sequences[name], s.object_, objects)
        for name, s in zip(sequences, measured, strict=True)
        if name in shown and s.object_
    ]
    bodies = [
        read_fit(
            p["frames"],
            p["scene"],
            p["person"],
            p["body_fit"],
            body_models,
            subjects[s.subject].gender,
        )
        for p, s in zip(sequences.values(), measured, strict=True)
        if s.name in shown
    ]
    first = next(iter(sequences.values()))
    with artefacts.read(first["joint"], JOINT) as artefact:
        model = load_model(body_models, str(artefact.attributes["gender"]), artefact)
    body_top = _top(heat.body)
    drawn = sorted(heat.objects, key=lambda name: (-heat.objects[name].frames, name))[:_MAX_OBJECTS]
    content = Content(
        dataset=dataset,
        sequences=measured,
        table=by_sequence,
        details=details,
        captures=captures,
        tracks=tracks,
        bodies=bodies,
        body_heat=body_pictures(model, heat.body, body_top) if heat.body_frames else [],
        body_top=body_top,
        body_frames=heat.body_frames,
        object_heat=[_object_heat(name, heat, objects) for name in sorted(drawn)],
        objects_left_out=len(heat.objects) - len(drawn),
        residuals=residuals,
        trace={name: _trace(s) for name, s in sequences.items()},
        body_model=model.path.name,
        failed=failed or {},
    )
    _replace(report, render(content))


def _detail(
    name: str,
    paths: SequenceArtefacts,
    measured: SequenceMetrics,
    objects: Mapping[str, ObjectEntry],
    subjects: Mapping[str, SubjectEntry],
    body_models: BodyModels,
    settings: ReportSettings,
) -> Detail:
    mesh = ObjectMesh.load(objects[measured.object_]) if measured.has_object else None
    with artefacts.read(paths["joint"], JOINT) as joint:
        parameters = read_parameters(joint)
        model = load_model(body_models, subjects[measured.subject].gender, joint)
        fit = Fit(model, parameters, joint["rotation"], joint["translation"], mesh)
        settled = joint["master_from_colour"]
        with artefacts.read(paths["scene"], SCENE) as scene:
            rig, image_of = Rig.from_artefact(scene), scene["image_of"]
            master = rig.names.index(str(scene.attributes["master"]))
        said = _of_joint(joint, rig, master)
    rig = rig.moved(settled)
    worst = "object_visible_to_cloud" if measured.has_object else "body_visible_to_cloud"
    chosen = choose_frames(measured.values[worst], settings.frames)
    cameras = choose_cameras(fit, rig, chosen, settings.cameras)
    try:
        with Frames.open(paths["frames"]) as images:
            shown = overlays(images.showing(image_of), rig, fit, cameras, chosen)
            return Detail(name, shown, joint=said)
    except UserError as error:  # one image that does not decode must not cost the whole report
        log.warning("%s: no overlays: %s", name, error)
        return Detail(name, [], str(error), joint=said)


def _of_joint(joint: artefacts.Artefact, rig: Rig, master: int) -> str:
    """How the joint fit went, and by how much it has moved the cameras of ``rig``, in words."""
    steps, refused = joint.attributes["iterations"], joint.attributes["refused"]
    settled = "settled" if joint.attributes["converged"] else "ended before it settled"
    corrected = ""
    if joint.attributes["cameras_corrected"]:
        posed = np.isfinite(rig.master_from_colour).all((1, 2))
        moved = np.full(len(rig), np.nan)
        order = np.flatnonzero(posed)
        moved[posed] = displacement(
            joint["master_from_colour"][posed],
            rig.master_from_colour[posed],
            int(np.flatnonzero(order == master)[0]),
        )
        variance = np.einsum("cici->ci", joint["camera_covariance"])
        sigma = np.sqrt(variance[:, 3:6].max(axis=1))  # of the shift
        cameras = ", ".join(
            f"{rig.names[c]} {1e3 * moved[c]:.1f} (+- {1e3 * sigma[c]:.1f})"
            for c in order
            if sigma[c] > 0
        )
        corrected = f"; cameras corrected, mm over 2 m: {cameras}"
    frames = joint["hand_undetermined"].sum(axis=0)
    hands = "".join(
        f" The {side} hand is undetermined in {count} frames (few views see it)."
        for side, count in zip(("left", "right"), frames, strict=True)
        if count
    )
    return f"Joint fit: {steps} steps taken, {refused} refused, {settled}{corrected}.{hands}"


def _closeups(
    paths: SequenceArtefacts,
    entry: ObjectEntry,
    body_models: BodyModels,
    gender: str,
    truth: Path | None,
) -> list[CloseUp]:
    """The longest holds of a sequence."""
    handling = read_handling(
        paths, entry=entry, body_models=body_models, gender=gender, truth=truth
    )
    return [closeup(handling, hold) for hold in holds(handling.probability)[:_MAX_CLOSEUPS]]


def _track(
    paths: SequenceArtefacts, object_name: str, objects: Mapping[str, ObjectEntry]
) -> TrackFacts:
    with artefacts.read(paths["scene"], SCENE) as scene:
        moments = Detections.load(paths["detections"]).showing(scene["image_of"])
    found = moments.with_candidates_of(paths["person"])
    with artefacts.read(paths["object_track"], OBJECT_TRACK) as track:
        candidate = track["candidate"]

    def kept(t: int, c: int) -> bytes:
        return found.candidates(t, c)[candidate[t, c]].rle if candidate[t, c] >= 0 else b""

    mesh = ObjectMesh.load(objects[object_name])
    return read_track(paths["frames"], paths["scene"], paths["object_track"], mesh, kept)


def _object_heat(name: str, heat: Heatmaps, objects: Mapping[str, ObjectEntry]) -> ObjectHeat:
    mesh = ObjectMesh.load(objects[name])
    found = heat.objects[name]
    top = _top(found.likelihood)
    return ObjectHeat(
        name, object_pictures(mesh.vertices, mesh.faces, found, top), top, found.frames
    )


def _top(likelihood: np.ndarray) -> float:
    """What the last colour stands for: the highest value; all grey where nothing touches."""
    return max(float(likelihood.max(initial=0.0)), 1e-6)


def _residuals(scene: Path) -> list[tuple[str, float, float]]:
    """Name, before and after of each pair of cameras, metres."""
    with artefacts.read(scene, SCENE) as artefact:
        names = artefact.text("camera_names")
        return [
            (f"{names[i]}–{names[j]}", float(before), float(after))
            for (i, j), before, after in zip(
                artefact["pairs"],
                artefact["pair_residual_before"],
                artefact["pair_residual_after"],
                strict=True,
            )
        ]


def _medians(pairs: Sequence[tuple[str, float, float]]) -> tuple[float, float]:
    known = np.array([pair[1:] for pair in pairs if np.isfinite(pair[1:]).all()])
    if not len(known):
        return float("nan"), float("nan")
    before, after = np.median(known, axis=0)
    return float(before), float(after)


def _trace(paths: SequenceArtefacts) -> dict[str, str]:
    schemas: tuple[tuple[Path, Schema], ...] = (
        (paths["frames"], FRAMES),
        (paths["scene"], SCENE),
        (paths["object_track"], OBJECT_TRACK),
        (paths["body_fit"], BODY_FIT),
        (paths["joint"], JOINT),
        (paths["metrics"], METRICS),
    )
    found = {}
    for path, schema in schemas:
        with artefacts.read(path, schema) as artefact:
            digest = artefact.attributes.get("settings_digest") or "-"
            found[schema.stage] = f"v{schema.version} {digest}"
    return found


def _write_heatmaps(path: Path, dataset: str, heat: Heatmaps) -> None:
    found = list(heat.objects.values())
    ends = np.cumsum([len(one.likelihood) for one in found], dtype=np.int64)
    with artefacts.write(
        path, HEATMAPS, dataset=dataset, contact_m=CONTACT_M, body_frames=heat.body_frames
    ) as writer:
        writer.put("body_likelihood", heat.body)
        writer.put("object_names", list(heat.objects))
        writer.put("object_frames", np.array([one.frames for one in found], np.int64))
        writer.put("object_offsets", np.concatenate([np.zeros(1, np.int64), ends]))
        writer.put("object_points", np.concatenate([np.zeros((0, 3)), *(f.points for f in found)]))
        writer.put("object_likelihood", np.concatenate([[], *(f.likelihood for f in found)]))


def _replace(path: Path, text: str) -> None:
    """Write a whole text file or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)
