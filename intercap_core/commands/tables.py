"""`intercap tables`: write settings and tables for a released dataset."""

from __future__ import annotations

from dataclasses import replace as changed
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from intercap_core.config_types import Name
from intercap_core.errors import UserError
from intercap_core.tables import behave, intercap
from intercap_core.tables.project_files import Draft, write_project


def write_tables(
    layout: Literal["intercap", "behave"],
    root: Path,
    output: Path,
    *,
    dataset: str | None,
    sources: intercap.Sources,
    objects: Path,
    replace: bool,
) -> tuple[Draft, list[Path]]:
    """Write the project of a release into ``output``; returns its content and its files.

    The layouts are described in :mod:`intercap_core.tables`. Raises UserError if a folder of the
    release is missing or malformed, or if files exist in ``output`` and ``replace`` is False.

    Args:
        root: folder of the release.
        dataset: name of the dataset; default: the layout.
        sources: folders of the release outside ``root``.
        objects: objects.yaml to use if the release's meshes are not given.
        replace: overwrite existing files.
    """
    name = dataset or layout
    try:
        TypeAdapter(Name).validate_python(name)
    except ValidationError:
        raise UserError(
            f"--dataset is {name!r}: a name has letters, digits, _ and - only, and does not start "
            "with -"
        ) from None
    for path in (root, sources.calibrations, sources.annotations, sources.meshes, sources.results):
        if path is not None and not path.is_dir():
            raise UserError(f"{path}: no such folder; correct the path")
    if layout == "intercap":
        draft = intercap.draft(root, sources, dataset=name, objects=objects)
    else:
        if changed(sources, results=None) != intercap.Sources():
            raise UserError(
                "layout 'behave' has fixed places for calibration, meshes and detections; "
                "leave out --calibrations, --annotations, --meshes, --keypoints and --candidates"
            )
        draft = behave.draft(root, dataset=name, results=sources.results)
    return draft, write_project(draft, output, replace=replace)
