"""Contact likelihood on the body and on each object, over all sequences (the paper's heatmaps)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.errors import UserError
from intercap_core.metrics.summary import SequenceSummary


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


def collect(summaries: Sequence[SequenceSummary]) -> Heatmaps:
    """Add up the sequences' counts at 4.5 mm.

    Sequences without an object count in none of the maps. Bodies of another vertex count than the
    first one's are left out of the body's map, which lies on one topology. Raises UserError where
    an object was measured with two meshes.
    """
    body = np.zeros(0)
    body_frames = 0
    counts: dict[str, np.ndarray] = {}
    points: dict[str, np.ndarray] = {}
    frames: dict[str, int] = {}
    for summary in summaries:
        contact, here, found = summary.body_contact, summary.surface, summary.surface_contact
        if contact is None or here is None or found is None:
            continue
        name, count = summary.metrics.object_, len(summary.metrics)
        if body_frames == 0:
            body = np.zeros(len(contact))
        if len(contact) == len(body):
            body += contact
            body_frames += count
        if name not in counts:
            counts[name], points[name], frames[name] = np.zeros(len(found)), here, 0
        if not np.array_equal(points[name], here):
            raise UserError(
                f"sequence {summary.name!r}: object {name!r} was measured with another mesh than "
                "in the sequences before; re-run stage 'metrics' for this sequence"
            )
        counts[name] += found
        frames[name] += count
    return Heatmaps(
        body / max(1, body_frames),
        body_frames,
        {
            name: SurfaceHeat(points[name], counts[name] / frames[name], frames[name])
            for name in sorted(counts)
        },
    )
