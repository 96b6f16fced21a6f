rule dataset:
    """Heatmaps, histograms, tables and the report over all sequences."""
    input:
        **{
            stage: expand(f"{RESULTS}/{{sequence}}/{stage}.h5", sequence=SEQUENCES)
            for stage in SEQUENCE_STAGES
        },
    output:
        report=f"{RESULTS}/report.html",
        summary=f"{RESULTS}/summary.json",
        heatmaps=f"{RESULTS}/heatmaps.h5",
        tables=directory(f"{RESULTS}/tables"),
    log:
        f"{LOGS}/dataset.log",
    benchmark:
        f"{BENCHMARKS}/dataset.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory(4000),
        runtime=60,
    params:
        settings=settings_of("report"),
        sequences=SEQUENCES,
        entries=all_entries(),
        code=code_of("dataset"),
    message:
        "the report over all sequences"
    script:
        "../scripts/dataset.py"
