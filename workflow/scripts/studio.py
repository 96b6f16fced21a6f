"""Make one virtual recording."""

from pathlib import Path

from intercap_core.job import job

with job(
    f"{snakemake.wildcards.sequence}: studio", snakemake.log[0], threads=snakemake.threads
):
    from intercap_core.project import load_project
    from intercap_core.studio import capture

    project = load_project(**snakemake.config["project"])
    row = project.sequences[snakemake.wildcards.sequence]
    capture.make_capture(
        project.config.studio.captures[row.sequence],
        project.config.studio,
        sequence=row,
        object_=project.objects[row.object],
        output=Path(snakemake.output.manifest).parent,
    )
