"""One process at a time writes an output; expired leases are taken over, others waited for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path

import pytest

from intercap_core.errors import UserError
from intercap_core.pipeline import lease as leases
from intercap_core.pipeline.lease import (
    Lease,
    LeaseOwner,
    acquire,
    lease_holder,
    lease_path,
    try_acquire,
)

HOLD = """
import sys, time
from pathlib import Path
from intercap_core.pipeline.lease import acquire
with acquire(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(float(sys.argv[2]))
"""


def _hold(output: Path, seconds: float) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(output), str(seconds)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def _write_lease(output: Path, *, age_s: float) -> Path:
    """A lease of another machine, whose last heartbeat was ``age_s`` ago."""
    owner = LeaseOwner("elsewhere", 1, "77", "2026-01-01 00:00:00", "token")
    path = lease_path(output)
    path.write_text(json.dumps(asdict(owner)))
    then = time.time() - age_s
    os.utime(path, (then, then))
    return path


def test_second_process_waits_for_the_first(tmp_path: Path) -> None:
    output = tmp_path / "joint.h5"
    first = _hold(output, 2.0)
    holder = try_acquire(lease_path(output))
    assert isinstance(holder, LeaseOwner) and holder.pid == first.pid
    assert lease_holder(output) == holder and f"process {first.pid} on " in str(holder)
    with acquire(output) as own:
        assert first.wait() == 0
        assert own.is_held()
    assert not lease_path(output).exists() and lease_holder(output) is None


def test_expired_lease_is_taken_over_and_parts_are_removed(tmp_path: Path) -> None:
    output = tmp_path / "joint.h5"
    _write_lease(output, age_s=2 * leases.EXPIRES_S)
    (tmp_path / ".joint.h5.host.1.part").write_text("half")
    (tmp_path / ".metrics.h5.host.1.part").write_text("another's")
    with acquire(output) as own:
        assert own.expired_owner is not None and own.expired_owner.job == "77"
        assert [p.name for p in tmp_path.glob("*.part")] == [".metrics.h5.host.1.part"]
    assert not lease_path(output).exists()


@pytest.mark.parametrize("text", ["", "no JSON"])
def test_unreadable_lease_counts_by_its_heartbeat(tmp_path: Path, text: str) -> None:
    output = tmp_path / "joint.h5"
    path = _write_lease(output, age_s=0.0)
    path.write_text(text)
    assert isinstance(try_acquire(path), LeaseOwner)
    os.utime(path, (1.0, 1.0))
    lease = try_acquire(path)
    assert isinstance(lease, Lease)
    lease.release()


def test_lost_lease_is_noticed_and_left_to_its_new_owner(tmp_path: Path) -> None:
    output = tmp_path / "joint.h5"
    with acquire(output) as own:
        _write_lease(output, age_s=0.0)
        assert not own.is_held()
    assert lease_path(output).exists()


def test_one_of_many_threads_holds_it_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "_POLL_S", 0.05)
    output, inside, counts = tmp_path / "x.h5", [], []

    def work() -> None:
        with acquire(output):
            inside.append(1)
            counts.append(len(inside))
            time.sleep(0.01)
            inside.pop()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert counts == [1, 1, 1, 1]


def test_folder_without_its_replacement_is_restored(tmp_path: Path) -> None:
    old = tmp_path / ".export.host.1.old"
    old.mkdir()
    (old / "export.json").write_text("{}")
    with acquire(tmp_path / "export"):
        assert (tmp_path / "export" / "export.json").is_file() and not old.exists()


def test_heartbeat_updates_the_date(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leases, "BEAT_S", 0.05)
    path = lease_path(tmp_path / "x.h5")
    with acquire(tmp_path / "x.h5"):
        os.utime(path, (1.0, 1.0))
        for _ in range(100):
            if path.stat().st_mtime > 1.0:
                break
            time.sleep(0.05)
        assert path.stat().st_mtime > 1.0


def test_folder_that_is_not_writable_is_named(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("a file")
    with (
        pytest.raises(UserError, match="results: cannot be written"),
        acquire(tmp_path / "results" / "x.h5"),
    ):
        pass
