"""A copy of the project in a folder of its own, run by the real Snakemake."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from numba.core.caching import _CacheLocator

from intercap_core.kernel_cache import use_kernel_cache

ROOT = Path(__file__).resolve().parents[2]
EXECUTOR = "snakemake_executor_plugin_intercap_slurm"
COPIED = ("Snakefile", "workflow", "profiles", "envs", "config", "intercap_core", EXECUTOR)
KERNELS = shutil.ignore_patterns("*.nbi", "*.nbc")  # of a cache beside the source
AS_IF_MADE_NOW = """
import sys
from dataclasses import replace
from pathlib import Path
from intercap_core.pipeline.checksums import INPUTS_FILE, InputChecksums
from intercap_core.pipeline.plan import DATASET, Plan
from intercap_core.pipeline.provenance import read_manifest, write_manifest
from intercap_core.pipeline.stage_inputs import dataset_manifest, stage_manifest
from intercap_core.project import load_project
from intercap_core.stage_list import STAGES
project = load_project(Path(sys.argv[1]))
made = {}
for name in project.sequences:
    checksums, identities = InputChecksums(project.results / name / INPUTS_FILE), {}
    annotation = project.annotation(name)
    for stage, declared in STAGES.items():
        reads = {other: identities[other] for other in declared.reads}
        record = stage_manifest(
            project, name, stage, annotation, artefacts=reads, checksums=checksums
        )
        identities[stage] = record.fingerprint
        if read_manifest(project.artefact(name, stage)) != record:
            write_manifest(project.artefact(name, stage), record)
    made[name] = identities["summary"]
write_manifest(project.results, dataset_manifest(project, made, {}))
"""
ONE, OTHER = "suitcase_carry_s03", "cup_drink_s04"
# Appended to a stage of a copy: the stage's imports and signature stay, so that its code digest and
# its arguments are the real ones, and its result is that of a finished run.
REPLAY = """

def _replayed(real):
    import functools, importlib, shutil, time
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
        time.sleep({pause_s})
        place = output.parent.resolve().relative_to(Path("results/test").resolve())
        folder = Path({results!r}) / place
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
    """Let a copy of the package at ``package`` keep its kernels in ``cache``, beside the project's.

    Numba tells sources apart by their path. So for each folder of the copy there is a link to
    where the project's own kernels of that folder lie; an edited copy has a cache of its own.
    """
    own = use_kernel_cache()
    assert own is not None
    shared = cache / own.name
    shared.mkdir(parents=True)
    for module in (ROOT / "intercap_core").rglob("*.py"):
        copied = package / module.relative_to(ROOT / "intercap_core")
        link = shared / _CacheLocator.get_suitable_cache_subpath(str(copied))
        if not link.is_symlink():
            target = own / _CacheLocator.get_suitable_cache_subpath(str(module))
            target.mkdir(exist_ok=True)
            link.symlink_to(target)


@dataclass(frozen=True)
class Flow:
    """The copy's folder and which settings are run."""

    folder: Path
    settings: str

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
        """
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, folder / name, ignore=KERNELS)
            else:
                shutil.copy2(source, folder / name)
        if replay is not None:
            text = REPLAY.format(results=str(replay), pause_s=pause_s)
            for stage in REPLAYED:
                with (folder / "intercap_core" / "stages" / f"{stage}.py").open("a") as module:
                    module.write(text)
        share_kernels(folder / "intercap_core", folder / "kernels")
        return cls(folder, settings)

    @property
    def environment(self) -> dict[str, str]:
        """What the folder's own package is run with."""
        kernels = str(self.folder / "kernels")
        return {**os.environ, "PYTHONPATH": str(self.folder), "NUMBA_CACHE_DIR": kernels}

    @property
    def results(self) -> Path:
        return self.folder / "results" / "test"

    def artefact(self, sequence: str, stage: str) -> Path:
        return self.results / sequence / f"{stage}.h5"

    def annotation(self, sequence: str) -> Path:
        return self.folder / Path(self.settings).parent / "annotations" / f"{sequence}.yaml"

    def ask(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """What `run` does, by a process that has started already: see `warm_snakemake`."""
        given = ["--configfile", self.settings, "--cores", "2", *arguments]
        output, errors = (self.folder / f"asked.{name}" for name in ("out", "err"))
        server = _server(self)
        assert server.stdin is not None and server.stdout is not None
        server.stdin.write(json.dumps([given, str(output), str(errors)]) + "\n")
        server.stdin.flush()
        status = int(server.stdout.readline())
        return subprocess.CompletedProcess(given, status, output.read_text(), errors.read_text())

    def run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run Snakemake in the folder, with the folder's own package."""
        command = [
            *(sys.executable, "-m", "snakemake", "--configfile", self.settings),
            *("--cores", "2", *arguments),
        ]
        return subprocess.run(
            command,
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
        )

    @property
    def transcript(self) -> Path:
        """What `intercap run` said when the fixture ran it."""
        return self.folder / "transcript.txt"

    def intercap(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run the command line in the folder, with the folder's own package."""
        return subprocess.run(
            [sys.executable, "-m", "intercap_core.cli", *arguments],
            cwd=self.folder,
            env={**self.environment, "COLUMNS": "400"},
            capture_output=True,
            text=True,
        )

    def as_if_made_now(self) -> None:
        """Rewrite every output's record to what the output would be made from now."""
        subprocess.run(
            [sys.executable, "-c", AS_IF_MADE_NOW, self.settings],
            cwd=self.folder, env=self.environment, check=True,
        )  # fmt: skip

    def pending(self, *, anew: bool = False) -> set[tuple[str, str]]:
        """(sequence, rule) of every job that a run would start now; "" for the whole dataset.

        ``anew`` starts Snakemake for it, as a user does.
        """
        done = self.run("--summary") if anew else self.ask("--summary")
        assert done.returncode == 0, done.stderr
        header, *rows = [line.split("\t") for line in done.stdout.splitlines() if "\t" in line]
        entries = [dict(zip(header, row, strict=True)) for row in rows]
        pending = set()
        for entry in entries:
            if entry["plan"] != "no update":
                parts = Path(entry["output_file"]).parts
                sequence = next((name for name in (ONE, OTHER) if name in parts), "")
                pending.add((sequence, entry["rule"]))
        return pending


@functools.cache
def _server(flow: Flow) -> subprocess.Popen[str]:
    """The process that answers for this folder; it ends with this one, when its input closes."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / "tests" / "helpers" / "warm_snakemake.py")],
        cwd=flow.folder,
        env=flow.environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
