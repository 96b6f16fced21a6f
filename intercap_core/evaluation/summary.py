"""A sequence's contribution to the figures of the dataset, and contact heatmaps.

A summary holds the metrics without per-vertex distances, the number of contact frames of each
vertex and object sample, and the calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from intercap_core import artefacts, schemas
from intercap_core.artefacts import Artefact
from intercap_core.evaluation.contact import vertex_contact
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.scene_errors import displacement
from intercap_core.schemas import CONTACT_M, JOINT, METRICS, PER_VERTEX_METRICS, SCENE, SUMMARY
from intercap_core.sequence_inputs import SequencePaths


@dataclass(frozen=True)
class FittedBody:
    """The body model file with which a sequence was fitted."""

    gender: str
    digest: str
    """Checksum of the file."""
    num_betas: int
    """Shape coefficients that were fitted."""
    num_expression: int
    """Expression coefficients that were fitted."""


@dataclass(frozen=True, eq=False)
class SequenceSummary:
    """One sequence's summary artefact; fields of contact are None without an object."""

    metrics: SequenceMetrics
    """Metrics without per-vertex distances."""
    intent: str
    """Intent of the action, from the table of sequences; "" = not given."""
    body: FittedBody
    """Body model of the fit."""
    rig: Mapping[str, np.ndarray] = field(repr=False)
    """Datasets ``rig/...`` of SUMMARY by name."""
    body_contact: np.ndarray | None = field(repr=False)
    """(V,) number of frames in which each body vertex is in contact."""
    surface: np.ndarray | None = field(repr=False)
    """(N, 3) samples of the object's surface, object frame, metres."""
    surface_contact: np.ndarray | None = field(repr=False)
    """(N,) number of frames in which each sample is in contact."""
    made_by: Mapping[str, tuple[int, str]]
    """Schema version and settings digest by stage."""

    @property
    def name(self) -> str:
        """The sequence's name."""
        return self.metrics.name

    @property
    def residuals(self) -> list[tuple[str, float, float]]:
        """Held-out background residual of each camera pair: name, before and after refinement,
        m."""
        names = self.rig["camera_names"]
        return [
            (f"{names[i]}–{names[j]}", float(before), float(after))
            for (i, j), before, after in zip(
                self.rig["pairs"],
                self.rig["pair_residual_before"],
                self.rig["pair_residual_after"],
                strict=True,
            )
        ]

    @classmethod
    def read(cls, path: Path) -> SequenceSummary:
        """Read a summary artefact; raises UserError if it cannot be read."""
        with artefacts.read(path, SUMMARY) as artefact:
            attributes = artefact.attributes
            body_contact, surface, surface_contact = (
                artefact[key] if key in artefact else None  # noqa: SIM401 (not a dict)
                for key in ("body_contact_frames", "object_sample_points", "object_sample_contact")
            )
            made_by = zip(
                artefact.text("made_by/stages"),
                artefact["made_by/versions"],
                artefact.text("made_by/settings"),
                strict=True,
            )
            return cls(
                SequenceMetrics.of(artefact),
                str(attributes["intent"]),
                FittedBody(
                    str(attributes["gender"]),
                    str(attributes["body_model"]),
                    int(attributes["num_betas"]),
                    int(attributes["num_expression"]),
                ),
                {
                    key.removeprefix("rig/"): artefact[key]
                    for key in SUMMARY.fields
                    if key.startswith("rig/")
                },
                body_contact,
                surface,
                surface_contact,
                {stage: (int(version), settings) for stage, version, settings in made_by},
            )


def write(output: Path, paths: SequencePaths, *, intent: str) -> None:
    """Write the summary of one sequence; raises UserError if an artefact is missing or broken."""
    with (
        artefacts.read(paths.metrics, METRICS) as metrics,
        artefacts.read(paths.joint, JOINT) as joint,
    ):
        attributes = {
            **{name: metrics.attributes[name] for name in METRICS.attributes},
            **{k: v for k, v in metrics.attributes.items() if k in METRICS.optional_attributes},
            **{name: joint.attributes[name] for name in ("gender", "body_model")},
            "num_betas": joint["betas"].shape[-1],
            "num_expression": joint["expression"].shape[-1],
        }
        with artefacts.write(output, SUMMARY, **attributes, intent=intent) as writer:
            for key in metrics.keys():  # noqa: SIM118 (not a dict)
                if key not in PER_VERTEX_METRICS:
                    is_text = METRICS.fields[key].dtype == "str"
                    writer.put(key, metrics.text(key) if is_text else metrics[key])
            if "body_contact_distance" in metrics:
                counts = [
                    vertex_contact(distance, CONTACT_M).sum(0)
                    for distance in metrics.blocks("body_contact_distance")
                ]
                writer.put("body_contact_frames", np.sum(counts, axis=0, dtype=np.int32))
            with artefacts.read(paths.scene, SCENE) as scene:
                for key, values in _rig(scene).items():
                    writer.put(f"rig/{key}", values)
            stages, versions, settings = [], [], []
            for stage, path in paths.by_stage().items():
                schema = getattr(schemas, stage.upper())
                with artefacts.read(path, schema) as source:
                    stages.append(stage)
                    versions.append(schema.version)
                    settings.append(str(source.attributes.get("settings_digest", "")))
            writer.put("made_by/stages", stages)
            writer.put("made_by/versions", np.array(versions, np.int32))
            writer.put("made_by/settings", settings)


