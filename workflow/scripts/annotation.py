"""Check one sequence's annotation file."""

from pathlib import Path

from intercap_core.job import job

with job(f"{snakemake.wildcards.sequence}: annotation", snakemake.log[0]):
    from intercap_core.stages import annotation

    output = Path(snakemake.output[0])
    annotation.run(
        annotation=Path(snakemake.input.annotation) if snakemake.input.annotation else None,
        frames=output.with_name("frames.h5"),
        output=output,
    )
