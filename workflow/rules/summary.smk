rule summary:
    """What the sequence adds to the dataset's tables, heatmaps and charts."""
    input:
        unpack(artefacts_read("summary")),
        mark=out_of_date("summary"),
    output:
        summary=f"{RESULTS}/{{sequence}}/summary.h5",
    log:
        f"{LOGS}/{{sequence}}/summary.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/summary.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("summary"),
        runtime=duration("summary"),
    params:
        identity=identity_of("summary"),
    message:
        "{wildcards.sequence}: summing up"
    script:
        "../scripts/stage.py"
