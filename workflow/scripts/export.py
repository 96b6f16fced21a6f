"""Files for other tools."""

from pathlib import Path

from intercap_core.job import job

with job(
    f"{snakemake.wildcards.sequence}: export", snakemake.log[0], threads=snakemake.threads
):
    from intercap_core.project import load_project
    from intercap_core.step import run_export

    run_export(
        load_project(**snakemake.config["project"]),
        snakemake.wildcards.sequence,
        inputs={name: Path(snakemake.input[name]) for name in ("frames", "scene", "joint")},
        output=Path(snakemake.output.folder),
    )
