rule dataset:
    """Heatmaps, histograms, tables and the site's first page."""
    input:
        summaries=expand(f"{RESULTS}/{{sequence}}/summary.h5", sequence=SEQUENCES),
    output:
        site=report(f"{RESULTS}/site/index.html", category="Dataset"),
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
        sequences=SEQUENCES,
        entries=all_entries(),
        code=code_of("dataset"),
    message:
        "the site's first page"
    script:
        "../scripts/dataset.py"
