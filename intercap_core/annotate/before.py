"""The previous result of a sequence: backup before a run from the page, and comparison.

A run that failed or was stopped leaves a mixture of old and new results. The backup is therefore
replaced only by the first run after a successful one.
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
from intercap_core.flags import PARTS
from intercap_core.project import Project
from intercap_core.schemas import JOINT, OBJECT_TRACK
from intercap_core.stage_list import SEQUENCE_STAGES


class Backup:
    """The backup of a sequence's artefacts before the last run."""

    def __init__(self, project: Project, sequence: str) -> None:
        self.folder = project.results / ".annotate" / sequence / "before"
        self.artefacts = {stage: project.artefact(sequence, stage) for stage in SEQUENCE_STAGES}
        self.paths = {stage: self.folder / f"{stage}.h5" for stage in SEQUENCE_STAGES}

    def make(self, stages: Sequence[str]) -> None:
        """Back up the artefacts before a run of ``stages``, by hard links if possible.

        The backup is not replaced if the previous run did not succeed.
        """
        state = self._state()
        if state is not None and not self._succeeded(state):
            return
        part = self.folder.with_name("before.part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        for path in self.artefacts.values():
            if path.is_file():
                try:
                    os.link(path, part / path.name)
                except OSError:
                    shutil.copy2(path, part / path.name)
        self._write({"at": time.time(), "stages": list(stages), "ended": False}, part)
        shutil.rmtree(self.folder, ignore_errors=True)
        part.rename(self.folder)

    def mark_success(self) -> None:
        """Record that the run succeeded, so that the next run replaces the backup."""
        state = self._state()
        if state is not None:
            self._write(state | {"ended": True}, self.folder)

    def compare(self) -> dict[str, Any]:
        """Compare the result with the backup: figures, and motion of body and object, mm."""
        comparison: dict[str, Any] = {"exists": self.paths["joint"].is_file()}
        state = self._state()
        if state is not None and comparison["exists"]:
            comparison |= {
                "made_at": _isoformat(self.paths["joint"].stat().st_mtime),
                "kept_at": _isoformat(state["at"]),
                "unfinished": not self._succeeded(state),
            }
        old, new = _figures(self.paths), _figures(self.artefacts)
        comparison["rows"] = [
            {"name": name, "old": old.get(name), "new": new.get(name)} for name in old | new
        ]
        with (
            contextlib.suppress(artefacts.Unreadable),
            artefacts.read(self.paths["joint"], JOINT) as a,
            artefacts.read(self.artefacts["joint"], JOINT) as b,
        ):
            if a["joints"].shape == b["joints"].shape:
                moved = np.linalg.norm(a["joints"] - b["joints"], axis=2).mean(1)
                comparison["body_moved_mm"] = (1e3 * moved).round(1).tolist()
                shift = np.linalg.norm(a["translation"] - b["translation"], axis=1)
                if np.isfinite(shift).all():
                    comparison["object_moved_mm"] = (1e3 * shift).round(1).tolist()
        return comparison

    def _succeeded(self, state: Mapping[str, Any]) -> bool:
        """Return whether the run succeeded, or all its artefacts were written after the backup.

        The artefacts decide if the server was killed before the run ended, or if the user completed
        the run in a terminal.
        """
        outputs = [path for stage, path in self.artefacts.items() if stage in state["stages"]]
        return bool(state["ended"]) or (
            bool(outputs) and all(p.is_file() and p.stat().st_mtime > state["at"] for p in outputs)
        )

    def _state(self) -> dict[str, Any] | None:
        """Return time of the backup, stages of the run, and whether it succeeded."""
        try:
            state = json.loads((self.folder / "kept.json").read_text(encoding="utf-8"))
            return {"at": float(state["at"]), "stages": list(state["stages"]),
                    "ended": state["ended"]}  # fmt: skip
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def _write(self, state: Mapping[str, Any], folder: Path) -> None:
        part = folder / "kept.json.part"
        part.write_text(json.dumps(state), encoding="utf-8")
        part.replace(folder / "kept.json")


def _isoformat(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


def _figures(paths: Mapping[str, Path]) -> dict[str, float | None]:
    """Figures of a result that the page compares, by label; None = not stated."""
    rows: dict[str, float | None] = {}
    with contextlib.suppress(artefacts.Unreadable):
        metrics = SequenceMetrics.read(paths["metrics"])
        for error in stated_errors(metrics):
            stated = round(error.stated, 1) if np.isfinite(error.stated) else None
            rows[f"{error.part}, estimated error, mm"] = stated
        flagged = metrics.values["flagged"].sum(axis=0)
        rows |= {f"frames with a flag, {p}": int(n) for p, n in zip(PARTS, flagged, strict=True)}
        if metrics.has_object:
            rows["frames in contact"] = int(metrics.values["contact_frame"].sum())
            depth = metrics.values["penetration_mean"]
            rows["penetration, mm"] = round(1e3 * float(np.nanmean(depth)), 2)
    with (
        contextlib.suppress(artefacts.Unreadable),
        artefacts.read(paths["object_track"], OBJECT_TRACK) as track,
    ):
        rows["frames with the object lost"] = int(track["lost"].sum())
        rows["frames with an ambiguous rotation"] = int(track["ambiguous"].sum())
    return rows
