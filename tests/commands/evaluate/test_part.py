"""Cache of measured errors, and standard errors of figures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from intercap_core.commands.evaluate.captures import PART
from intercap_core.commands.evaluate.part import measure_cached, with_spread
from intercap_core.config import Config
from intercap_core.entries import ObjectEntry, SubjectEntry
from intercap_core.errors import UserError
from intercap_core.evaluation.scene_errors import CaptureErrors, SlipCounts
from intercap_core.project import Project
from tests.helpers.kinect_files import entry_of


def test_errors_are_kept_by_content(tmp_path: Path) -> None:
    entry = entry_of(tmp_path, cameras=2).model_copy(update={"truth": tmp_path / "truth.h5"})
    config = Config(dataset="trial", results=tmp_path)
    subjects = {entry.subject: SubjectEntry(subject=entry.subject, gender="neutral")}
    objects = {entry.object: ObjectEntry(name=entry.object, mesh=tmp_path / "mesh.ply")}
    project = Project(config, tmp_path / "config.yaml", {"one": entry}, subjects, objects)
    files = [project.artefact("one", stage) for stage in ("frames", "scene")]
    for path in (*files, tmp_path / "truth.h5", tmp_path / "mesh.ply"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(path.name)
    calls: list[str] = []

    values = np.array([0.1, np.nan])
    errors = CaptureErrors(
        "one", "bare", values, values, values, values, SlipCounts(1, 0, 0, 2, 9), 0.1, 0.2, values
    )

    def measure(_: Project, sequence: str) -> CaptureErrors:
        calls.append(sequence)
        return errors

    part = replace(PART, measure=measure)
    for _ in range(2):
        found = measure_cached(part, project, "one")
        assert found.sequence == "one" and found.slips == errors.slips
        np.testing.assert_array_equal(found.after, values)
    assert calls == ["one"]
    files[1].write_text("another scene")
    measure_cached(part, project, "one")
    assert calls == ["one", "one"]
    assert len(list((files[1].parent / "evaluation").iterdir())) == 1  # the older errors are gone
    (tmp_path / "truth.h5").unlink()  # a recording that was interrupted, whose results remain
    with pytest.raises(UserError, match=r"truth.h5: the truth of 'one' is missing.*remove .*one"):
        measure_cached(part, project, "one")


def test_the_spread_is_the_standard_error_over_recordings() -> None:
    def figures(values: list[float]) -> dict[str, float]:
        return {"mm": sum(values) / len(values), "worst_mm": max(values)}

    found = with_spread(figures, [1.0, 3.0])
    assert found == {"mm": 2.0, "worst_mm": 3.0, "mm_spread": pytest.approx(1.0)}
    assert with_spread(figures, [1.0]) == {"mm": 1.0, "worst_mm": 1.0}
