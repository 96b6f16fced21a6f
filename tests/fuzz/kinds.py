"""All kinds of files, by name."""

from __future__ import annotations

from tests.fuzz import (
    kinds_cameras,
    kinds_detections,
    kinds_models,
    kinds_project,
    kinds_recordings,
)
from tests.fuzz.kind import Kind

KINDS: dict[str, Kind] = {
    kind.name: kind
    for kinds in (kinds_cameras, kinds_project, kinds_detections, kinds_recordings, kinds_models)
    for kind in kinds.KINDS
}
