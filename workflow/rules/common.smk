import functools
import re
import sys
from itertools import combinations
from pathlib import Path

from snakemake.exceptions import WorkflowError
from snakemake.settings.types import DeploymentMethod
from snakemake.utils import update_config

from intercap_core.errors import UserError
from intercap_core.inputs.documents import read_yaml
from intercap_core.pipeline.code_digest import stage_code
from intercap_core.pipeline.lease import remove_dead_lock
from intercap_core.pipeline.plan import DATASET, Plan
from intercap_core.pipeline.stage_inputs import DATASET_READS, files_read
from intercap_core.pipeline.resources import (
    extent_of,
    has_model,
    memory_mb,
    minutes,
    on_gpu,
    recorded_mb,
    total_extent,
)
from intercap_core.project import load_project
from intercap_core.shipped import shipped
from intercap_core.stage_list import SEQUENCE_STAGES, STAGES
from snakemake_executor_plugin_intercap_slurm.ledger import stamp


def _load():
    """Load and validate settings and tables before any job starts."""
    # Snakemake's own `config` has the scalars of YAML 1.1, in which 010 is 8.
    given = workflow.config_settings
    # of the command line, or of a workflow that uses this one as a module
    files = given.configfiles or workflow.configfiles
    path, *others = files or [Path("config/config.yaml")]
    overrides = {}
    try:
        for values in (*map(read_yaml, others), given.config):
            update_config(overrides, values or {})
        config["project"] = {"path": str(path), "overrides": overrides}
        return load_project(path, overrides)
    except UserError as error:
        raise WorkflowError(str(error)) from None


# The environment is installed from the folder that holds `.snakemake`.
CHECKOUT = shipped("pyproject.toml")
if DeploymentMethod.CONDA in workflow.deployment_settings.deployment_method and not (
    CHECKOUT.is_file() and CHECKOUT.parent == Path.cwd()
):
    raise WorkflowError(
        "--sdm conda installs the environment from a checkout, expected as the working directory: "
        f"{Path.cwd()} is none; leave the option out to use the environment of this program"
    )

PROJECT = _load()
SETTINGS = PROJECT.config
SEQUENCES = list(PROJECT.sequences)
PLAN = Plan(PROJECT)
if workflow.is_main_process:
    try:
        remove_dead_lock(Path(".snakemake"))
        PLAN.mark_all()
    except (UserError, OSError) as error:
        raise WorkflowError(str(error)) from None
VIRTUAL = [name for name in SEQUENCES if PROJECT.recordings_made(name) is not None]
NOTHING = "(?!)"  # pattern without a match
RESULTS = PROJECT.results.as_posix()
LOGS = PROJECT.logs.as_posix()
BENCHMARKS = PROJECT.benchmarks.as_posix()
ENVIRONMENT = "../envs/intercap.yaml"
MODEL_THREADS = 8


wildcard_constraints:
    sequence="|".join(map(re.escape, SEQUENCES)),


def annotation_input(wildcards):
    """Input function: for an invalid annotation, the output of a job that fails with the reason.

    The sequence's existing outputs stay. Changes of a valid annotation are found by the manifests;
    an annotation that the studio writes is not checked.
    """
    sequence = wildcards.sequence
    if PROJECT.annotation_made(sequence) or not PLAN.annotation_fault(sequence):
        return []
    return [rules.broken_annotation.output.checked.format(sequence=sequence)]


def jobs():
    """Stages of each kind of job, and the sequences that have it: by the plan and the command line.

    A job on a cluster gets the name of its rule from the main process.
    """
    if not workflow.is_main_process:
        groups = [*SETTINGS.one_process, *((stage,) for stage in STAGES)]
        return {
            group[first:end]: SEQUENCES
            for group in groups
            for first, end in combinations(range(len(group) + 1), 2)
        }
    # Snakemake parses the workflow before it sets `workflow.dag_settings`, which has the targets
    words = {re.sub("^--[a-z-]+=", "", argument) for argument in sys.argv[1:]}
    resources = workflow.resource_settings
    # options such as --until and --set-threads name rules
    named = {*words, *resources.overwrite_threads, *resources.overwrite_resources}
    alone = {
        stage
        for stage in STAGES
        if stage in named or gpu_of(stage) or threads_of(stage) > 1
    }
    last = {
        stage
        for stage in STAGES
        for name in SEQUENCES
        if PROJECT.artefact(name, stage).as_posix() in words
    }
    found = {(stage,): list(SEQUENCES) for stage in STAGES}
    for name in SEQUENCES:
        for stages in PLAN.shared_jobs(name, alone=alone, last=last):
            found.setdefault(stages, []).append(name)
            for stage in stages:
                found[(stage,)].remove(name)
    return found


def rule_name(stages):
    """Name of a job after its stage, or after the first and the last of several."""
    return "_to_".join(dict.fromkeys((stages[0], stages[-1])))


def one_of(names):
    """Pattern that matches the names."""
    return "|".join(map(re.escape, names)) or NOTHING


