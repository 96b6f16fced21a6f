rule export:
    """Files for other tools: InterCap, AMASS, BOP, COCO, glb."""
    input:
        **artefacts_read("export"),
        object=object_files,
        body=body_file,
    output:
        folder=directory(f"{RESULTS}/{{sequence}}/export"),
    log:
        f"{LOGS}/{{sequence}}/export.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/export.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("export"),
        runtime=duration("export"),
    params:
        settings=settings_of("export"),
        object=tracked_object,
        subject=tracked_subject,
        code=code_of("export"),
    message:
        "{wildcards.sequence}: exporting"
    script:
        "../scripts/stage.py"
