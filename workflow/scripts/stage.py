"""One stage of one sequence; the rule's name says which."""

from intercap_core.pipeline.job import job

with job(
    f"{snakemake.wildcards.sequence}: {snakemake.rule}",
    snakemake.log[0],
    threads=snakemake.threads,
):
    from intercap_core.pipeline.step import run_step
    from intercap_core.project import load_project

    project = load_project(**snakemake.config["project"])
    run_step(snakemake.rule, project, snakemake.wildcards.sequence, keep=True)
