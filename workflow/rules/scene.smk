rule scene:
    """Refined extrinsics, ground plane and background."""
    input:
        **artefacts_read("scene"),
        annotation=ancient(annotation_input("floor", "starts", "starts_sigma")),
    output:
        scene=f"{RESULTS}/{{sequence}}/scene.h5",
    log:
        f"{LOGS}/{{sequence}}/scene.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/scene.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("scene"),
        runtime=duration("scene"),
    params:
        settings=settings_of("scene"),
        annotation=annotation_of("floor", "starts", "starts_sigma"),
        code=code_of("scene"),
    message:
        "{wildcards.sequence}: refining the cameras, finding the floor"
    script:
        "../scripts/stage.py"
