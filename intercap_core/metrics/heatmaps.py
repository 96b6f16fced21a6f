"""Contact likelihood on the body and on each object, over all sequences (the paper's heatmaps)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.metrics.contact import CONTACT_M, vertex_contact
from intercap_core.schemas import METRICS


@dataclass(frozen=True, eq=False)
class SurfaceHeat:
    """Share of ``frames`` in which each of ``points`` (N, 3), rest pose, is in contact (N,)."""

    points: np.ndarray
    likelihood: np.ndarray
    frames: int


@dataclass(frozen=True, eq=False)
class Heatmaps:
    """``body`` (V,) share of ``body_frames`` in contact; one map an object by name."""

    body: np.ndarray
    body_frames: int
    objects: dict[str, SurfaceHeat]


def collect(paths: Sequence[Path]) -> Heatmaps:
    """Add up the metrics artefacts at 4.5 mm; raises UserError as reading does.

    Sequences without an object count in none of the maps. Bodies of another vertex count than the
    first one's are left out of the body's map, which lies on one topology.
    """
    body = np.zeros(0)
    body_frames = 0
    counts: dict[str, np.ndarray] = {}
    points: dict[str, np.ndarray] = {}
    frames: dict[str, int] = {}
    for path in paths:
        with artefacts.read(path, METRICS) as artefact:
            if "body_to_object" not in artefact:
                continue
            name = str(artefact.attributes["object"])
            distance = artefact["body_to_object"]
            if body_frames == 0:
                body = np.zeros(distance.shape[1])
            if distance.shape[1] == len(body):
                body += vertex_contact(distance, CONTACT_M).sum(0)
                body_frames += len(distance)
            here, found = artefact["object_sample_points"], artefact["object_sample_contact"]
            if name not in counts:
                counts[name], points[name], frames[name] = np.zeros(len(found)), here, 0
            if not np.array_equal(points[name], here):
                raise UserError(
                    f"{path}: object {name!r} was measured with another mesh than in the "
                    "sequences before; re-run stage 'metrics' for this sequence"
                )
            counts[name] += found
            frames[name] += len(distance)
    return Heatmaps(
        body / max(1, body_frames),
        body_frames,
        {
            name: SurfaceHeat(points[name], counts[name] / frames[name], frames[name])
            for name in sorted(counts)
        },
    )
