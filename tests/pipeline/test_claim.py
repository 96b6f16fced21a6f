"""One process at a time makes an output; dead owners are taken over, living ones waited for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from intercap_core.errors import UserError
from intercap_core.pipeline import claim as claims
from intercap_core.pipeline.claim import Claim, Owner, claim, living_owner, path_of, try_claim

HOLDING = """
import sys, time
from pathlib import Path
from intercap_core.pipeline.claim import claim
with claim(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(float(sys.argv[2]))
"""


def _holder(output: Path, seconds: float) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDING, str(output), str(seconds)],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def _of_elsewhere(output: Path, *, age_s: float) -> Path:
    """A claim of another machine, touched ``age_s`` ago."""
    owner = Owner("elsewhere", "another start", 1, 1, "77", "2026-01-01 00:00:00", "token")
    path = path_of(output)
    path.write_text(json.dumps(owner.__dict__))
    then = time.time() - age_s
    os.utime(path, (then, then))
    return path


def test_who_comes_second_waits_for_the_first(tmp_path: Path) -> None:
    output = tmp_path / "joint.h5"
    first = _holder(output, 2.0)
    held = try_claim(path_of(output))
    assert isinstance(held, Owner) and held.pid == first.pid
    assert living_owner(output) == held and f"process {first.pid} on " in str(held)
    with claim(output) as own:
        assert first.wait() == 0  # it ended before this began
        assert own.still_held()
    assert not path_of(output).exists() and living_owner(output) is None


def test_a_killed_owner_is_taken_over_and_its_leftovers_go(tmp_path: Path) -> None:
    output = tmp_path / "joint.h5"
    first = _holder(output, 60.0)
    first.kill()
    first.wait()
    (tmp_path / ".joint.h5.host.1.part").write_text("half")
    (tmp_path / ".metrics.h5.host.1.part").write_text("another's")
    with claim(output):
        assert [p.name for p in tmp_path.glob("*.part")] == [".metrics.h5.host.1.part"]


def test_another_machine_lives_as_long_as_it_gives_a_sign(tmp_path: Path) -> None:
    output = tmp_path / "joint.h5"
    path = _of_elsewhere(output, age_s=1.0)
    held = try_claim(path)
    assert isinstance(held, Owner) and "job 77" in str(held)
    _of_elsewhere(output, age_s=2 * claims.DEAD_S)
    taken = try_claim(path)
    assert isinstance(taken, Claim)
    taken.release()


@pytest.mark.parametrize("hidden", [FileNotFoundError, PermissionError])
def test_a_process_that_is_hidden_lives_as_long_as_it_gives_a_sign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hidden: type[OSError]
) -> None:
    """Another user's, under /proc mounted with hidepid=2 or 1."""
    output = tmp_path / "joint.h5"
    first, send = _holder(output, 60.0), os.kill

    def no_stat(path: str, **_: object) -> None:
        raise hidden(path)

    def not_ours(pid: int, number: int) -> None:
        if number:
            send(pid, number)
        elif pid == first.pid and first.poll() is None:
            raise PermissionError
        else:
            raise ProcessLookupError

    monkeypatch.setattr(claims, "open", no_stat, raising=False)
    monkeypatch.setattr(os, "kill", not_ours)
    try:
        assert isinstance(try_claim(path_of(output)), Owner)
        then = time.time() - 2 * claims.DEAD_S
        os.utime(path_of(output), (then, then))
        assert living_owner(output) is None
        os.utime(path_of(output))
        assert living_owner(output) is not None
    finally:
        first.terminate()
        first.wait()
    taken = try_claim(path_of(output))  # though it gave a sign just before its end
    assert isinstance(taken, Claim)
    taken.release()


def test_who_lost_its_claim_knows(tmp_path: Path) -> None:
    output = tmp_path / "joint.h5"
    with claim(output) as own:
        _of_elsewhere(output, age_s=0.0)
        assert not own.still_held()
    assert path_of(output).exists()  # it is the other one's


def test_of_many_one_holds_it_at_a_time(tmp_path: Path) -> None:
    output, inside, most = tmp_path / "x.h5", [], []

    def work() -> None:
        with claim(output):
            inside.append(1)
            most.append(len(inside))
            time.sleep(0.01)
            inside.pop()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert most == [1, 1, 1, 1]


def test_a_claim_that_came_in_place_of_a_dead_one_is_left(tmp_path: Path) -> None:
    """Two look at a dead claim; the second one's removal finds the first one's new claim."""
    output = tmp_path / "x.h5"
    dead = Owner("elsewhere", "", 1, 1, "", "then", "dead")
    with claim(output) as own:
        claims._bury(path_of(output), dead)
        assert own.still_held()
    assert [path.name for path in tmp_path.iterdir()] == []


def test_a_folder_that_was_put_aside_for_none_goes_back(tmp_path: Path) -> None:
    aside = tmp_path / ".export.host.1.old"
    aside.mkdir()
    (aside / "export.json").write_text("{}")
    with claim(tmp_path / "export"):
        assert (tmp_path / "export" / "export.json").is_file() and not aside.exists()


def test_owners_give_signs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "BEAT_S", 0.05)
    output = tmp_path / "x.h5"
    with claim(output):
        os.utime(path_of(output), (1.0, 1.0))
        for _ in range(100):
            if path_of(output).stat().st_mtime > 1.0:
                break
            time.sleep(0.05)
        assert path_of(output).stat().st_mtime > 1.0


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("a file")
    with (
        pytest.raises(UserError, match="results: cannot be written"),
        claim(tmp_path / "results" / "x.h5"),
    ):
        pass
