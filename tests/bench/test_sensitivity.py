"""The bench of constants: its list is of the code, its table says what changed, and it resumes."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from bench import replay
from bench.changed_constant import find_constant
from bench.replay import STAGES, Outcome, Replays, Run
from bench.sensitivity import RISKIEST, Probe, changes, probe
from bench.stage_figures import STAGES_WITH_FIGURES
from intercap_core.errors import UserError


def test_the_riskiest_are_constants_of_rooms_that_can_be_replayed() -> None:
    found = [find_constant(entry.name) for entry in RISKIEST]
    assert len({(c.module, c.name) for c in found}) == len(RISKIEST) >= 30
    assert {c.room for c in found} <= set(STAGES)


def test_the_last_stage_of_every_replay_has_figures() -> None:
    assert {stages[-1] for stages in STAGES.values()} <= set(STAGES_WITH_FIGURES)


def test_small_changes_are_not_told() -> None:
    usual = Outcome("1", "1", {"a mm": 1.0, "b mm": 2.0, "flagged": 0.0}, 1.0)
    other = Outcome("1", "2", {"a mm": 1.01, "b mm": 1.0, "flagged": 4.0}, 1.0)
    assert changes(usual, other) == {"b mm": (2.0, 1.0, -0.5)}


@pytest.fixture
def replays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Replays:
    """Replays of which nothing is computed: doubling doubles the figure, halving fails."""
    started: list[Run] = []

    def start(self: Replays, run: Run) -> Outcome:
        started.append(run)
        if run.factor == 0.5:
            return Outcome("4", "2", {}, 1.0, "object_track: nothing found")
        return Outcome("4", "8", {"object mm": run.factor, "flagged": 3 * run.factor}, 2.0)

    monkeypatch.setattr(Replays, "_start", start)
    monkeypatch.setattr(replay, "content_key", lambda *given: str(given))
    made = Replays(Path("x.yaml"), ["a"], tmp_path / "known.json", 1)
    made.started = started  # type: ignore[attr-defined]
    return made


def test_the_table_says_what_half_and_double_do(replays: Replays) -> None:
    table = probe(replays, [Probe("object_track.COMMON_ERROR_VARIANCE", "what views err together")])
    row = next(line for line in table.splitlines() if "COMMON_ERROR_VARIANCE" in line)
    assert "2: fails, object_track: nothing found" in row
    assert "8: object mm 1 → 2 | +3 | 2" in row


def test_what_is_known_is_not_computed_again(replays: Replays, tmp_path: Path) -> None:
    probes = [Probe("object_track.COMMON_ERROR_VARIANCE")]
    first = probe(replays, probes)
    assert len(replays.started) == 3  # type: ignore[attr-defined]
    again = Replays(Path("x.yaml"), ["a"], tmp_path / "known.json", 1)
    again._start = None  # type: ignore[assignment, method-assign]
    assert probe(again, probes) == first
    assert len(json.loads((tmp_path / "known.json").read_text())) == 3


def test_a_run_survives_the_way_into_its_process() -> None:
    run = Run("joint", find_constant("joint.CONTACT_SIGMA"), 2.0, 1.0)
    assert replay.run_from(json.loads(json.dumps(asdict(run)))) == run


def test_a_room_without_a_stage_is_refused(replays: Replays) -> None:
    with pytest.raises(UserError, match="no stage to replay"):
        probe(replays, [Probe("metrics.CONTACT_M")])