def out_of_date(*stages):
    """Input function: for each stale output, a mark that is newer than the output.

    Only this mark makes Snakemake run a job again; without it, all inputs are ``ancient``. See
    docs/reruns.md.
    """

    def marks(wildcards):
        sequence = getattr(wildcards, "sequence", "")
        return [path for stage in stages for path in PLAN.mark(sequence, stage)]

    return marks


def identity_of(*stages):
    """Param: fingerprints that the outputs will get, shown in Snakemake's reports."""

    def fingerprints(wildcards):
        sequence = getattr(wildcards, "sequence", "")
        return [PLAN.fingerprint(sequence, stage) for stage in stages]

    return fingerprints


def inputs_of(*stages):
    """Input function: the artefacts that a job reads, by stage or by the column that names another
    sequence, and the studio's recording.

    Their dates count only if an output of the job is stale. If none is, an artefact that is made
    again gets the same content, and the outputs stay up to date.
    """
    read = {name for stage in stages for name in STAGES[stage].reads} - set(stages)
    made = []
    if any("recordings" in STAGES[stage].columns for stage in stages):
        made.append("manifest")
    if any("truth" in stage_code(stage).parameters for stage in stages):
        made.append("truth")

    def files(wildcards):
        sequence = wildcards.sequence
        paths = {
            name: f"{RESULTS}/{sequence}/{name}.h5" for name in STAGES if name in read
        }
        for stage in stages:
            other = PROJECT.reused_sequence(sequence, stage)
            if other in SEQUENCES:  # an excluded one is not computed
                paths[STAGES[stage].reuses] = f"{RESULTS}/{other}/{stage}.h5"
        if sequence in VIRTUAL:
            studio = {name: getattr(rules.studio.output, name) for name in made}
            paths |= {
                name: path.format(sequence=sequence) for name, path in studio.items()
            }
        if any(PLAN.is_stale(sequence, stage) for stage in stages):
            return paths
        return {name: ancient(path) for name, path in paths.items()}

    return files


def files_of(*stages):
    """Param: path, size and date of the user's files that a job reads, without the studio's.

    The executor for Slurm does not adopt jobs whose files have changed. Files are not inputs: Snakemake
    fails the job of an input that is dated ahead of the clock and removes its output.
    """

    def files(wildcards):
        sequence = wildcards.sequence
        made = PROJECT.recordings_made(sequence)
        read = [
            path for stage in stages for path in files_read(PROJECT, sequence, stage)
        ]
        return [
            f"{path} {stamp(path)}"
            for path in dict.fromkeys(read)
            if made is None or not path.is_relative_to(made)
        ]

    return files


def output_of(stage):
    """Output of a stage: an artefact or a folder."""
    path = PROJECT.artefact("{sequence}", stage).as_posix()
    if stage == "page":
        return report(
            directory(path),
            htmlindex="index.html",
            category="Sequences",
            labels={"sequence": "{sequence}"},
        )
    return directory(path) if STAGES[stage].writes_folder else path


def read_by_dataset(wildcards):
    """Input function: summaries and exports of all sequences; dates count as in ``inputs_of``."""
    paths = {
        stage: [PROJECT.artefact(name, stage).as_posix() for name in SEQUENCES]
        for stage in DATASET_READS
    }
    if PLAN.is_stale("", DATASET):
        return paths
    return {stage: ancient(files) for stage, files in paths.items()}


def length_of(wildcards):
    """Extent of the job's sequence, or of all sequences together."""
    named = [wildcards.sequence] if hasattr(wildcards, "sequence") else SEQUENCES
    frames = {name: PROJECT.artefact(name, "frames") for name in named}
    return total_extent(
        length_since(name, path.stat().st_mtime_ns if path.exists() else None)
        for name, path in frames.items()
    )


@functools.cache
def length_since(sequence, changed):
    """Extent of a sequence whose frames artefact has the date ``changed``: from this artefact, the
    studio's settings, or a default."""
    return extent_of(PROJECT, sequence)


def memory(*stages):
    """Resource: megabytes by frames and cameras, growing with each attempt; of the stage that
    needs most."""

    def megabytes(wildcards, attempt):
        extent = length_of(wildcards)
        return max(memory_mb(PROJECT, stage, extent, attempt) for stage in stages)

    return megabytes


def duration(*stages):
    """Resource: minutes by frames and cameras, and by file size for the stage frames."""

    def asked(wildcards, attempt):
        read = 0.0
        if "frames" in stages:
            read = recorded_mb(PROJECT.sequences[wildcards.sequence].recordings)
        return minutes(PROJECT, stages, length_of(wildcards), attempt, read_mb=read)

    return asked


def gpu_of(stage):
    """Resources: a GPU and its partition, if the settings run the stage on a GPU."""
    if not on_gpu(PROJECT, stage):
        return {}
    partition = SETTINGS.cluster.gpu_partition
    return {"gpu": 1, **({"slurm_partition": partition} if partition else {})}


def threads_of(stage):
    """Threads: several if a detector runs, otherwise one."""
    return MODEL_THREADS if stage == "detections" and has_model(PROJECT) else 1
