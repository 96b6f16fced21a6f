"""One stage of one sequence, or several that share this process, in their order."""

import gc
import sys
from contextlib import nullcontext

from intercap_core.memory import return_freed_memory
from intercap_core.pipeline.job import benchmark, job
from intercap_core.stage_list import STAGES

sequence, stages = snakemake.wildcards.sequence, snakemake.params.stages
failed = set()
for stage, log in zip(stages, snakemake.log, strict=True):
    if failed & set(STAGES[stage].reads):
        failed.add(stage)
        continue
    try:
        with job(f"{sequence}: {stage}", log, threads=snakemake.threads):
            from intercap_core.pipeline.step import run_step
            from intercap_core.project import load_project

            project = load_project(**snakemake.config["project"])
            path = project.benchmarks / sequence / f"{stage}.tsv"
            # Snakemake measures the job, which is the stage if it has no other
            measured = benchmark(path, since_start=stage == stages[0])
            with measured if len(stages) > 1 else nullcontext():
                run_step(stage, project, sequence, keep=True)
    except SystemExit as end:
        if end.code != 1:  # a signal ends the process
            raise
        failed.add(stage)
    gc.collect()
    return_freed_memory()
if failed:
    sys.exit(1)
