"""Stage ``page``: the sequence's page of the site with its recording, fits, errors and viewer."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts, schemas
from intercap_core.annotation import ContactInterval
from intercap_core.artefacts import Artefact
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.config import PageSettings
from intercap_core.entries import ObjectEntry, SequenceEntry
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.scene_errors import displacement
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.site.body_section import read_fit
from intercap_core.output.site.capture_section import read_capture
from intercap_core.output.site.closeups import closeup, holds, read_handling
from intercap_core.output.site.drawing import EncodedImage
from intercap_core.output.site.embed import PREVIEW
from intercap_core.output.site.overlays import (
    PosedFit,
    Preview,
    choose_cameras,
    choose_frames,
    make_preview,
    overlays,
)
from intercap_core.output.site.sequence_page import SequenceContent, page
from intercap_core.output.site.track_section import read_track
from intercap_core.output.viewer import page as viewer
from intercap_core.schemas import JOINT, OBJECT_TRACK, SCENE
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

log = logging.getLogger(__name__)


def run(
    *,
    paths: SequencePaths,
    models: SequenceModels,
    sequence: SequenceEntry,
    contact: Sequence[ContactInterval] | None,
    settings: PageSettings,
    output: Path,
    truth: Path | None,
) -> None:
    """Write the page into the new folder ``output``.

    Raises UserError if an artefact or the object's mesh is missing or broken.

    Args:
        contact: annotated intervals; None = not annotated.
        truth: truth file, drawn next to the fits in close-ups of hands; None = no truth.
    """
    measured = SequenceMetrics.read(paths.metrics)
    shown = models if measured.has_object else replace(models, object_=None)
    with artefacts.read(paths.joint, JOINT) as fit, artefacts.read(paths.scene, SCENE) as scene:
        model = load_model(models.body_models, models.gender, fit)
        mesh = None if shown.object_ is None else ObjectMesh.load(shown.object_)
        posed = PosedFit(model, read_parameters(fit), fit["rotation"], fit["translation"], mesh)
        rig, image_of = Rig.from_artefact(scene), scene["image_of"]
        master = rig.names.index(str(scene.attributes["master"]))
        description, energies = _describe_joint(fit, rig, master), _energies(fit)
        rig = rig.moved(fit["master_from_colour"])
    note, preview = "", None
    drawn: dict[str, dict[int, EncodedImage]] = {}
    try:
        drawn, preview = _overlays(paths.frames, measured, posed, rig, image_of, settings)
    except UserError as error:  # a page without overlays is better than none
        note = str(error)
        log.warning("%s: no overlays: %s", measured.name, error)
    content = SequenceContent(
        metrics=measured,
        intent=sequence.intent or "",
        overlays=drawn,
        preview=preview,
        note=note,
        joint=description,
        energies=energies,
        closeups=_closeups(paths, shown, truth),
        capture=read_capture(paths.frames, paths.scene),
        track=None if models.object_ is None else _track(paths, models.object_),
        body=read_fit(paths, models),
        annotated=contact,
        made_by=_made_by(paths),
        body_file=model.path.name,
    )
    output.mkdir(parents=True)
    (output / "index.html").write_text(page(content), encoding="utf-8")
    if preview is not None:
        (output / PREVIEW).write_bytes(preview.thumbnail.content)
    viewer.write_script(output / viewer.SCRIPT, paths, shown, truth=truth)


def _overlays(
    frames: Path,
    measured: SequenceMetrics,
    fit: PosedFit,
    rig: Rig,
    image_of: np.ndarray,
    settings: PageSettings,
) -> tuple[dict[str, dict[int, EncodedImage]], Preview | None]:
    """Overlays of body and object on the images of some frames and cameras, and a preview.

    Frames are evenly spread, and include the one in which the meshes are farthest from the measured
    points. The preview shows the camera that sees most.
    """
    worst = "object_visible_to_cloud" if measured.has_object else "body_visible_to_cloud"
    chosen = choose_frames(measured.values[worst], settings.frames)
    cameras = choose_cameras(fit, rig, chosen, settings.cameras)
    with Frames.open(frames) as opened:
        images = opened.showing(image_of)
        drawn = overlays(images, rig, fit, sorted(cameras), chosen)
        return drawn, make_preview(images, rig, cameras[0], fit, measured)


def _describe_joint(joint: Artefact, rig: Rig, master: int) -> str:
    """Text on the iterations of the joint fit, its camera corrections and undetermined hands.

    ``rig``: cameras before the joint fit. ``master``: index of the master.
    """
    if "made_by" in joint.attributes:
        return (
            f"Not fitted here: made by {joint.attributes['made_by']}, with the cameras as they "
            "were given. The per-stage fits are this program's."
        )
    steps, refused = joint.attributes["iterations"], joint.attributes["refused"]
    end = (
        "converged"
        if joint.attributes["converged"]
        else "stopped at the iteration limit before convergence"
    )
    if "last_step_mm" in joint.attributes:
        end += f" (last step {joint.attributes['last_step_mm']:.2g} mm)"
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
        sigma = np.sqrt(variance[:, 3:6].max(axis=1))  # standard deviation of the translation
        cameras = ", ".join(
            f"{rig.names[c]} {1e3 * moved[c]:.1f} ± {1e3 * sigma[c]:.1f}"
            for c in order
            if sigma[c] > 0
        )
        corrected = f"; cameras moved by the joint fit, mm (mean displacement at 2 m): {cameras}"
    frames = joint["hand_undetermined"].sum(axis=0)
    hands = "".join(
        f" Too few observations of the {side} hand in {count} frames."
        for side, count in zip(("left", "right"), frames, strict=True)
        if count
    )
    return f"Joint fit: {steps} solver steps accepted, {refused} rejected, {end}{corrected}.{hands}"


def _energies(joint: Artefact) -> list[tuple[str, float, float]]:
    """Name and value before and after the joint fit of each energy term."""
    return [
        (name, float(before), float(after))
        for name, before, after in zip(
            joint.text("energy_names"), joint["energy_before"], joint["energy_after"], strict=True
        )
    ]


def _closeups(
    paths: SequencePaths, models: SequenceModels, truth: Path | None
) -> list[EncodedImage]:
    """Draw close-ups of the longest hand contacts; [] without an object."""
    if models.object_ is None:
        return []
    known = truth if truth is not None and truth.is_file() else None
    handling = read_handling(paths, models, truth=known)
    # the two longest contacts; `intercap closeups` draws all
    return [closeup(handling, hold) for hold in holds(handling.probability)[:2]]


def _track(paths: SequencePaths, entry: ObjectEntry) -> dict[str, Any]:
    """Content of the page's section on the object's track."""
    with artefacts.read(paths.scene, SCENE) as scene:
        detections = Detections.load(paths.detections).showing(scene["image_of"])
    detections = detections.with_candidates_of(paths.person)
    with artefacts.read(paths.object_track, OBJECT_TRACK) as track:
        candidate = track["candidate"]

    def kept(t: int, c: int) -> bytes:
        return detections.candidates(t, c)[candidate[t, c]].rle if candidate[t, c] >= 0 else b""

    return read_track(paths, ObjectMesh.load(entry), kept)


def _made_by(paths: SequencePaths) -> dict[str, str]:
    """Schema version and settings digest of each stage's artefact."""
    versions = {}
    for stage, path in paths.by_stage().items():
        schema = getattr(schemas, stage.upper())
        with artefacts.read(path, schema) as artefact:
            digest = artefact.attributes.get("settings_digest") or "-"
            versions[stage] = f"v{schema.version} {digest}"
    return versions
