rule broken_annotation:
    """Fails with the reason. A job of the run only if the sequence's annotation is invalid."""
    output:
        checked=f"{RESULTS}/{{sequence}}/annotation.checked",
    log:
        f"{LOGS}/{{sequence}}/annotation.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/annotation.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("annotation"),
        runtime=duration("annotation"),
    message:
        "{wildcards.sequence}: checking the annotation"
    script:
        "../scripts/annotation.py"


rule frames:
    """Recordings to synchronised frame sets."""
    input:
        recordings=recorded("recordings"),
        calibration=recorded("calibration"),
        annotation=ancient(annotation_input),
        mark=out_of_date("frames"),
    output:
        frames=f"{RESULTS}/{{sequence}}/frames.h5",
    log:
        f"{LOGS}/{{sequence}}/frames.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/frames.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("frames"),
        runtime=duration("frames"),
    params:
        identity=identity_of("frames"),
    message:
        "{wildcards.sequence}: reading and synchronising the recordings"
    script:
        "../scripts/stage.py"
