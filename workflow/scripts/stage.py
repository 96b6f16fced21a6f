"""One stage of one sequence; the rule's name says which."""

from pathlib import Path

from intercap_core.pipeline.job import job

with job(
    f"{snakemake.wildcards.sequence}: {snakemake.rule}",
    snakemake.log[0],
    threads=snakemake.threads,
):
    from intercap_core.pipeline.step import run_step
    from intercap_core.project import load_project
    from intercap_core.stage_list import SEQUENCE_STAGES

    run_step(
        snakemake.rule,
        load_project(**snakemake.config["project"]),
        snakemake.wildcards.sequence,
        inputs={
            name: Path(path) for name, path in snakemake.input.items() if name in SEQUENCE_STAGES
        },
        output=Path(snakemake.output[0]),
        keep=True,
    )
