"""Figures of `intercap dev bench` for recordings of known size."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from intercap_core.commands import bench
from intercap_core.commands.bench import add_figures, time_extraction
from intercap_core.config import Config
from intercap_core.entries import ObjectEntry, SubjectEntry
from intercap_core.errors import UserError
from intercap_core.project import Project
from tests.helpers.kinect_files import entry_of, record


def test_extraction_counts_sets_and_whole_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "REPEATS", 1)
    folder = tmp_path / "recordings"
    folder.mkdir()
    for camera in range(2):
        record(folder, camera, range(4))
    (folder / "notes.txt").write_text("no recording")
    entry = entry_of(folder, cameras=2)
    config = Config(dataset="trial", results=tmp_path)
    subjects = {entry.subject: SubjectEntry(subject=entry.subject, gender="neutral")}
    objects = {entry.object: ObjectEntry(name=entry.object, mesh=tmp_path / "none.ply")}
    project = Project(config, tmp_path / "config.yaml", {"one": entry}, subjects, objects)
    project.results.mkdir()
    found = time_extraction(project, "one", 4)
    recorded = sum(path.stat().st_size for path in folder.glob("*.mkv"))
    assert found["frames.recorded_bytes_per_set"] == pytest.approx(recorded / 4, abs=1)
    ratio = found["frames.bytes_per_set"] / found["frames.recorded_bytes_per_set"]
    assert found["frames.bytes_ratio"] == pytest.approx(ratio, abs=1e-3)
    assert found["frames.fps"] > 0
    assert not list(project.results.iterdir())  # nothing is left


def test_figures_of_other_commands_stay(tmp_path: Path) -> None:
    output = tmp_path / "bench.json"
    output.write_text('{"object.speedup": 5, "frames.old": 1, "frames.fps": 2}')
    add_figures(output, {"frames.fps": 3.0, "end_to_end.seconds_per_frame": 1.5})
    expected = {"object.speedup": 5, "frames.fps": 3.0, "end_to_end.seconds_per_frame": 1.5}
    assert json.loads(output.read_text()) == expected
    output.write_text("[1")
    with pytest.raises(UserError, match="holds no figures"):
        add_figures(output, {"frames.fps": 3.0})
