"""`intercap init`: write settings and tables for a folder of recordings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace as changed
from pathlib import Path

from pydantic import TypeAdapter, ValidationError
from rich.markup import escape

from intercap_core.commands.console import ListTable, print_plain, standard_console
from intercap_core.config_types import Name
from intercap_core.errors import UserError
from intercap_core.tables import behave, intercap, own
from intercap_core.tables.project_files import Draft, Sources, write_project


def write_tables(
    root: Path,
    output: Path,
    *,
    dataset: str | None,
    sources: Sources,
    objects: Path | None,
    replace: bool,
) -> tuple[Draft, list[Path]]:
    """Write the project of a folder of recordings into ``output``; returns content and files.

    The InterCap release and BEHAVE are recognised by their folders. Raises UserError if a folder is
    missing or malformed, or if files exist in ``output`` and ``replace`` is False.

    Args:
        root: folder of recordings, or of a release.
        dataset: name of the dataset; default: the release's name, or that of the folder.
        sources: folders outside ``root``.
        objects: objects.yaml to use instead of meshes.
        replace: overwrite existing files.
    """
    for path in (root, *vars(sources).values()):
        if path is not None and not path.is_dir():
            raise UserError(f"{path}: no such folder; correct the path")
    if objects is not None and not objects.is_file():
        raise UserError(f"{objects}: no such file; correct --objects")
    if objects is not None and sources.meshes is not None:
        raise UserError("--objects names the meshes already; leave --meshes out")
    if intercap.is_release(root):
        name = _dataset(dataset or "intercap")
        draft = intercap.draft(root, sources, dataset=name, objects=objects)
    elif behave.is_release(root):
        _refuse(sources, Sources(results=sources.results), "BEHAVE has fixed places for these")
        if objects is not None:
            raise UserError("--objects: not used, because BEHAVE has its own; leave the option out")
        name = _dataset(dataset or "behave")
        draft = behave.draft(root, dataset=name, results=sources.results)
    else:
        used = changed(sources, calibrations=None, annotations=None, results=None)
        _refuse(sources, used, f"{root} is no copy of the InterCap release")
        name = _dataset(dataset or own.clean_name(root.resolve().name))
        draft = own.draft(root, sources, dataset=name, objects=objects)
    return draft, write_project(draft, output, replace=replace)


def _dataset(name: str) -> str:
    try:
        return TypeAdapter(Name).validate_python(name)
    except ValidationError:
        raise UserError(
            f"--dataset is {name!r}: a name has letters, digits, _ and - only, and does not start "
            "with -"
        ) from None


def _refuse(sources: Sources, used: Sources, why: str) -> None:
    """Raise UserError for the options that ``used`` lacks."""
    unused = [f"--{name}" for name, path in vars(sources).items() if path != vars(used)[name]]
    if unused:
        raise UserError(f"{', '.join(unused)}: not used, because {why}; leave the option out")


def print_draft(draft: Draft, root: Path) -> None:
    """Print what was recognised, one row for each sequence, and what a person has to fill in."""
    table = ListTable(
        "sequence", "layout", "cameras", "calibration", "keypoints", "masks (candidates)", "object",
        "subject",
    )  # fmt: skip
    for row in draft.rows:
        table.add_row(*(escape(cell) for cell in _cells(row.columns, row.cameras, root)))
    console = standard_console()
    console.print(table)
    for remark in draft.all_remarks():
        print_plain(console, remark)


def _cells(columns: dict[str, str | Path], cameras: list[str], root: Path) -> Iterator[str]:
    yield str(columns["sequence"])
    yield str(columns["layout"])
    yield ", ".join(cameras)
    for name in ("calibration", "keypoints", "candidates"):
        path = columns.get(name, "-")
        if isinstance(path, Path) and not path.exists():
            path = "-"
        inside = isinstance(path, Path) and path.is_relative_to(root)
        yield str(path.relative_to(root) if inside else path)  # type: ignore[union-attr]
    yield str(columns.get("object", "-"))
    yield str(columns["subject"])
