import functools
import re
from pathlib import Path

from snakemake.exceptions import WorkflowError

from intercap_core.capture.layouts import input_files
from intercap_core.config import Annotation, digest
from intercap_core.errors import UserError
from intercap_core.imports.results import file_of
from intercap_core.pipeline.code_digest import code_digest
from intercap_core.pipeline.requests import (
    Extent,
    extent_of,
    has_model,
    memory_mb,
    minutes,
    on_gpu,
    recorded_mb,
)
from intercap_core.project import load_project
from intercap_core.stage_list import SEQUENCE_STAGES, STAGES


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
    """Input function: what the sequence's row says under ``column``, or the studio made for it."""

    def files(wildcards):
        made = made_by_studio(wildcards, column)
        if made is not None:
            return made
        row = PROJECT.sequences[wildcards.sequence]
        if column == "recordings":
            return input_files(row)
        return existing(getattr(row, column))

    return files


@functools.cache
def annotation_sections(sequence):
    """The filled sections of a sequence's annotation; None where the file is broken."""
    if PROJECT.annotation_made(sequence):
        made = digest(SETTINGS.studio.captures[sequence])
        return {section: made for section in Annotation.model_fields}
    try:
        PROJECT.annotation(sequence)
        return PROJECT.annotation_sections(sequence)
    except UserError:
        return None


def annotation_input(*sections):
    """Input function: the annotation file where it fills one of the stage's own sections.

    A broken file is replaced by the output of a job that fails and says why: what was computed
    before stays, and no other sequence is touched.
    """

    def files(wildcards):
        filled = annotation_sections(wildcards.sequence)
        if filled is None:
            return [
                rules.broken_annotation.output.checked.format(
                    sequence=wildcards.sequence
                )
            ]
        if not any(section in filled for section in sections):
            return []
        if PROJECT.annotation_made(wildcards.sequence):
            return made_by_studio(wildcards, "manifest")
        return [PROJECT.annotation_path(wildcards.sequence)]

    return files


def artefacts_read(stage):
    """Inputs: the artefacts that a stage reads, by the stage that wrote each."""
    return {name: f"{RESULTS}/{{sequence}}/{name}.h5" for name in STAGES[stage].reads}


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


def settings_of(stage):
    """Param: digest of one stage's settings."""
    return digest(getattr(SETTINGS, stage))


digest_of_code = functools.cache(code_digest)


def code_of(stage):
    """Param: digest of the core modules that the stage reaches; the same for every sequence."""
    return lambda wildcards: digest_of_code(f"stages.{stage}")


def annotation_of(*sections):
    """Param: digest of the annotation's own sections; editing another one changes nothing here."""

    def own(wildcards):
        filled = annotation_sections(wildcards.sequence) or {}
        return digest([filled.get(section) for section in sections])

    return own


def entry_of_object(name):
    """An object's entry without its files, which are inputs; None of no object."""
    if name is None:
        return None
    entry = PROJECT.objects[name]
    return entry.model_dump(mode="json", exclude={"mesh", "contact_vertices"})


def tracked_object(wildcards):
    """Param: digest of the object's entry."""
    return digest(entry_of_object(PROJECT.sequences[wildcards.sequence].object))


def all_entries():
    """Param: digest of every object's and subject's entry that the sequences use."""
    subjects = {PROJECT.sequences[name].subject for name in SEQUENCES}
    return digest(
        [[entry_of_object(name) for name in PROJECT.objects_named()], sorted(subjects)]
    )


def tracked_subject(wildcards):
    """Param: digest of the subject's row; its body file is an input."""
    return digest(of_sequence(wildcards)[2])


def intent_of(wildcards):
    """Param: what the sequence's row says that the person was asked to do."""
    return PROJECT.sequences[wildcards.sequence].intent


def results_file(wildcards):
    """Input function: another program's results of the sequence, where its row names them."""
    named = PROJECT.sequences[wildcards.sequence].results
    return [] if named is None else existing(file_of(named))


def results_of(wildcards):
    """Param: where another program's results of the sequence are; None = they are made here."""
    named = PROJECT.sequences[wildcards.sequence].results
    return None if named is None else named.as_posix()


def layout_of(wildcards):
    """Param: how the sequence's recordings are laid out, and what its row states of the
    calibration; the files themselves are inputs."""
    row = PROJECT.sequences[wildcards.sequence]
    stated = (row.calibration_scale, row.calibration_up, row.calibration_floor)
    return row.layout if stated == (None, None, None) else [row.layout, *stated]


def capture_of(wildcards):
    """Param: everything that decides what the studio makes of one sequence."""
    shared = SETTINGS.studio.model_dump(mode="json", exclude={"captures"})
    return digest([shared, SETTINGS.studio.captures[wildcards.sequence]])


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
