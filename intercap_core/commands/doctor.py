"""`intercap doctor`: check software, devices, disk space and locks of this machine."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from intercap_core.commands.console import ListTable, standard_console
from intercap_core.errors import UserError
from intercap_core.pipeline.lease import lease_holder
from intercap_core.pipeline.provenance import library_versions, processor
from intercap_core.pipeline.resources import disk_usage, on_gpu
from intercap_core.project import Project
from intercap_core.versions import versions

GOOD, NOTE, BAD = "ok", "note", "problem"
_COLOURS = {GOOD: "green", NOTE: "yellow", BAD: "red"}
# File systems that several machines share.
_SHARED = ("nfs", "nfs4", "lustre", "gpfs", "beegfs", "ceph", "cifs", "smb3", "fuse.glusterfs")


Finding = tuple[str, str, str]
"""What was checked; ``GOOD``, ``NOTE`` or ``BAD``; what was found."""


def findings(project: Project | None) -> Iterator[Finding]:
    """Check the machine; with a ``project`` also its body files, disk and locks."""
    for name, version in versions():
        yield name, GOOD, version
    deciding = ", ".join(f"{name} {version}" for name, version in library_versions().items())
    yield "numerical libraries", GOOD, f"{deciding}; {processor()}, {os.cpu_count()} cores"
    yield _gpu(project)
    if project is not None:
        yield _bodies(project)
        yield from _disk(project)
        yield _file_system(project.results)
        yield _locks(project)
    yield _scheduler()
    yield _browser()


def print_findings(project: Project | None) -> bool:
    """Print all findings as a table; True if none is a problem."""
    table = ListTable(show_header=False)
    good = True
    for what, state, text in findings(project):
        table.add_row(what, f"[{_COLOURS[state]}]{state}[/{_COLOURS[state]}]", text)
        good &= state != BAD
    standard_console().print(table)
    return good


def _gpu(project: Project | None) -> Finding:
    """GPU for the models of the detectors; no other stage uses one."""
    wanted = project is not None and on_gpu(project, "detections")
    try:
        import onnxruntime

        found = "CUDAExecutionProvider" in onnxruntime.get_available_providers()
    except ImportError:
        found = False
    if found:
        words = "" if wanted or project is None else "; the settings run detectors on the CPU"
        return "GPU", GOOD, f"onnxruntime has CUDA{words}"
    if wanted:
        return "GPU", BAD, "the settings run detectors on a GPU, but onnxruntime finds no CUDA"
    return "GPU", GOOD, "none found, none needed"


def _bodies(project: Project) -> Finding:
    from intercap_core.commands.check import check_bodies

    try:
        check_bodies(project)
    except UserError as error:
        return "body files", BAD, str(error)
    named = [path.name for _, path in project.config.body_models if isinstance(path, Path)]
    return "body files", GOOD, ", ".join(named) or "the open body"


def _disk(project: Project) -> Iterator[Finding]:
    """Disk space of the results and of the missing sequences, and what may be deleted."""
    usage = disk_usage(project)
    words = (
        f"the results have {usage.present / 1e9:.1f} GB, {usage.missing / 1e9:.1f} GB more are "
        f"expected{usage.basis}, {usage.free / 1e9:.1f} GB are free"
    )
    enough = usage.free >= 1.2 * usage.missing  # margin of the estimate
    yield "disk", GOOD if enough else BAD, words
    share = 100 * usage.per_output["frames"] / max(sum(usage.per_output.values()), 1)
    yield (
        "disk", NOTE,
        f"frames.h5 ({share:.0f} % of a sequence) can be deleted when a dataset is done; a later "
        "run writes it again",
    )  # fmt: skip


def _file_system(results: Path) -> Finding:
    """Whether the results lie on a file system that other machines can share."""
    place = next(path for path in (results, *results.resolve().parents) if path.exists()).resolve()
    kind, at = "unknown", ""
    try:
        with open("/proc/mounts", encoding="utf-8") as file:
            for line in file:
                _, mount, mounted, *_ = line.split()
                if place.is_relative_to(mount) and len(mount) >= len(at):
                    kind, at = mounted, mount
    except OSError:
        pass
    shared = kind in _SHARED
    words = f"{place} is on {kind}"
    if not shared:
        words += ", which other machines may not see; a cluster needs a shared file system"
    return "file system", GOOD if shared else NOTE, words


def _locks(project: Project) -> Finding:
    owner = lease_holder(project.results / "run")
    if owner is not None:
        return "locks", NOTE, f"a run is active: {owner}"
    if any((project.root / ".snakemake/locks").glob("*")):
        return (
            "locks", NOTE,
            "there is a lock of Snakemake; `intercap run` removes it if its own run was killed; "
            "otherwise run `intercap run SETTINGS -- --unlock` when no run is active",
        )  # fmt: skip
    return "locks", GOOD, "none"


def _scheduler() -> Finding:
    slurm = shutil.which("sbatch")
    if slurm is None:
        return "scheduler", GOOD, "no Slurm; runs use this machine's cores"
    try:
        import snakemake_executor_plugin_slurm as plugin
    except ImportError:
        return (
            "scheduler", NOTE,
            f"{slurm}, but Snakemake's plugin for it is not installed: pip install "
            "'intercap-core[workflow]'",
        )  # fmt: skip
    return "scheduler", GOOD, f"{slurm}, with {plugin.__name__}; see docs/cluster.md"


def _browser() -> Finding:
    import webbrowser

    programs = ("chromium", "google-chrome", "firefox")
    try:
        program = next(filter(None, map(shutil.which, programs)), None) or webbrowser.get().name
    except webbrowser.Error:
        return "browser", NOTE, "none; copy the site's folder to a machine with a browser"
    return "browser", GOOD, str(program)
