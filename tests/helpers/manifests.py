"""Give every output of a project the manifest of what it would be made from now.

Flow runs this file as a script, with the package of its copy.
"""

from __future__ import annotations

import sys
from pathlib import Path

from intercap_core.pipeline.checksums import INPUTS_FILE, InputChecksums
from intercap_core.pipeline.provenance import read_manifest, write_manifest
from intercap_core.pipeline.stage_inputs import (
    DATASET_READS,
    dataset_manifest,
    stage_manifest,
    studio_manifest,
)
from intercap_core.project import Project, load_project
from intercap_core.stage_list import STAGES


def rewrite_manifests(project: Project) -> None:
    """Make all existing outputs up to date."""
    read: dict[str, dict[str, str]] = {stage: {} for stage in DATASET_READS}
    made: dict[tuple[str, str], str] = {}  # fingerprint by sequence and stage
    for name in sorted(project.sequences, key=lambda name: _reuses(project, name)):
        checksums = InputChecksums(project.results / name / INPUTS_FILE)
        fingerprints: dict[str, str] = {}
        recordings = project.recordings_made(name)
        if recordings is not None:
            write_manifest(recordings, studio_manifest(project, name, checksums))
        annotation = project.annotation(name)
        for stage, declared in STAGES.items():
            reads = {other: fingerprints[other] for other in declared.reads}
            reused = project.reused_sequence(name, stage)
            if reused is not None:
                reads[f"{stage} of {reused}"] = made[reused, stage]
            manifest = stage_manifest(
                project, name, stage, annotation, artefacts=reads, checksums=checksums
            )
            fingerprints[stage] = made[name, stage] = manifest.fingerprint
            output = project.artefact(name, stage)
            if output.exists() and read_manifest(output) != manifest:
                write_manifest(output, manifest)
        for stage, of in read.items():
            of[name] = fingerprints[stage]
    write_manifest(project.results, dataset_manifest(project, read, {}))


def _reuses(project: Project, sequence: str) -> bool:
    """Whether the sequence opens artefacts of another one, which must come first."""
    return any(project.reused_sequence(sequence, stage) is not None for stage in STAGES)


if __name__ == "__main__":
    rewrite_manifests(load_project(Path(sys.argv[1])))
