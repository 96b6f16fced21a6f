"""Figures of the physics of several sequences, from their metrics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.evaluation.figures import SequenceMetrics, pooled
from intercap_core.evaluation.known import Figures, finite, over_known
from intercap_core.evaluation.physics.carriers import Carrier


def physics_figures(sequences: Sequence[SequenceMetrics]) -> Figures:
    """Figures of the sequences whose physics was tested; empty if none was.

    - ``releases``: number of releases of an object at rest.
    - ``displacement_mm``, ``displacement_p95_mm``: mean and 95th percentile over the releases.
    - ``penetration_mm``, ``penetration_p98_mm``: mean and 98th percentile of the depth of the
      collision shape below floor and support, over the frames with a floor.
    - ``unsupported_share``, ``unknown_share``, ``undetermined_share``: frames in which nothing
      carries the object, something unknown holds it, and the carrier is not determined.
    - ``bad_share``: frames in which physics contradicts the pose.
    """
    carrier = pooled(sequences, "physics/carrier")
    if carrier is None:
        return {}
    shares = {
        f"{name}_share": float(np.mean([str(c) == kind for c in carrier]))
        for name, kind in (
            ("unsupported", Carrier.UNSUPPORTED),
            ("unknown", Carrier.UNKNOWN),
            ("undetermined", Carrier.UNDETERMINED),
        )
    }
    moved, depth, bad = (
        pooled(sequences, f"physics/{key}")
        for key in ("release_displacement", "penetration", "bad")
    )
    assert moved is not None and depth is not None and bad is not None
    depth = depth[np.isfinite(depth)]
    return finite(
        {
            "releases": len(moved),
            **shares,
            "bad_share": float(bad.mean()),
            "displacement_mm": 1e3 * over_known(np.mean, moved),
            "displacement_p95_mm": 1e3 * over_known(np.percentile, moved, 95),
            "penetration_mm": 1e3 * over_known(np.mean, depth),
            "penetration_p98_mm": 1e3 * over_known(np.percentile, depth, 98),
        }
    )
