rule metrics:
    """Distances, penetration, and errors against truth where it is known."""
    input:
        **artefacts_read("metrics"),
        truth=recorded("truth"),
        object=object_files,
        body=body_file,
    output:
        metrics=f"{RESULTS}/{{sequence}}/metrics.h5",
    log:
        f"{LOGS}/{{sequence}}/metrics.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/metrics.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("metrics"),
        runtime=duration("metrics"),
    params:
        settings=settings_of("metrics"),
        object=tracked_object,
        subject=tracked_subject,
        code=code_of("metrics"),
    message:
        "{wildcards.sequence}: measuring"
    script:
        "../scripts/stage.py"
