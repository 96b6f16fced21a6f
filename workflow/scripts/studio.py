"""Make one virtual recording."""

from intercap_core.job import job

with job(f"{snakemake.wildcards.sequence}: studio", snakemake.log[0], threads=snakemake.threads):
    from intercap_core.project import load_project
    from intercap_core.step import run_studio

    run_studio(load_project(**snakemake.config["project"]), snakemake.wildcards.sequence)
