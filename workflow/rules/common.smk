import functools
import re
from pathlib import Path

from snakemake.exceptions import WorkflowError

from intercap_core.formats.recordings.layouts import input_files
from intercap_core.errors import UserError
from intercap_core.formats.released import files_of
from intercap_core.pipeline.plan import DATASET, STUDIO, Plan
from intercap_core.pipeline.resources import (
    extent_of,
    has_model,
    memory_mb,
    minutes,
    on_gpu,
    recorded_mb,
)
from intercap_core.project import load_project
from intercap_core.stage_list import SEQUENCE_STAGES, STAGES, Extent


def _load():
    """Load and validate settings and tables before any job starts."""
    given = workflow.config_settings.configfiles
    path = given[0] if given else Path("config/config.yaml")
    overrides = {key: value for key, value in config.items() if key != "project"}
    config["project"] = {"path": str(path), "overrides": overrides}
    try:
        return load_project(path, overrides)
    except UserError as error:
        raise WorkflowError(str(error)) from None


PROJECT = _load()
SETTINGS = PROJECT.config
SEQUENCES = list(PROJECT.sequences)
PLAN = Plan(PROJECT)
if workflow.is_main_process:
    try:
        PLAN.mark_all()
    except (UserError, OSError) as error:
        raise WorkflowError(str(error)) from None
VIRTUAL = [name for name in SEQUENCES if PROJECT.recordings_made(name) is not None]
NOTHING = "(?!)"  # pattern without a match
RESULTS = PROJECT.results.as_posix()
LOGS = PROJECT.logs.as_posix()
BENCHMARKS = f"benchmarks/{SETTINGS.dataset}"
ENVIRONMENT = "../../envs/intercap.yaml"


wildcard_constraints:
    sequence="|".join(map(re.escape, SEQUENCES)),


def existing(*paths):
    """Existing paths among ``paths``; the job that reads a missing file then reports it."""
    return [path for path in paths if path is not None and Path(path).exists()]


def of_sequence(wildcards):
    """The sequence's row, its object (None for a person without an object) and its subject."""
    row = PROJECT.sequences[wildcards.sequence]
    return row, PROJECT.object_of(wildcards.sequence), PROJECT.subjects[row.subject]


def made_by_studio(wildcards, name):
    """Output of the rule studio that represents a column's files; None for a real recording."""
    if PROJECT.recordings_made(wildcards.sequence) is None:
        return None
    output = "truth" if name == "truth" else "manifest"
    return expand(getattr(rules.studio.output, output), sequence=wildcards.sequence)


def recorded(column):
    """Input function: files of the sequence's row in ``column``, or the studio's output.

    Their dates are ignored, except those of a recording that the studio makes again.
    """

    def files(wildcards):
        made = made_by_studio(wildcards, column)
        if made is not None:
            is_stale = PLAN.is_stale(wildcards.sequence, STUDIO)
            return made if is_stale else ancient(made)
        row = PROJECT.sequences[wildcards.sequence]
        if column == "recordings":
            return ancient(input_files(row))
        return ancient(existing(getattr(row, column)))

    return files


def annotation_broken(sequence):
    """Whether the sequence's annotation is invalid; one that the studio writes is not checked."""
    return bool(PLAN.annotation_fault(sequence)) and not PROJECT.annotation_made(
        sequence
    )


def annotation_input(wildcards):
    """Input function: for an invalid annotation, the output of a job that fails with the reason.

    The sequence's existing outputs stay. Changes of a valid annotation are found by the manifests.
    """
    if not annotation_broken(wildcards.sequence):
        return []
    return [rules.broken_annotation.output.checked.format(sequence=wildcards.sequence)]


def out_of_date(stage):
    """Input function: for a stale output, a mark that is newer than the output.

    Only this mark makes Snakemake run a job again; without it, all inputs are ``ancient``. See
    docs/reruns.md.
    """
    return lambda wildcards: PLAN.mark(getattr(wildcards, "sequence", ""), stage)


def identity_of(stage):
    """Param: fingerprint that the output will get, shown in Snakemake's reports."""
    return lambda wildcards: PLAN.fingerprint(getattr(wildcards, "sequence", ""), stage)


def artefacts_read(stage):
    """Input function: the artefacts that a stage reads, by stage.

    Their dates count only if the stage's output is stale. If it is not, an artefact that is made
    again gets the same content, and the output stays up to date.
    """

    def files(wildcards):
        paths = {
            name: f"{RESULTS}/{wildcards.sequence}/{name}.h5"
            for name in STAGES[stage].reads
        }
        if PLAN.is_stale(wildcards.sequence, stage):
            return paths
        return {name: ancient(path) for name, path in paths.items()}

    return files


def summaries(wildcards):
    """Input function: the summaries of all sequences; dates count as in ``artefacts_read``."""
    paths = expand(f"{RESULTS}/{{sequence}}/summary.h5", sequence=SEQUENCES)
    return paths if PLAN.is_stale("", DATASET) else ancient(paths)


def object_files(wildcards):
    """Input function: the object's mesh and contact vertices."""
    _, tracked, _ = of_sequence(wildcards)
    return [] if tracked is None else existing(tracked.mesh, tracked.contact_vertices)


def body_file(wildcards):
    """Input function: the licensed body file of the subject's gender, if one is set."""
    _, _, subject = of_sequence(wildcards)
    return existing(SETTINGS.body_models.of(subject.gender))


def pose_prior_file(wildcards):
    """Input function: the pose prior's weights, if the settings name them."""
    return existing(SETTINGS.body_models.vposer)


def keypoint_definition_file(wildcards):
    """Input function: the table of the detector's joint positions, if the settings name one."""
    return existing(SETTINGS.body_fit.keypoint_definition)


def motion_prior_files(wildcards):
    """Input function: the motion prior's weights and statistics, if the settings name them."""
    return existing(*(SETTINGS.joint.lemo_files or ()))


def results_file(wildcards):
    """Input function: files of another program's results, if the sequence's row names them."""
    named = PROJECT.sequences[wildcards.sequence].results
    return [] if named is None else existing(*files_of(named))


def length_of(wildcards):
    """Extent of the sequence, from its frames artefact, the studio's settings, or a default."""
    if not hasattr(wildcards, "sequence"):
        return Extent(0, 0)
    frames = PROJECT.artefact(wildcards.sequence, "frames")
    changed = frames.stat().st_mtime_ns if frames.exists() else None
    return length_since(wildcards.sequence, changed)


@functools.cache
def length_since(sequence, changed):
    """Extent of a sequence whose frames artefact has the date ``changed``."""
    return extent_of(PROJECT, sequence)


def memory(stage):
    """Resource: megabytes by frames and cameras, growing with each attempt."""

    def megabytes(wildcards, attempt):
        return memory_mb(PROJECT, stage, length_of(wildcards), attempt)

    return megabytes


def duration(stage):
    """Resource: minutes by frames and cameras, and by file size for the stage frames."""

    def asked(wildcards, attempt):
        read = 0.0
        if stage == "frames":
            read = recorded_mb(PROJECT.sequences[wildcards.sequence].recordings)
        return minutes(PROJECT, stage, length_of(wildcards), attempt, read_mb=read)

    return asked


def gpu_of(stage):
    """Resources: a GPU and its partition, if the settings run the stage on a GPU."""
    if not on_gpu(PROJECT, stage):
        return {}
    partition = SETTINGS.cluster.gpu_partition
    return {"gpu": 1, **({"slurm_partition": partition} if partition else {})}
