rule annotation:
    """Check the sequence's annotation file; where it is broken, only this job fails."""
    input:
        annotation=ancient(annotation_file),
    output:
        annotation=f"{RESULTS}/{{sequence}}/annotation.json",
    params:
        annotation=annotation_of(*Annotation.model_fields),
        code=code_of("annotation"),
    log:
        f"{LOGS}/{{sequence}}/annotation.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/annotation.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory(500),
        runtime=5,
    message:
        "{wildcards.sequence}: checking the annotation"
    script:
        "../scripts/annotation.py"


rule frames:
    """Recordings to synchronised frame sets."""
    input:
        recordings=recorded("recordings"),
        calibration=recorded("calibration"),
        annotation=ancient(rules.annotation.output.annotation),
    output:
        frames=f"{RESULTS}/{{sequence}}/frames.h5",
    params:
        settings=settings_of("frames"),
        annotation=annotation_of("drop_frames"),
        code=code_of("frames"),
    log:
        f"{LOGS}/{{sequence}}/frames.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/frames.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory(2000),
        runtime=60,
    message:
        "{wildcards.sequence}: reading and synchronising the recordings"
    script:
        "../scripts/stage.py"
