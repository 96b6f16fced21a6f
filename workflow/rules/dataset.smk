rule dataset:
    """Heatmaps, tables, card, merged exports and the site's first page."""
    input:
        unpack(read_by_dataset),
        mark=out_of_date("dataset"),
    output:
        site=report(f"{RESULTS}/site/index.html", category="Dataset"),
        summary=f"{RESULTS}/summary.json",
        heatmaps=f"{RESULTS}/heatmaps.h5",
        tables=directory(f"{RESULTS}/tables"),
        card=f"{RESULTS}/README.md",
        card_json=f"{RESULTS}/card.json",
        croissant=f"{RESULTS}/croissant.json",
        export=directory(f"{RESULTS}/export"),
    log:
        f"{LOGS}/dataset.log",
    benchmark:
        f"{BENCHMARKS}/dataset.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("dataset"),
        runtime=duration("dataset"),
    params:
        identity=identity_of("dataset"),
    message:
        "the site's first page"
    script:
        "../scripts/dataset.py"
