"""Check one sequence's annotation file."""

from pathlib import Path

from intercap_core.pipeline.job import job

with job(f"{snakemake.wildcards.sequence}: annotation", snakemake.log[0]):
    from intercap_core.project import load_project

    load_project(**snakemake.config["project"]).annotation(snakemake.wildcards.sequence)
    Path(snakemake.output.checked).touch()
