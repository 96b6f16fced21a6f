"""A copy of the project in its own folder, run by the real Snakemake."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
from numba.core.caching import _CacheLocator

from intercap_core.kernel_cache import use_kernel_cache
from intercap_core.stage_list import SEQUENCE_STAGES

ROOT = Path(__file__).resolve().parents[2]
EXECUTOR = "snakemake_executor_plugin_intercap_slurm"
COPIED = ("workflow", "config", "intercap_core", EXECUTOR)
KERNELS = shutil.ignore_patterns("*.nbi", "*.nbc")  # of a cache next to the source
ONE, OTHER = "suitcase_carry_s03", "cup_drink_s04"
# Appended to a stage of a copy, which then returns the result of a finished run. Its imports
# and signature stay, so that its code digest and arguments are the real ones. The text is the same
# in all copies, so that the digests of the code are computed once.
REPLAY = """

def _replayed(real):
    import functools, importlib, json, shutil, time
    from pathlib import Path

    @functools.wraps(real)
    def run(*, output, **given):
        artefacts = importlib.import_module("intercap_core.artefacts")
        schemas = importlib.import_module("intercap_core.schemas")
        read = given["paths"].by_stage() if "paths" in given else given
        for name, path in read.items():
            if isinstance(path, Path) and hasattr(schemas, name.upper()):
                with artefacts.read(path, getattr(schemas, name.upper())) as source:
                    for key in source.keys():
                        source[key]
        settings = json.loads(Path("replay.json").read_text())
        time.sleep(settings["pause_s"])
        place = output.parent.resolve().relative_to(Path("results/test").resolve())
        folder = Path(settings["results"]) / place
        made = next(p for p in folder.iterdir() if output.name.startswith("." + p.name + "."))
        (shutil.copytree if made.is_dir() else shutil.copy)(made, output)

    return run


