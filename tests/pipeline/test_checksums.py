"""Results that changed after they were made are read through; a full disk leaves none behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts, schemas
from intercap_core.pipeline import checksums
from intercap_core.pipeline.checksums import (
    InputChecksums,
    find_damage,
    forget_output,
    is_unchanged,
    read_valid_manifest,
    remember_output,
)
from intercap_core.pipeline.provenance import Manifest, read_manifest, write_manifest

WRITES = """
import resource, sys
from pathlib import Path
import numpy as np
from intercap_core import artefacts
from intercap_core.artefact_schema import Field, Schema
from intercap_core.disk import fault_in
schema = Schema("some", 1, "frames", {"rows": Field(("T", "100"), "float64", "noise")})
values = np.random.default_rng(0).random((20, 100))
path, unharmed = Path(sys.argv[1]), Path(sys.argv[2])
for limit in range(0, 420_000, 7_001):  # bytes that the disk takes
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with artefacts.write(path, schema) as writer:
            rows = writer.stream("rows", (100,))
            for _ in range(20):
                rows.append(values)
        artefacts.put_made_from(path, "of this")
        outcome = "whole"
    except OSError as error:
        outcome = "full" if fault_in(error) is not None else repr(error)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    print(outcome, len(list(path.parent.iterdir())))
    path.unlink(missing_ok=True)
unharmed.touch()
"""


TOLD = """
import sys, time
from pathlib import Path
import numpy as np
from intercap_core import artefacts, disk
from intercap_core.artefact_schema import Field, Schema
from intercap_core.signals import Terminated, raise_on_signals
schema = Schema("some", 1, "frames", {"rows": Field(("T", "5000"), "float64", "noise")})

class Slow(disk.PartFile):
    def write(self, data):
        time.sleep(0.005)  # as a busy file server
        return super().write(data)

artefacts.PartFile = Slow
disk.unbroken(Slow.write)
values = np.random.default_rng(0).random((4, 5000))
try:
    with raise_on_signals(), artefacts.write(Path(sys.argv[1]), schema) as writer:
        rows = writer.stream("rows", (5000,))
        print("begun", flush=True)
        while True:
            rows.append(values)
except Terminated as end:
    raise SystemExit(end.status)
