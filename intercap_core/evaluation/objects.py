"""The object's part of `intercap evaluate`: recordings tracked and held to truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.table import Table

from intercap_core.evaluation.recordings import console_of, number, take_to, variant
from intercap_core.metrics import object_errors
from intercap_core.metrics.object_errors import ObjectErrors
from intercap_core.project import Project
from intercap_core.rigid.mesh import ObjectMesh

AREA = "object"
_WIDTH = 120
_COLUMNS = {
    "mm": ("translation_median_mm", 1), "p95": ("translation_p95_mm", 1),
    "deg": ("rotation_median_deg", 2), "p95 deg": ("rotation_p95_deg", 1),
    "ADD-S": ("add_s_recall", 2), "MSSD": ("mssd_recall", 2), "first": ("first_frame_success", 2),
    "lost": ("lost_share", 3), "unseen": ("lost_unnoticed_share", 3),
    "flagged": ("flagged_share", 2), "rest mm": ("rest_jitter_mm", 2),
    "rest deg": ("rest_jitter_deg", 2), "onset": ("motion_onset_frames", 1),
}  # fmt: skip


@dataclass(frozen=True)
class ObjectEvaluation:
    """Errors of every recording of one project, what failed, and the workflow's exit status."""

    dataset: str
    errors: Sequence[ObjectErrors]
    missing: Sequence[str]
    status: int

    @property
    def objects(self) -> dict[str, list[ObjectErrors]]:
        """The recordings of each object, by name."""
        names = sorted({e.object_ for e in self.errors})
        return {name: [e for e in self.errors if e.object_ == name] for name in names}

    def flat(self) -> dict[str, float]:
        """Keys ``object.lost_share``, ``object.cup.lost_share``, ``object.views_2.lost_share``.

        Those of a dataset called object_<variant> are ``object.<variant>_lost_share`` and so on.
        """
        start = variant(self.dataset, AREA)
        found = {f"{AREA}.{start}recordings": float(len(self.errors))}
        groups = {"": object_errors.figures(self.errors)}
        groups |= {f"{name}.": object_errors.figures(e) for name, e in self.objects.items()}
        for group, figures in groups.items():
            found |= {f"{AREA}.{group}{start}{key}": value for key, value in figures.items()}
        for views, figures in object_errors.by_views(self.errors).items():
            group = f"{start}views_{views.replace('-', '_to_')}"
            found |= {f"{AREA}.{group}.{key}": value for key, value in figures.items()}
        return found


def evaluate_objects(project: Project, *, cores: int = 0) -> ObjectEvaluation:
    """Bring the object tracks of all sequences up to date and measure them.

    Raises UserError where a sequence has no truth to be held to, or none has a track.
    """
    taken = take_to(project, "object_track", cores=cores)
    meshes = {name: ObjectMesh.load(entry) for name, entry in project.objects.items()}
    errors = [
        object_errors.measure(
            project.artefact(name, "scene"),
            path,
            taken.truths[name],
            meshes[project.sequences[name].object],
        )
        for name, path in taken.artefacts.items()
    ]
    return ObjectEvaluation(project.config.dataset, errors, taken.missing, taken.status)


def print_objects(evaluations: Sequence[ObjectEvaluation]) -> None:
    """For each project a row an object and one for all, then a row for each number of views."""
    console = console_of(_WIDTH)
    for found in evaluations:
        table = Table("object", *_COLUMNS, box=None)
        table.title = f"{found.dataset}: objects against truth, after object_track"
        for name, errors in {**found.objects, "all": list(found.errors)}.items():
            figures = object_errors.figures(errors)
            cells = (number(figures.get(key), digits) for key, digits in _COLUMNS.values())
            table.add_row(name, *cells)
        for name in found.missing:
            table.add_row(f"{name}: no track")
        console.print(table)
        table = Table("views that see it", "frames", "mm", "deg", "lost", box=None)
        for name, figures in object_errors.by_views(found.errors).items():
            digits = (0, 1, 2, 3)
            table.add_row(
                name, *(number(v, d) for v, d in zip(figures.values(), digits, strict=True))
            )
        console.print(table)
