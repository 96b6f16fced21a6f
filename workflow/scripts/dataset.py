"""All sequences together: tables, heatmaps, summary and report."""

from intercap_core.pipeline.job import job

with job("dataset", snakemake.log[0], threads=snakemake.threads):
    from intercap_core.pipeline.step import run_dataset
    from intercap_core.project import load_project

    run_dataset(load_project(**snakemake.config["project"]))
