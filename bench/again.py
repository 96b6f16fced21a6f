"""Recompute stages with other inputs or settings, from the artefacts of a run."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.pipeline.code_digest import code_digest
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project
from intercap_core.stage_list import SEQUENCE_STAGES, STAGES


def slug(variant: str) -> str:
    """A variant's name in keys and folders."""
    return variant.replace(" ", "_")


def variants_parser(
    description: str | None, variants: Collection[str], name: str
) -> argparse.ArgumentParser:
    """Command line of a script that computes ``variants`` of the stages of a run.

    Args:
        description: the script's documentation.
        name: figures are written to ``results/<name>.json``, artefacts below ``results/<name>``.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    quick = Path("config/evaluation/quick.yaml")
    parser.add_argument("settings", type=Path, nargs="?", default=quick)
    parser.add_argument(
        "--sequences", nargs="+", default=(), metavar="NAME", help="default: all of SETTINGS"
    )
    parser.add_argument(
        "--variants", nargs="+", default=tuple(variants), metavar="NAME",
        help=f"default: all, {', '.join(variants)}",
    )  # fmt: skip
    parser.add_argument("--output", type=Path, default=Path(f"results/{name}.json"))
    parser.add_argument("--folder", type=Path, default=Path(f"results/{name}"))
    return parser


def check_run(
    project: Project,
    sequences: Sequence[str],
    stages: Collection[str],
    variants: Sequence[str] = (),
    known: Collection[str] = (),
) -> None:
    """Raise UserError if a sequence is unknown, has no truth, or lacks a required artefact.

    Required are the artefacts that ``stages`` read and that none of them writes. Each of
    ``variants`` must be ``known``.
    """
    strange = [name for name in variants if name not in known]
    if strange:
        raise UserError(f"there is no variant {strange[0]!r}; known are {', '.join(known)}")
    settings = project.path
    unknown = [name for name in sequences if name not in project.sequences]
    if unknown:
        known = ", ".join(project.sequences)
        raise UserError(f"{settings}: there is no sequence {unknown[0]!r}; it lists {known}")
    needed = {name for stage in stages for name in STAGES[stage].reads} - set(stages)
    for name in sequences:
        truth = project.sequences[name].truth
        if truth is None:
            raise UserError(f"{settings}: sequence {name!r} has no truth to be held to")
        for path in [truth, *(project.artefact(name, stage) for stage in sorted(needed))]:
            if not path.is_file():
                raise UserError(
                    f"{path}: not there, expected what a run of {settings} leaves; take {name} to "
                    f"its metrics first: intercap run {settings} (or make evaluate-quick)"
                )


def artefacts_of(project: Project, sequence: str) -> dict[str, Path]:
    """Paths of the sequence's artefacts by stage."""
    return {stage: project.artefact(sequence, stage) for stage in SEQUENCE_STAGES}


def compute_once(
    stage: str, project: Project, sequence: str, paths: Mapping[str, Path], output: Path
) -> Path:
    """Compute ``output`` from the artefacts ``paths`` unless it is up to date by content."""
    key, content = output.with_suffix(".key"), _content((stage,), project, sequence, paths)
    if not (output.exists() and key.exists() and key.read_text() == content):
        key.unlink(missing_ok=True)  # an interrupted run must not leave an old key
        run_step(stage, project, sequence, inputs=paths, output=output)
        key.write_text(content)
    return output


def content_of(stages: Sequence[str], project: Project, sequence: str) -> str:
    """Checksum of all inputs of stages that are replayed in order from a run's artefacts."""
    return _content(stages, project, sequence, artefacts_of(project, sequence), with_truth=True)


def _content(
    stages: Sequence[str],
    project: Project,
    sequence: str,
    paths: Mapping[str, Path],
    *,
    with_truth: bool = False,
) -> str:
    state = hashlib.sha256()
    for stage in stages:
        state.update(code_digest(f"stages.{stage}").encode())
    state.update(project.config.model_dump_json(exclude={"studio", "report", "export"}).encode())
    state.update(repr(project.annotation(sequence)).encode())
    row = project.sequences[sequence]
    entry = project.objects[row.object]
    for described in (entry, project.subjects[row.subject]):
        state.update(described.model_dump_json().encode())
    reads = dict.fromkeys(name for stage in stages for name in STAGES[stage].reads)
    files = [paths[name] for name in reads if name not in stages]
    models, gender = project.config.body_models, project.subjects[row.subject].gender
    files += [entry.mesh, entry.contact_vertices, models.of(gender), models.vposer]
    files += project.config.joint.lemo_files or ()
    if with_truth or "metrics" in stages:
        files.append(row.truth)
    for path in files:
        if path is not None:
            state.update(_file_digest(path, path.stat().st_mtime_ns))
    return state.hexdigest()


@cache
def _file_digest(path: Path, changed_ns: int) -> bytes:
    """SHA-256 of a file, cached in the process until the file changes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()
