"""All sequences together: tables, heatmaps, summary and report."""

from intercap_core.job import job

with job("dataset", snakemake.log[0], threads=snakemake.threads):
    from intercap_core.project import load_project
    from intercap_core.step import run_dataset

    run_dataset(load_project(**snakemake.config["project"]))
