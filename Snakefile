from snakemake.utils import min_version

min_version("9.20")


include: "workflow/rules/common.smk"
include: "workflow/rules/studio.smk"
include: "workflow/rules/dataset.smk"
include: "workflow/rules/stages.smk"


rule all:
    """All outputs: artefacts, exports and pages of every sequence, and the site.

    Each output is listed, so that a deleted one is made again even if later outputs exist.
    """
    default_target: True
    input:
        rules.dataset.output,
        expand(
            f"{RESULTS}/{{sequence}}/{{stage}}.h5",
            sequence=SEQUENCES,
            stage=SEQUENCE_STAGES,
        ),
        expand(f"{RESULTS}/site/sequences/{{sequence}}", sequence=SEQUENCES),
        expand(f"{RESULTS}/{{sequence}}/export", sequence=SEQUENCES),
    localrule: True
