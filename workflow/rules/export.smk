rule export:
    """Files for other tools: InterCap, AMASS, BOP, COCO, glb, meshes."""
    input:
        unpack(artefacts_read("export")),
        object=ancient(object_files),
        body=ancient(body_file),
        mark=out_of_date("export"),
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
        identity=identity_of("export"),
    message:
        "{wildcards.sequence}: exporting"
    script:
        "../scripts/stage.py"
