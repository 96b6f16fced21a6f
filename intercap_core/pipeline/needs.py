"""How much disk a project's results take and will take, and what is said when it is not there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from intercap_core.disk import fault_in, free_bytes, told
from intercap_core.errors import UserError
from intercap_core.pipeline.requests import recorded_mb
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

# Bytes of a sequence of 300 frame sets by six cameras, as the demo's recordings have them (1080p
# colour, NFOV depth) in their 45 sets. Where none of the project's own is there to go by, these are
# scaled by the bytes of its recordings, which frames are about as large as.
_USUAL = {
    "frames": 750_000_000, "detections": 5_000_000, "scene": 2_000_000, "person": 7_000_000,
    "object_track": 200_000, "body_fit": 1_100_000, "joint": 700_000, "metrics": 5_000_000,
    "summary": 2_500_000, "page": 15_000_000, "export": 60_000_000,
}  # fmt: skip


@dataclass(frozen=True)
class Needs:
    """Bytes: ``there`` of results, ``usual`` of one sequence by stage, ``missing`` of all that is
    not there yet, ``free`` on the disk. ``basis``: what is gone by, where it is no result."""

    there: int
    usual: dict[str, float]
    missing: float
    free: int
    basis: str


def needs(project: Project) -> Needs:
    """Look at the sizes of all outputs."""
    sizes: dict[str, list[int]] = {stage: [] for stage in STAGES}
    missing = dict.fromkeys(STAGES, 0)
    for name in project.sequences:
        for stage in STAGES:
            path = project.artefact(name, stage)
            if path.exists():
                sizes[stage].append(_bytes(path))
            else:
                missing[stage] += 1
    scale, basis = _guess(project)
    usual = {
        stage: sum(found) / len(found) if found else scale * _USUAL[stage]
        for stage, found in sizes.items()
    }
    return Needs(
        there=sum(map(sum, sizes.values())),
        usual=usual,
        missing=sum(missing[stage] * usual[stage] for stage in STAGES),
        free=free_bytes(project.results),
        basis="" if any(sizes.values()) else f" (by {basis})",
    )


@contextmanager
def disk_told(project: Project, output: Path, stage: str = "") -> Iterator[None]:
    """Raise a UserError in place of an error that comes of a disk that is full, over a quota or not
    writable: with what the ``stage`` of a sequence takes, and all that is missing."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        fault = fault_in(error)
        if fault is None:
            raise
        words = ""
        with suppress(OSError):  # results come and go while they are added up
            found = needs(project)
            words = f"all that is missing takes about {found.missing / 1e6:,.0f} MB"
            if stage in found.usual:
                words = f"{stage} takes about {found.usual[stage] / 1e6:,.1f} MB here, {words}"
            words += found.basis
        raise UserError(told(fault, output, words)) from error


def _guess(project: Project) -> tuple[float, str]:
    """A sequence's size beside the usual one's, and what says so."""
    recorded = [1e6 * recorded_mb(row.recordings) for row in project.sequences.values()]
    known = [size for size in recorded if size > 0]
    if not known:
        return 1.0, "sequences of 300 frames of six cameras"
    return sum(known) / len(known) / _USUAL["frames"], "the size of the recordings"


def _bytes(path: Path) -> int:
    if path.is_file():
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
