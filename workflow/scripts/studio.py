"""Make one virtual recording."""

from intercap_core.pipeline.job import job

with job(f"{snakemake.wildcards.sequence}: studio", snakemake.log[0], threads=snakemake.threads):
    from intercap_core.pipeline.step import run_studio
    from intercap_core.project import load_project

    run_studio(load_project(**snakemake.config["project"]), snakemake.wildcards.sequence)
