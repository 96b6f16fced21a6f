import atexit
import functools
import re
from pathlib import Path

from snakemake.exceptions import WorkflowError

from intercap_core.formats.recordings.layouts import input_files
from intercap_core.errors import UserError
from intercap_core.formats.released.file_names import files_of
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
    """Check all settings and tables before any job; one sentence says what is wrong."""
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
    atexit.register(PLAN.save)
VIRTUAL = [name for name in SEQUENCES if PROJECT.recordings_made(name) is not None]
NOTHING = "(?!)"  # a pattern that no text matches
RESULTS = PROJECT.results.as_posix()
LOGS = PROJECT.logs.as_posix()
BENCHMARKS = f"benchmarks/{SETTINGS.dataset}"
ENVIRONMENT = "../../envs/intercap.yaml"


wildcard_constraints:
    sequence="|".join(map(re.escape, SEQUENCES)),


def existing(*paths):
    """The paths that are there: what is missing is the fault of one sequence, told by its job."""
    return [path for path in paths if path is not None and Path(path).exists()]


def of_sequence(wildcards):
    """The sequence's row, its object (None = a person alone) and its subject."""
    row = PROJECT.sequences[wildcards.sequence]
    return row, PROJECT.object_of(wildcards.sequence), PROJECT.subjects[row.subject]


def made_by_studio(wildcards, name):
    """What stands for the studio's files of this kind; None for a real recording."""
    if PROJECT.recordings_made(wildcards.sequence) is None:
        return None
    output = "truth" if name == "truth" else "manifest"
    return expand(getattr(rules.studio.output, output), sequence=wildcards.sequence)


def recorded(column):
    """Input function: what the sequence's row says under ``column``, or the studio made for it.

    Their dates do not count, but those of what the studio makes anew.
    """

    def files(wildcards):
        made = made_by_studio(wildcards, column)
        if made is not None:
            anew = PLAN.is_stale(wildcards.sequence, STUDIO)
            return made if anew else ancient(made)
        row = PROJECT.sequences[wildcards.sequence]
        if column == "recordings":
            return ancient(input_files(row))
        return ancient(existing(getattr(row, column)))

    return files


def annotation_broken(sequence):
    """Whether the sequence's annotation cannot be read; the studio's own is not there yet."""
    return bool(PLAN.annotation_fault(sequence)) and not PROJECT.annotation_made(
        sequence
    )


def annotation_input(wildcards):
    """Input function: where the annotation is broken, the output of a job that fails and says why.

    What was computed before stays, and no other sequence is touched. That an annotation has
    changed is seen by what is recorded in the artefacts.
    """
    if not annotation_broken(wildcards.sequence):
        return []
    return [rules.broken_annotation.output.checked.format(sequence=wildcards.sequence)]


def out_of_date(stage):
    """Input function: a mark that is newer than the stage's output where that was made from other
    settings, annotations, files, code or artefacts than it would be now.

    This alone makes a job run again: all other inputs are ``ancient``.
    """
    return lambda wildcards: PLAN.mark(getattr(wildcards, "sequence", ""), stage)


def identity_of(stage):
    """Param: what the output is to be made from, for whoever compares jobs of two runs."""
    return lambda wildcards: PLAN.fingerprint(getattr(wildcards, "sequence", ""), stage)


def artefacts_read(stage):
    """Input function: the artefacts that a stage reads, by the stage that wrote each.

    Where the stage's output is out of date, it runs when these are made anew; else what they come
    to is as it was, and their dates do not count.
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
    """Input function: every sequence's summary, which count by their dates as above."""
    paths = expand(f"{RESULTS}/{{sequence}}/summary.h5", sequence=SEQUENCES)
    return paths if PLAN.is_stale("", DATASET) else ancient(paths)


def object_files(wildcards):
    """Input function: the object's mesh and contact vertices."""
    _, tracked, _ = of_sequence(wildcards)
    return [] if tracked is None else existing(tracked.mesh, tracked.contact_vertices)


def body_file(wildcards):
    """Input function: the licensed body file of the subject's gender, where one is set."""
    _, _, subject = of_sequence(wildcards)
    return existing(SETTINGS.body_models.of(subject.gender))


def pose_prior_file(wildcards):
    """Input function: the pose prior's weights, where the settings name them."""
    return existing(SETTINGS.body_models.vposer)


def keypoint_definition_file(wildcards):
    """Input function: where the detector's points lie, where the settings name a table."""
    return existing(SETTINGS.body_fit.keypoint_definition)


def motion_prior_files(wildcards):
    """Input function: the motion prior's weights and statistics, where the settings name them."""
    return existing(*(SETTINGS.joint.lemo_files or ()))


def results_file(wildcards):
    """Input function: what stands for another program's results, where the sequence's row names
    them."""
    named = PROJECT.sequences[wildcards.sequence].results
    return [] if named is None else existing(*files_of(named))


def length_of(wildcards):
    """How many frame sets and cameras there are to compute; known exactly once frames are."""
    if not hasattr(wildcards, "sequence"):
        return Extent(0, 0)
    frames = PROJECT.artefact(wildcards.sequence, "frames")
    changed = frames.stat().st_mtime_ns if frames.exists() else None
    return length_since(wildcards.sequence, changed)


@functools.cache
def length_since(sequence, changed):
    """The length of a sequence whose frames artefact was written at ``changed``."""
    return extent_of(PROJECT, sequence)


def memory(stage):
    """Resource: by frames and cameras, and more with every attempt after a job was killed."""

    def megabytes(wildcards, attempt):
        return memory_mb(PROJECT, stage, length_of(wildcards), attempt)

    return megabytes


def duration(stage):
    """Resource: minutes, likewise; of the recordings' reader by their bytes."""

    def asked(wildcards, attempt):
        read = 0.0
        if stage == "frames":
            read = recorded_mb(PROJECT.sequences[wildcards.sequence].recordings)
        return minutes(PROJECT, stage, length_of(wildcards), attempt, read_mb=read)

    return asked


def gpu_of(stage):
    """Resources: a GPU, and the partition that has some, where the settings have the stage use it."""
    if not on_gpu(PROJECT, stage):
        return {}
    partition = SETTINGS.cluster.gpu_partition
    return {"gpu": 1, **({"slurm_partition": partition} if partition else {})}
