"""The previous result of a sequence: backup before a run from the page, and comparison.

A run that failed or was stopped leaves results of two annotations. The backup is therefore kept
until a run has succeeded and the next run starts.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import stated_errors
from intercap_core.project import Project
from intercap_core.schemas import JOINT, OBJECT_TRACK
from intercap_core.stage_list import SEQUENCE_STAGES

_MARK = "kept.json"  # time of the backup, stages of the run, and whether the run succeeded


def before_folder(project: Project, sequence: str) -> Path:
    """Return the folder of the backup."""
    return project.results / ".annotate" / sequence / "before"


def before_paths(project: Project, sequence: str) -> dict[str, Path]:
    """Return the artefacts of the backup by stage."""
    folder = before_folder(project, sequence)
    return {stage: folder / f"{stage}.h5" for stage in SEQUENCE_STAGES}


def keep(project: Project, sequence: str, stages: Sequence[str]) -> None:
    """Back up the artefacts before a run of ``stages``, by hard links if possible.

    The backup is not replaced if the previous run did not succeed.
    """
    folder = before_folder(project, sequence)
    kept = _mark(folder)
    if kept is not None and not _ended_well(project, sequence, kept):
        return
    part = folder.with_name("before.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    for stage in SEQUENCE_STAGES:
        path = project.artefact(sequence, stage)
        if path.is_file():
            try:
                os.link(path, part / path.name)
            except OSError:
                shutil.copy2(path, part / path.name)
    _write(part, {"at": time.time(), "stages": list(stages), "ended": False})
    shutil.rmtree(folder, ignore_errors=True)
    part.rename(folder)


def ended_well(project: Project, sequence: str) -> None:
    """Record that the run succeeded, so that the next run replaces the backup."""
    folder = before_folder(project, sequence)
    kept = _mark(folder)
    if kept is not None:
        _write(folder, kept | {"ended": True})


def _ended_well(project: Project, sequence: str, kept: Mapping[str, Any]) -> bool:
    """Return whether the run succeeded, or all its artefacts were written since.

    The latter happens if the server was killed, or by a run in a terminal.
    """
    outputs = [project.artefact(sequence, s) for s in SEQUENCE_STAGES if s in kept["stages"]]
    return bool(kept["ended"]) or (
        bool(outputs) and all(p.is_file() and p.stat().st_mtime > kept["at"] for p in outputs)
    )


def _mark(folder: Path) -> dict[str, Any] | None:
    try:
        mark = json.loads((folder / _MARK).read_text(encoding="utf-8"))
        return {"at": float(mark["at"]), "stages": list(mark["stages"]), "ended": mark["ended"]}
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _write(folder: Path, kept: Mapping[str, Any]) -> None:
    part = folder / f"{_MARK}.part"
    part.write_text(json.dumps(kept), encoding="utf-8")
    part.replace(folder / _MARK)


def compare(project: Project, sequence: str) -> dict[str, Any]:
    """Compare the result with the backup: figures, and motion of body and object, millimetres.

    Without a backup, there are no rows of old figures.
    """
    old = before_paths(project, sequence)
    new = {stage: project.artefact(sequence, stage) for stage in SEQUENCE_STAGES}
    rows: list[dict[str, Any]] = []
    comparison: dict[str, Any] = {
        "rows": rows,
        "there": old["joint"].is_file(),
        **_when(project, sequence),
    }
    figures = [_figures(old), _figures(new)]
    for name in dict.fromkeys([*figures[0], *figures[1]]):
        rows.append({"name": name, "old": figures[0].get(name), "new": figures[1].get(name)})
    try:
        with artefacts.read(old["joint"], JOINT) as a, artefacts.read(new["joint"], JOINT) as b:
            if a["joints"].shape == b["joints"].shape:
                moved = np.linalg.norm(a["joints"] - b["joints"], axis=2).mean(1)
                comparison["body_moved_mm"] = (1e3 * moved).round(1).tolist()
                shift = np.linalg.norm(a["translation"] - b["translation"], axis=1)
                if np.isfinite(shift).all():
                    comparison["object_moved_mm"] = (1e3 * shift).round(1).tolist()
    except artefacts.Unreadable:
        pass
    return comparison


def _when(project: Project, sequence: str) -> dict[str, Any]:
    """Return times of the old result and its backup, and whether a run since did not succeed."""
    folder = before_folder(project, sequence)
    kept, joint = _mark(folder), before_paths(project, sequence)["joint"]
    if kept is None or not joint.is_file():
        return {}
    return {
        "made_at": _moment(joint.stat().st_mtime),
        "kept_at": _moment(kept["at"]),
        "unfinished": not _ended_well(project, sequence, kept),
    }


def _moment(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


def _figures(paths: Mapping[str, Path]) -> dict[str, float | None]:
    rows: dict[str, float | None] = {}
    try:
        metrics = SequenceMetrics.read(paths["metrics"])
        for error in stated_errors(metrics):
            stated = error.stated if np.isfinite(error.stated) else None
            rows[f"{error.part}, stated error, mm"] = None if stated is None else round(stated, 1)
        rows["flagged frames"] = int(metrics.values["flagged"].sum())
        if metrics.has_object:
            rows["frames in contact"] = int(metrics.values["contact_frame"].sum())
            depth = metrics.values["penetration_mean"]
            rows["penetration, mm"] = round(1e3 * float(np.nanmean(depth)), 2)
    except artefacts.Unreadable:
        pass
    with (
        contextlib.suppress(artefacts.Unreadable),
        artefacts.read(paths["object_track"], OBJECT_TRACK) as track,
    ):
        rows["frames with the object lost"] = int(track["lost"].sum())
        rows["frames with an ambiguous turn"] = int(track["ambiguous"].sum())
    return rows