"""


@pytest.fixture
def summary(tmp_path: Path) -> Path:
    """An artefact of some rows, under the name that its stage gives it."""
    path = tmp_path / "s01" / "object_track.h5"
    schema = schemas.OBJECT_TRACK
    with artefacts.write(path, schema, **dict.fromkeys(schema.attributes, "x")) as writer:
        for key, declared in schema.fields.items():
            if not declared.optional and "{camera}" not in key:
                shape = [int(dim) if dim.isdigit() else 40 for dim in declared.dims]
                text = declared.dtype == "str"
                writer.put(key, ["words"] * 40 if text else np.ones(shape, declared.dtype))
    return path


def test_a_result_is_known_again_until_it_changes(summary: Path) -> None:
    assert not is_unchanged(summary) and find_damage(summary) == ""
    remember_output(summary)
    assert is_unchanged(summary)
    os.utime(summary, (1.0, 1.0))
    assert not is_unchanged(summary) and find_damage(summary) == ""
    with summary.open("ab") as file:  # which no checksum lies over
        file.write(b"more")
    assert "differs from the file that was written" in find_damage(summary)
    remember_output(summary)
    assert is_unchanged(summary)
    (summary.with_name(f".{summary.name}.left")).write_text("[1, ")
    assert not is_unchanged(summary) and find_damage(summary) == ""
    remember_output(summary)
    forget_output(summary)
    assert not is_unchanged(summary)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_flipped_bits_and_truncation_are_detected(summary: Path, share: float) -> None:
    whole = summary.read_bytes()
    where = whole.rindex(b"\x78\x01", 0, int(share * len(whole)) + 4000)  # of compressed numbers
    flipped = bytearray(whole)
    flipped[where + 3] ^= 0x10
    summary.write_bytes(flipped)
    assert "delete" in find_damage(summary) and str(summary) in find_damage(summary)
    summary.write_bytes(whole[: int(share * len(whole))])
    assert "delete" in find_damage(summary)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda file: file.write_bytes(b"numb"), "has 4 bytes, it was written with 7;"),
        (
            lambda file: file.write_bytes(b"NUMBERS"),
            "differs from the file that was written; delete it and",
        ),
        (lambda file: file.unlink(), "is missing;"),
        (lambda file: (file.unlink(), file.mkdir()), "is missing;"),
        (lambda file: (file.unlink(), file.symlink_to("none")), "is missing;"),
        (lambda file: file.write_bytes(b""), "has 0 bytes, it was written with 7;"),
    ],
)
def test_a_damaged_file_of_a_folder_is_named(
    tmp_path: Path, fault: Callable[[Path], object], words: str
) -> None:
    folder = tmp_path / "export"
    (folder / "amass").mkdir(parents=True)
    file = folder / "amass" / "body.npz"
    file.write_bytes(b"numbers")
    made = Manifest("export", "s01", {}, {}, {}, {}, {})
    write_manifest(folder, made)
    remember_output(folder)
    found = read_valid_manifest(folder)
    assert found is not None and found.fingerprint == made.fingerprint
    assert find_damage(folder) == "" and is_unchanged(folder)
    os.utime(file, (1.0, 1.0))
    assert read_valid_manifest(folder) == found and is_unchanged(folder)
    fault(file)
    assert find_damage(folder) == f"{file}: {words} run again"
    assert read_valid_manifest(folder) is None


@pytest.mark.parametrize("name", ["joint.h5", "export/.made_from.json"])
def test_a_pipe_in_place_of_an_output_is_not_opened(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    os.mkfifo(path)
    output = path if path.suffix == ".h5" else path.parent
    assert read_valid_manifest(output) is None and read_manifest(output) is None


def test_a_full_disk_leaves_no_file_and_no_crash(tmp_path: Path) -> None:
    results, unharmed = tmp_path / "results", tmp_path / "unharmed"
    results.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", WRITES, str(results / "a.h5"), str(unharmed)],
        capture_output=True, text=True, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.returncode == 0 and unharmed.is_file(), done.stderr[-2000:]
    outcome = done.stdout.split("\n")[:-1]
    assert set(outcome) == {"full 0", "whole 1"}
    assert outcome == sorted(outcome), "more room, and yet it failed"


def test_a_signal_during_a_write_ends_the_process_cleanly(tmp_path: Path) -> None:
    results = tmp_path / "results"
    results.mkdir()
    for moment_s in (0.05, 0.33):
        run = subprocess.Popen(
            [sys.executable, "-c", TOLD, str(results / "a.h5")],
            stdout=subprocess.PIPE, cwd=Path(__file__).parents[2],
        )  # fmt: skip
        assert run.stdout is not None and run.stdout.readline()
        time.sleep(moment_s)
        run.terminate()
        assert run.wait(30) == 128 + signal.SIGTERM
        assert list(results.iterdir()) == []


def test_another_result_that_is_put_back_is_no_damage(summary: Path) -> None:
    remember_output(summary)
    artefacts.put_made_from(summary, "other settings")
    assert not is_unchanged(summary) and find_damage(summary) == ""
    remember_output(summary)
    artefacts.put_made_from(summary, "settings of another one")
    summary.write_bytes(summary.read_bytes()[:-2000])
    assert "delete" in find_damage(summary)


def test_inputs_are_read_once_and_by_size_and_date(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, store = tmp_path / "k1.mkv", tmp_path / "s01" / ".inputs.json"
    store.parent.mkdir()
    file.write_bytes(b"images")
    inputs = InputChecksums(store)
    digest = inputs.digest(file)
    inputs.save()
    reads: list[Path] = []
    take = checksums.file_digest
    monkeypatch.setattr(checksums, "file_digest", lambda path: reads.append(path) or take(path))
    again = InputChecksums(store)
    assert again.digest(file) == digest and reads == []
    file.touch()
    assert again.digest(file) == digest and reads == [file]  # the same content
    again.save()
    assert InputChecksums(store).digest(file) == digest and len(reads) == 1
    file.write_bytes(b"others")
    assert again.digest(file) != digest
    assert again.digest(tmp_path / "none") == "missing"
    monkeypatch.setattr(checksums, "_LARGE_BYTES", 3)
    file.write_bytes(b"longer than before")
    count = len(reads)
    assert again.digest(file, was=digest) == "changed" and len(reads) == count


def test_digest_of_a_folder_follows_its_files(tmp_path: Path) -> None:
    folder = tmp_path / "k1"
    (folder / "colour").mkdir(parents=True)
    (folder / "colour" / "00001.jpg").write_bytes(b"one")
    inputs = InputChecksums(tmp_path / ".inputs.json")
    first = inputs.digest(folder)
    (folder / "colour" / "00002.jpg").write_bytes(b"two")
    second = inputs.digest(folder)
    (folder / "colour" / "00002.jpg").unlink()
    assert first != second and inputs.digest(folder) == first
    (folder / "colour" / "00001.jpg").write_bytes(b"uno")  # in place
    assert inputs.digest(folder) != first


def test_one_look_sees_each_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, store, looks = tmp_path / "k1.mkv", tmp_path / ".inputs.json", []
    file.write_bytes(b"images")
    first = InputChecksums(store).digest(file)
    take = checksums._input_stamp
    monkeypatch.setattr(checksums, "_input_stamp", lambda path: looks.append(path) or take(path))
    inputs = InputChecksums(store, one_look=True)
    assert inputs.digest(file) == first and inputs.digest(file) == first
    assert len(looks) == 2  # before and after it was read
    file.write_bytes(b"others")
    assert inputs.digest(file) == first != InputChecksums(store, one_look=True).digest(file)


def _rewrite(path: Path, content: bytes) -> None:
    """Overwrite in place with the size and dates of before."""
    before = path.stat()
    assert len(content) == before.st_size
    time.sleep(0.01)  # a tick of the clock that dates files
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.parametrize(
    "change",
    ["one of many", "file behind a link", "folder behind a link", "dangling link", "retargeted"],
)
def test_any_changed_file_of_a_folder_changes_the_digest(tmp_path: Path, change: str) -> None:
    """The file is rewritten in place, with its old size and date."""
    folder, outside = tmp_path / "k1", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    for number in range(250):
        (folder / f"{number:05}.jpg").write_bytes(b"one")
    (outside / "a.jpg").write_bytes(b"one")
    (outside / "b.jpg").write_bytes(b"two")
    (folder / "file").symlink_to(outside / "a.jpg")
    (folder / "others").symlink_to(outside)
    (folder / "none").symlink_to(tmp_path / "none")
    (folder / "back").symlink_to(folder)
    inputs = InputChecksums(tmp_path / ".inputs.json")
    before = inputs.digest(folder)
    assert ":" in before and inputs.digest(folder) == before
    match change:
        case "one of many":
            _rewrite(folder / "00200.jpg", b"uno")
        case "file behind a link":
            _rewrite(outside / "a.jpg", b"uno")
        case "folder behind a link":
            _rewrite(outside / "b.jpg", b"due")
        case "dangling link":
            (tmp_path / "none").write_bytes(b"there")
        case "retargeted":
            (folder / "file").unlink()
            (folder / "file").symlink_to(outside / "b.jpg")
    assert inputs.digest(folder) != before


def test_pipes_devices_and_odd_names_are_digested_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    inputs = InputChecksums(tmp_path / "s01" / ".inputs.json")
    (tmp_path / "s01").mkdir()
    assert inputs.digest(tmp_path / "pipe") == inputs.digest(Path("/dev/zero")) == "no file"
    folder = tmp_path / "keypoints"
    folder.mkdir()
    os.mkfifo(folder / "pipe")
    odd = Path(os.fsdecode(os.fsencode(folder) + b"/caf\xe9.json"))
    odd.write_bytes(b"{}")
    before = inputs.digest(folder)
    assert ":" in before and ":" in inputs.digest(odd)
    odd.write_bytes(b"[]")
    assert inputs.digest(folder) != before
    inputs.save()
    assert InputChecksums(tmp_path / "s01" / ".inputs.json").digest(odd) == inputs.digest(odd)
    assert inputs.digest(tmp_path / "a\0b") == inputs.digest(tmp_path / ("x" * 300)) == "missing"