run = _replayed(run)
"""
REPLAYED = (
    "detections", "scene", "person", "object_track", "body_fit", "joint", "metrics", "summary",
    "page", "export",
)  # fmt: skip


def share_kernels(package: Path, cache: Path) -> None:
    """Let a copy of the package at ``package`` use the project's compiled kernels in ``cache``.

    Numba identifies sources by path, so each folder of the copy gets a link to the project's
    kernels of that folder. The copy may have been edited, except for what a kernel computes.
    """
    own = use_kernel_cache()
    assert own is not None
    found = subprocess.run(
        [sys.executable, "-c", f"import {package.name}, os; print(os.environ['NUMBA_CACHE_DIR'])"],
        cwd=package.parent, env={**os.environ, "NUMBA_CACHE_DIR": str(cache)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    shared = Path(found.stdout.strip())
    for module in (ROOT / "intercap_core").rglob("*.py"):
        copied = package / module.relative_to(ROOT / "intercap_core")
        link = shared / _CacheLocator.get_suitable_cache_subpath(str(copied))
        if not link.is_symlink():
            target = own / _CacheLocator.get_suitable_cache_subpath(str(module))
            target.mkdir(exist_ok=True)
            link.symlink_to(target)


@dataclass(frozen=True)
class Flow:
    """A copy of the project."""

    folder: Path
    """Root of the copy."""
    settings: str
    """Settings file that is run, relative to the root."""

    @classmethod
    def copy(
        cls,
        folder: Path,
        settings: str = "config/test/config.yaml",
        *,
        replay: Path | None = None,
        pause_s: float = 0.0,
    ) -> Flow:
        """Copy what a run needs; compiled kernels are shared with the project.

        Args:
            replay: results of a finished run. Every stage but ``frames`` reads its inputs and
                copies its output from there, instead of computing it.
            pause_s: seconds that a replayed stage waits before it writes.

        Leases of a copy that replays expire after a quarter of the usual time.
        """
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, folder / name, ignore=KERNELS)
            else:
                shutil.copy2(source, folder / name)
        if replay is not None:
            settings_of_replay = {"results": str(replay), "pause_s": pause_s}
            (folder / "replay.json").write_text(json.dumps(settings_of_replay))
            for stage in REPLAYED:
                with (folder / "intercap_core" / "stages" / f"{stage}.py").open("a") as module:
                    module.write(REPLAY)
            lease = folder / "intercap_core" / "pipeline" / "lease.py"
            usual = lease.read_text()
            short = usual.replace("BEAT_S = 5.0", "BEAT_S = 1.0").replace(
                "EXPIRES_S = 30.0", "EXPIRES_S = 7.5"
            )
            assert short != usual
            lease.write_text(short)
        share_kernels(folder / "intercap_core", folder / "kernels")
        return cls(folder, settings)

    @property
    def environment(self) -> dict[str, str]:
        """Environment in which the copy's own package runs; its modules are compiled once."""
        return {
            **os.environ,
            "PYTHONPATH": str(self.folder),
            "NUMBA_CACHE_DIR": str(self.folder / "kernels"),
            "PYTHONDONTWRITEBYTECODE": "",
        }

    @property
    def results(self) -> Path:
        return self.folder / "results" / "test"

    def artefact(self, sequence: str, stage: str) -> Path:
        return self.results / sequence / f"{stage}.h5"

    def annotation(self, sequence: str) -> Path:
        return self.folder / Path(self.settings).parent / "annotations" / f"{sequence}.yaml"

    def ask(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """As `run`, by a process in which Snakemake has started: see `warm_snakemake`."""
        given = ["--configfile", self.settings, "--cores", "2", *arguments]
        output, errors = (self.folder / f"asked.{name}" for name in ("out", "err"))
        server = _server(self)
        assert server.stdin is not None and server.stdout is not None
        server.stdin.write(json.dumps([given, str(output), str(errors)]) + "\n")
        server.stdin.flush()
        status = int(server.stdout.readline())
        return subprocess.CompletedProcess(given, status, output.read_text(), errors.read_text())

    def run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run Snakemake in the folder, with the copy's own package."""
        command = [
            *(sys.executable, "-m", "snakemake", "--configfile", self.settings),
            *("--cores", "2", *arguments),
        ]
        return subprocess.run(
            command, cwd=self.folder, env=self.environment, capture_output=True, text=True
        )

    @property
    def transcript(self) -> Path:
        """File for the output of `intercap run`."""
        return self.folder / "transcript.txt"

    def intercap(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run the command line in the folder, with the copy's own package."""
        return subprocess.run(
            [sys.executable, "-m", "intercap_core.cli", *arguments],
            cwd=self.folder,
            env={**self.environment, "COLUMNS": "400"},
            capture_output=True,
            text=True,
        )

    def duplicate(self, sequence: str, copy: str) -> None:
        """Give a second sequence the recordings and results of a finished one.

        The manifests are rewritten, so that all of its outputs are up to date.
        """
        for folder in (self.results / "recordings", self.results, self.results / "site/sequences"):
            shutil.copytree(folder / sequence, folder / copy, ignore=shutil.ignore_patterns(".*"))
        for path in (self.results / copy).glob("*.h5"):
            with h5py.File(path, "r+") as file:
                file.attrs["sequence"] = copy
        page = self.results / "site" / "sequences" / copy / "index.html"
        page.write_text(page.read_text().replace(sequence, copy))
        self.rewrite_manifests()

    def rewrite_manifests(self) -> None:
        """Make all existing outputs up to date."""
        subprocess.run(
            [sys.executable, str(ROOT / "tests" / "helpers" / "manifests.py"), self.settings],
            cwd=self.folder, env=self.environment, check=True,
        )  # fmt: skip

    def pending(self, *, new_process: bool = False) -> set[tuple[str, str]]:
        """(sequence, stage) of every output that a run would make; sequence "" for the dataset's.

        Args:
            new_process: start Snakemake, as a user does, instead of using the running one.
        """
        done = self.run("--summary") if new_process else self.ask("--summary")
        assert done.returncode == 0, done.stderr
        header, *rows = [line.split("\t") for line in done.stdout.splitlines() if "\t" in line]
        entries = [dict(zip(header, row, strict=True)) for row in rows]
        pending = set()
        for entry in entries:
            if entry["plan"] != "no update":
                path = Path(entry["output_file"])
                sequence = next((name for name in (ONE, OTHER) if name in path.parts), "")
                is_artefact = path.suffix == ".h5" and path.stem in SEQUENCE_STAGES
                stage = path.stem if is_artefact else entry["rule"]
                pending.add((sequence, stage))
        return pending


@functools.cache
def _server(flow: Flow) -> subprocess.Popen[str]:
    """Snakemake process of this folder; it ends with this process, when its input closes."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / "tests" / "helpers" / "warm_snakemake.py")],
        cwd=flow.folder,
        env=flow.environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


@contextmanager
def edited(path: Path, text: str | None) -> Iterator[None]:
    """Write ``text``, or delete the file, within the block; afterwards restore the file."""
    aside = path.with_name("aside")
    existed = path.exists()
    if existed:
        path.rename(aside)
    path.parent.mkdir(exist_ok=True)
    if text is not None:
        path.write_text(text)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        if existed:
            aside.rename(path)
