rule metrics:
    """Distances, penetration, and errors against truth where it is known."""
    input:
        unpack(artefacts_read("metrics")),
        truth=recorded("truth"),
        object=ancient(object_files),
        body=ancient(body_file),
        mark=out_of_date("metrics"),
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
        identity=identity_of("metrics"),
    message:
        "{wildcards.sequence}: measuring"
    script:
        "../scripts/stage.py"
