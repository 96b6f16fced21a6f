"""What the track's artefact holds where there is no object: nothing that could be taken for one."""

from __future__ import annotations

import numpy as np

from intercap_core.schemas import OBJECT_TRACK

SOURCE = "none"  # the artefact's seed_source
NOT_NAMED = "the sequence names no object: a person alone"

# Of each type, what stands for "not known".
_UNKNOWN = {"f": np.nan, "i": -1, "b": False}


def absent_track(frames: int, cameras: int) -> dict[str, np.ndarray]:
    """All datasets but the cameras' names: lost in every frame, poses NaN, no candidate kept."""
    lengths = {"T": frames, "C": cameras}
    found = {}
    for key, field in OBJECT_TRACK.fields.items():
        if field.dtype != "str" and not field.optional:
            shape = [lengths[dim] if dim in lengths else int(dim) for dim in field.dims]
            dtype = np.dtype(field.dtype)
            found[key] = np.full(shape, _UNKNOWN[dtype.kind], dtype)
    return found | {
        "lost": np.ones(frames, bool),
        "views": np.zeros(frames, np.int8),
        "probability": np.zeros(frames, np.float32),
    }