def _rig(scene: Artefact) -> dict[str, np.ndarray | list[str]]:
    """Datasets ``rig/...`` of the summary, without the prefix.

    ``moved``: (C,) displacement from the given to the refined poses, metres; NaN for the master and
    cameras without a pose.
    """
    names = scene.text("camera_names")
    start, found = scene["master_from_colour_start"], scene["master_from_colour"]
    posed = np.flatnonzero(np.isfinite(found).all((1, 2)) & np.isfinite(start).all((1, 2)))
    master = names.index(str(scene.attributes["master"]))
    moved = np.full(len(names), np.nan)
    if master in posed:
        moved[posed] = displacement(found[posed], start[posed], int(np.argmax(posed == master)))
        moved[master] = np.nan
    return {
        "camera_names": names,
        "images": (scene["image_of"] >= 0).sum(0).astype(np.int32),
        "time_offset": scene["time_offset"],
        "time_offset_sigma": scene["time_offset_sigma"],
        "depth_bias": scene["depth_bias"],
        "moved": moved,
        "note": scene.text("note"),
        "pairs": scene["pairs"],
        "pair_residual_before": scene["pair_residual_before"].astype(np.float64),
        "pair_residual_after": scene["pair_residual_after"].astype(np.float64),
    }


@dataclass(frozen=True, eq=False)
class SurfaceHeat:
    """Contact likelihood on the surface of one object."""

    points: np.ndarray
    """(N, 3) samples, object frame."""
    likelihood: np.ndarray
    """(N,) share of the frames in which a sample is in contact."""
    frames: int
    """Number of frames of all sequences with the object."""


@dataclass(frozen=True, eq=False)
class Heatmaps:
    """Contact likelihood on the body and on each object."""

    body: np.ndarray
    """(V,) share of the frames in which a vertex is in contact."""
    body_frames: int
    """Number of frames in the map of the body."""
    objects: dict[str, SurfaceHeat]
    """Map of each object, by name."""
    left_out: dict[str, list[str]] = field(default_factory=dict)
    """By sequence, reasons why it is not in a map."""


def collect_heatmaps(summaries: Sequence[SequenceSummary]) -> Heatmaps:
    """Add up the sequences' contact counts at a threshold of 4.5 mm.

    Sequences without an object are skipped. A map has one surface, that of its first sequence.
    Bodies with another number of vertices, and objects measured with another mesh, are excluded and
    listed in ``left_out``.
    """
    body, body_frames = np.zeros(0), 0
    objects: dict[str, tuple[np.ndarray, np.ndarray, int]] = {}  # samples, contact counts, frames
    left_out: dict[str, list[str]] = {}
    for summary in summaries:
        contact, surface = summary.body_contact, summary.surface
        surface_contact = summary.surface_contact
        if contact is None or surface is None or surface_contact is None:
            continue
        name, count = summary.metrics.object_, len(summary.metrics)
        if body_frames == 0:
            body = np.zeros(len(contact))
        if len(contact) == len(body):
            body += contact
            body_frames += count
        else:
            left_out.setdefault(summary.name, []).append(
                f"its body has {len(contact)} vertices, that of the first sequence {len(body)}: "
                "excluded from the body's heatmap"
            )
        points, touched, frames = objects.get(name, (surface, np.zeros(len(surface)), 0))
        if np.array_equal(points, surface):
            objects[name] = points, touched + surface_contact, frames + count
        else:
            left_out.setdefault(summary.name, []).append(
                f"object {name!r} was measured with another mesh than in the first sequence: "
                "excluded from its heatmap; re-run stage 'metrics' of the sequences with the older "
                "mesh"
            )
    return Heatmaps(
        body / max(1, body_frames),
        body_frames,
        {
            name: SurfaceHeat(points, touched / frames, frames)
            for name, (points, touched, frames) in sorted(objects.items())
        },
        left_out,
    )
