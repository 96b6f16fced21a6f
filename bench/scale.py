"""Times of a dataset of 223 sequences: a run with nothing to do, a check, the jobs of an edit.

A computed recording (`config/test`) is repeated under other names: recordings are links to the same
files, artefacts are copies with their own records. Seconds are CPU seconds of a process and its
children.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import yaml

from bench.command import from_command_line, report_figures
from intercap_core.errors import UserError
from intercap_core.pipeline.checksums import INPUTS_FILE, InputChecksums, remember_output
from intercap_core.pipeline.provenance import write_manifest
from intercap_core.pipeline.stage_inputs import stage_manifest
from intercap_core.pipeline.step import run_dataset
from intercap_core.project import Project, load_project
from intercap_core.stage_list import SEQUENCE_STAGES, STAGES

SEQUENCES = 223
CONTACT = "contact:\n- {part: right_hand, start: 0, end: 1}\n"
JOBS = re.compile(r"^total\s+(\d+)", re.MULTILINE)


def measure(settings: Path, output: Path, count: int) -> None:
    """Print ``scale.*`` and add them to the JSON ``output``.

    Raises UserError if no sequence of the project is completely computed.
    """
    source = load_project(settings)
    computed = [n for n in source.sequences if source.artefact(n, "summary").is_file()]
    if not computed:
        raise UserError(f"{source.results}: no sequence is computed; run it first (intercap run)")
    with tempfile.TemporaryDirectory(dir=source.results.parent) as folder:
        here = Path(folder).resolve()
        project = _repeated(source, computed[0], here, count)
        first = _cpu_seconds(here, "run")
        figures = {
            "first_start_s": first,  # which reads every record once
            "nothing_to_do_s": _cpu_seconds(here, "run"),
            "check_s": _cpu_seconds(here, "check"),
        }
        annotation = here / project.annotation_path(next(iter(project.sequences)))
        annotation.parent.mkdir()
        annotation.write_text(CONTACT, encoding="utf-8")
        figures["edit_jobs"] = _jobs(here) - 1  # the final target left out
        annotation.unlink()
        shutil.rmtree(here / project.results)
        figures["dry_all_s"] = _cpu_seconds(here, "run", "--", "-n", "--quiet")
    report_figures(output, "scale", figures)


def _repeated(source: Project, name: str, here: Path, count: int) -> Project:
    """A project in the folder ``here`` whose sequences are copies of one sequence."""
    row, recordings = source.sequences[name], source.sequences[name].recordings.resolve()
    names = [f"seq_{number:03d}" for number in range(count)]
    rows = ["\t".join(("sequence", "subject", "object", "layout", "recordings", "calibration",
                       "keypoints", "candidates"))]  # fmt: skip
    for other in names:
        folder = here / "recordings" / other
        shutil.copytree(
            recordings, folder, copy_function=os.link, ignore=shutil.ignore_patterns("truth.h5")
        )
        paths = [folder / path.resolve().relative_to(recordings)
                 for path in (row.calibration, row.keypoints, row.candidates) if path]  # fmt: skip
        known = (other, row.subject, row.object or "", row.layout)
        rows.append("\t".join((*known, *map(str, [folder, *paths]))))
    (here / "sequences.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    shutil.copy(source.path.parent / source.config.subjects, here / "subjects.tsv")
    settings = {
        **source.config.model_dump(mode="json", exclude_defaults=True, exclude={"studio"}),
        "dataset": "scale",
        "sequences": "sequences.tsv",
        "subjects": "subjects.tsv",
        "objects": str((source.path.parent / source.config.objects).resolve()),
        "results": "results",
    }
    (here / "config.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    before = Path.cwd()
    os.chdir(here)
    try:
        project = load_project(Path("config.yaml"))
        for other in names:
            _copy(source, before, name, project, other)
        first = run_dataset(project)
        assert first.is_file()
        return project
    finally:
        os.chdir(before)


def _copy(source: Project, before: Path, name: str, project: Project, other: str) -> None:
    """Copy all outputs of a sequence under another name, with records of that name."""
    checksums = InputChecksums(project.results / other / INPUTS_FILE)
    annotation = project.annotation(other)
    identities: dict[str, str] = {}
    for stage, declared in STAGES.items():
        made, path = before / source.artefact(name, stage), project.artefact(other, stage)
        path.parent.mkdir(parents=True, exist_ok=True)
        if stage in SEQUENCE_STAGES:
            shutil.copyfile(made, path)
            with h5py.File(path, "r+") as file:
                file.attrs["sequence"] = other
        else:
            shutil.copytree(made, path, copy_function=os.link)
        manifest = stage_manifest(
            project, other, stage, annotation,
            artefacts={read: identities[read] for read in declared.reads}, checksums=checksums,
        )  # fmt: skip
        identities[stage] = manifest.fingerprint
        write_manifest(path, manifest)
        if stage in SEQUENCE_STAGES:
            remember_output(path)
    checksums.save()


def _cpu_seconds(here: Path, *arguments: str) -> float:
    """CPU seconds of a command on the project, including its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    _intercap(here, *arguments)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _jobs(here: Path) -> int:
    """Number of jobs of a dry run."""
    text = _intercap(here, "run", "--", "-n")
    found = JOBS.search(text)
    if found is None:
        raise UserError(f"Snakemake named no jobs: {text.strip()[-500:]}")
    return int(found.group(1))


def _intercap(here: Path, verb: str, *arguments: str) -> str:
    """Run a command on the project; returns what it prints."""
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run(
        [sys.executable, "-m", "intercap_core.cli", verb, "config.yaml", *arguments],
        cwd=here, env={**os.environ, "PYTHONPATH": str(root)}, capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        raise UserError(f"intercap {verb} failed: {done.stderr.strip()[-500:]}")
    return done.stdout + done.stderr


if __name__ == "__main__":
    from_command_line(
        measure, (__doc__ or "").splitlines()[0], SEQUENCES, "sequences",
        settings=Path("config/test/config.yaml"),
    )  # fmt: skip
