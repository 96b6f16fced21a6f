"""`intercap doctor`: what this machine has of what a run needs, and how much disk it will take."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from intercap_core.errors import UserError
from intercap_core.pipeline.lease import lease_holder
from intercap_core.pipeline.provenance import library_versions, processor
from intercap_core.pipeline.resources import disk_usage
from intercap_core.project import Project
from intercap_core.versions import versions

GOOD, NOTE, BAD = "ok", "note", "problem"
_COLOURS = {GOOD: "green", NOTE: "yellow", BAD: "red"}
_SPARE = 1.2  # of what is expected to be needed
# File systems that several machines see.
_SHARED = ("nfs", "nfs4", "lustre", "gpfs", "beegfs", "ceph", "cifs", "smb3", "fuse.glusterfs")


@dataclass(frozen=True)
class Finding:
    """One line: ``state`` is one of the words above."""

    what: str
    state: str
    words: str


def findings(project: Project | None) -> Iterator[Finding]:
    """Everything that is looked at; of a ``project`` its device, body files, disk and locks too."""
    for name, version in versions():
        yield Finding(name, GOOD, version)
    deciding = ", ".join(f"{name} {version}" for name, version in library_versions().items())
    yield Finding("decide numbers", GOOD, f"{deciding}; {processor()}, {os.cpu_count()} cores")
    yield _gpu(project)
    if project is not None:
        yield _bodies(project)
        yield from _disk(project)
        yield _file_system(project.results)
        yield _locks(project)
    yield _scheduler()
    yield _browser()


def print_findings(project: Project | None) -> bool:
    """Print them as a table; whether there is no problem."""
    table = Table(box=None, pad_edge=False, show_header=False)
    good = True
    for one in findings(project):
        colour = _COLOURS[one.state]
        table.add_row(one.what, f"[{colour}]{one.state}[/{colour}]", one.words)
        good &= one.state != BAD
    Console().print(table)
    return good


def _gpu(project: Project | None) -> Finding:
    import torch

    wanted = project is not None and project.config.device == "cuda"
    if torch.cuda.is_available():
        name = torch.cuda.get_device_name(0)
        words = "" if wanted or project is None else "; the settings ask for the CPU (device: cpu)"
        return Finding("GPU", GOOD, f"{name}{words}")
    if wanted:
        return Finding("GPU", BAD, "the settings ask for it (device: cuda), and PyTorch finds none")
    return Finding("GPU", GOOD, "none found, none needed (device: cpu)")


def _bodies(project: Project) -> Finding:
    from intercap_core.commands.check import check_bodies

    try:
        check_bodies(project)
    except UserError as error:
        return Finding("body files", BAD, str(error))
    named = [path.name for _, path in project.config.body_models if isinstance(path, Path)]
    return Finding("body files", GOOD, ", ".join(named) or "the open body")


def _disk(project: Project) -> Iterator[Finding]:
    """What is there, what the sequences that are missing will need, and what may be dropped."""
    found = disk_usage(project)
    words = (
        f"{found.present / 1e9:.1f} GB of results are there, {found.missing / 1e9:.1f} GB more are "
        f"expected{found.basis}, {found.free / 1e9:.1f} GB are free"
    )
    yield Finding("disk", BAD if found.free < _SPARE * found.missing else GOOD, words)
    share = 100 * found.per_output["frames"] / max(sum(found.per_output.values()), 1)
    yield Finding(
        "what may go", NOTE,
        f"frames.h5 ({share:.0f} % of a sequence) when a dataset is done: the next run makes it "
        "again; nothing else is worth it",
    )  # fmt: skip


def _there(path: Path) -> Path:
    return next(one for one in (path, *path.resolve().parents) if one.exists())


def _file_system(results: Path) -> Finding:
    place = _there(results).resolve()
    kind, at = "unknown", ""
    try:
        with open("/proc/mounts", encoding="utf-8") as file:
            for line in file:
                _, mount, found, *_ = line.split()
                if place.is_relative_to(mount) and len(mount) >= len(at):
                    kind, at = found, mount
    except OSError:
        pass
    shared = kind in _SHARED
    words = f"{place} lies on {kind}"
    if not shared:
        words += ", which other machines may not see: on a cluster results must lie on a shared one"
    return Finding("file system", GOOD if shared else NOTE, words)


def _locks(project: Project) -> Finding:
    owner = lease_holder(project.results / "run")
    if owner is not None:
        return Finding("locks", NOTE, f"a run is going on: {owner}")
    if any(Path(".snakemake/locks").glob("*")):
        return Finding(
            "locks", NOTE,
            "Snakemake left a lock here; `intercap run` clears it after a run of its own that was "
            "killed, else `snakemake --unlock` does when no Snakemake works here",
        )  # fmt: skip
    return Finding("locks", GOOD, "none")


def _scheduler() -> Finding:
    slurm = shutil.which("sbatch")
    if slurm is None:
        return Finding("scheduler", GOOD, "no Slurm here; runs use this machine's cores")
    try:
        import snakemake_executor_plugin_slurm as plugin
    except ImportError:
        return Finding(
            "scheduler", NOTE,
            f"{slurm}, but Snakemake's plugin for it is not installed: pip install "
            "'intercap-core[slurm]'",
        )  # fmt: skip
    return Finding("scheduler", GOOD, f"{slurm}, with {plugin.__name__}; see docs/cluster.md")


def _browser() -> Finding:
    import webbrowser

    find: Callable[[str], str | None] = shutil.which
    program = find("chromium") or find("google-chrome") or find("firefox")
    try:
        program = program or webbrowser.get().name
    except webbrowser.Error:
        return Finding("browser", NOTE, "none here: copy the site's folder to where one is")
    return Finding("browser", GOOD, str(program))
