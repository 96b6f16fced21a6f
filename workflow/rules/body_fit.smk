rule body_fit:
    """The body in every frame."""
    input:
        unpack(artefacts_read("body_fit")),
        body=ancient(body_file),
        pose_prior=ancient(pose_prior_file),
        keypoint_definition=ancient(keypoint_definition_file),
        mark=out_of_date("body_fit"),
    output:
        body_fit=f"{RESULTS}/{{sequence}}/body_fit.h5",
    log:
        f"{LOGS}/{{sequence}}/body_fit.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/body_fit.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        **gpu_of("body_fit"),
        mem_mb=memory("body_fit"),
        runtime=duration("body_fit"),
    params:
        identity=identity_of("body_fit"),
    message:
        "{wildcards.sequence}: fitting the body"
    script:
        "../scripts/stage.py"
