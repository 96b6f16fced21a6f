from snakemake.utils import min_version

min_version("9.20")


include: "workflow/rules/common.smk"
include: "workflow/rules/studio.smk"
include: "workflow/rules/dataset.smk"


for _stage in STAGES:

    include: f"workflow/rules/{_stage}.smk"


rule all:
    """Artefacts, exports and pages of every sequence, and the site; each by name, so that one that
    was removed is made again though what was made of it is there."""
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
