rule dataset:
    """Heatmaps, histograms, tables and the report over all sequences."""
    input:
        frames=expand(rules.frames.output.frames, sequence=SEQUENCES),
        scene=expand(rules.scene.output.scene, sequence=SEQUENCES),
        detections=expand(rules.detections.output.detections, sequence=SEQUENCES),
        person=expand(rules.person.output.person, sequence=SEQUENCES),
        object_track=expand(rules.object_track.output.object_track, sequence=SEQUENCES),
        body_fit=expand(rules.body_fit.output.body_fit, sequence=SEQUENCES),
        joint=expand(rules.joint.output.joint, sequence=SEQUENCES),
        metrics=expand(rules.metrics.output.metrics, sequence=SEQUENCES),
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
