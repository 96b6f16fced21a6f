"""The list of a release's files, checked by us and by sha256sum; lists that are broken."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from intercap_core.errors import UserError
from intercap_core.output.release import manifest

FILES = {
    "README.md": "card", "card.json": "card", "summary.json": "card", "heatmaps.h5": "card",
    "tables/frames.csv": "tables", "site/index.html": "site",
    "site/sequences/s01/index.html": "site", "site/sequences/s02/index.html": "site",
    "s01/export/amass/body.npz": "export", "s01/joint.h5": "artefact",
    "s02/joint.h5": "artefact", "s01/export/a name, with spaces.txt": "export",
}  # fmt: skip
STATES = ("missing", "changed", "not in the list")
OTHERS = ("recordings/s01/truth.h5", "recordings/s01/k1.mkv", ".snakemake/log", "s01/.x.part")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number, name in enumerate([*FILES, *OTHERS]):
        path = tmp_path / "demo" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bytes([number]) * (number + 1) * 1000)
    return tmp_path / "demo"


def test_every_file_of_the_dataset_is_listed_and_no_other(folder: Path) -> None:
    entries = manifest.write(folder, {"dataset": "demo"}, threads=2)
    assert {entry.path: entry.kind for entry in entries} == FILES
    content = json.loads((folder / "release.json").read_text())
    assert content["dataset"] == "demo" and len(content["files"]) == len(FILES)
    assert manifest.check(folder) == (len(FILES), {state: [] for state in STATES})
    first = (folder / "release.json").read_bytes()
    manifest.write(folder, {"dataset": "demo"})  # the lists do not list themselves
    assert (folder / "release.json").read_bytes() == first


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="no sha256sum here")
def test_sha256sum_reads_the_list(folder: Path) -> None:
    manifest.write(folder, {})
    command = ["sha256sum", "-c", "--strict", "release.sha256"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.count(": OK") == len(FILES), done.stderr
    (folder / "s01/joint.h5").write_bytes(b"other")
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 1 and "s01/joint.h5: FAILED" in done.stdout


def test_differences_are_classified(folder: Path) -> None:
    manifest.write(folder, {}, kinds=("card", "tables", "artefact"))
    (folder / "README.md").unlink()
    changed = folder / "s02" / "joint.h5"
    changed.write_bytes(changed.read_bytes()[:-1] + b"x")  # of the same size
    (folder / "tables" / "new.csv").write_text("")
    (folder / "site" / "new.html").write_text("")  # of a kind that was not released
    _, differences = manifest.check(folder)
    expected = (["README.md"], ["s02/joint.h5"], ["tables/new.csv"])
    assert differences == dict(zip(STATES, expected, strict=True))
    assert differences


def test_kinds_and_sequences_choose(folder: Path) -> None:
    entries = manifest.write(folder, {}, kinds=("site", "export"), sequences=["s02"])
    assert [entry.path for entry in entries] == ["site/index.html", "site/sequences/s02/index.html"]
    with pytest.raises(UserError, match="no files to release"):
        manifest.write(folder, {}, kinds=("export",), sequences=["s02"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such file"),
        ("{", "is not a manifest"),
        ("[]", "is not a manifest"),
        ('{"format": 9, "files": []}', "has format 9"),
        ('{"format": 1, "files": [{"path": "a/b.h5"}]}', "is not a manifest"),
        ('{"format": 1, "files": [{"path": "../b", "kind": "card", "bytes": 1, "sha256": ""}]}',
         "is not a file of this dataset"),
        ('{"format": 1, "files": [{"path": "/etc/x", "kind": "card", "bytes": 1, "sha256": ""}]}',
         "is not a file of this dataset"),
        ('{"format": 1, "files": [{"path": "recordings/s/t.h5", "kind": "artefact", "bytes": 1, '
         '"sha256": ""}]}', "is not a file of this dataset"),
    ],
)  # fmt: skip
def test_broken_manifests_are_refused(tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "release.json").write_text(text)
    with pytest.raises(UserError, match=message):
        manifest.check(tmp_path)


def test_a_missing_folder_is_reported(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        manifest.write(tmp_path / "none", {})
