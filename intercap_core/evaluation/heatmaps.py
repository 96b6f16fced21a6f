"""Contact likelihood on the body and on each object, over all sequences (the paper's heatmaps)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from intercap_core.evaluation.summary import SequenceSummary


@dataclass(frozen=True, eq=False)
class SurfaceHeat:
    """Share of ``frames`` in which each of ``points`` (N, 3), rest pose, is in contact (N,)."""

    points: np.ndarray
    likelihood: np.ndarray
    frames: int


@dataclass(frozen=True, eq=False)
class Heatmaps:
    """``body`` (V,) share of ``body_frames`` in contact; one map an object by name. ``left_out``:
    sequences that do not count in a map, by name, and why."""

    body: np.ndarray
    body_frames: int
    objects: dict[str, SurfaceHeat]
    left_out: dict[str, list[str]] = field(default_factory=dict)


def collect(summaries: Sequence[SequenceSummary]) -> Heatmaps:
    """Add up the sequences' counts at 4.5 mm.

    Sequences without an object count in none of the maps. A map lies on one surface: bodies of
    another vertex count than the first one's, and objects that were measured with another mesh
    than the first one of their name, are left out and told.
    """
    body = np.zeros(0)
    body_frames = 0
    left_out: dict[str, list[str]] = {}
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
        else:
            left_out.setdefault(summary.name, []).append(
                f"its body has {len(contact)} vertices where the sequences before have "
                f"{len(body)}: not in the body's heatmap"
            )
        if name not in counts:
            counts[name], points[name], frames[name] = np.zeros(len(found)), here, 0
        if not np.array_equal(points[name], here):
            left_out.setdefault(summary.name, []).append(
                f"object {name!r} was measured with another mesh than in the sequences before: not "
                "in its heatmap; re-run stage 'metrics' of those that have the older mesh"
            )
            continue
        counts[name] += found
        frames[name] += count
    return Heatmaps(
        body / max(1, body_frames),
        body_frames,
        {
            name: SurfaceHeat(points[name], counts[name] / frames[name], frames[name])
            for name in sorted(counts)
        },
        left_out,
    )
