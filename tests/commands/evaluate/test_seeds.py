"""New random seeds change recordings and people, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from intercap_core.commands.evaluate.seeds import redraw_settings
from intercap_core.project import Project, load_project

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Results are relative to where the workflow runs."""
    (tmp_path / "config").symlink_to(ROOT / "config")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def drawn(here: Path, name: str, seed: int) -> Project:
    path = Path("config") / "object" / name
    return load_project(redraw_settings({"objects": [path]}, seed)["objects"][0])


def test_only_seeds_and_people_change(here: Path) -> None:
    old = load_project(Path("config/object/config.yaml"))
    new, other = (drawn(here, "config.yaml", seed) for seed in (5, 6))
    assert old.config.studio and new.config.studio and other.config.studio
    captures = [project.config.studio.captures for project in (old, new, other)]
    assert captures[0].keys() == captures[1].keys()
    for name, capture in captures[0].items():
        one, two = captures[1][name], captures[2][name]
        assert len({capture.seed, one.seed, two.seed}) == 3
        assert len({capture.subject, one.subject, two.subject}) == 3
        kept = {"seed": 0, "subject": ""}
        assert capture.model_copy(update=kept) == one.model_copy(update=kept)
        assert new.sequences[name].subject == one.subject
        assert new.sequences[name].object == old.sequences[name].object
    assert new.config.object_track == old.config.object_track and new.config.dataset == "object"


def test_shared_recordings_stay_shared(here: Path) -> None:
    """Those without a detector are those of config.yaml."""
    shared, own = drawn(here, "no_detector.yaml", 5), drawn(here, "config.yaml", 5)
    assert shared.results == Path("results/seed_5/object_no_detector")
    for name, row in shared.sequences.items():
        assert row.recordings == own.sequences[name].recordings
        assert row.truth is not None and row.truth.is_relative_to("results/seed_5/object")
        assert own.recordings_made(name) is not None
