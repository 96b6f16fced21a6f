rule joint:
    """Body and object together, over all frames."""
    input:
        unpack(artefacts_read("joint")),
        object=ancient(object_files),
        body=ancient(body_file),
        pose_prior=ancient(pose_prior_file),
        motion_prior=ancient(motion_prior_files),
        annotation=ancient(annotation_input),
        results=ancient(results_file),
        mark=out_of_date("joint"),
    output:
        joint=f"{RESULTS}/{{sequence}}/joint.h5",
    log:
        f"{LOGS}/{{sequence}}/joint.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/joint.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        **gpu_of("joint"),
        mem_mb=memory("joint"),
        runtime=duration("joint"),
    params:
        identity=identity_of("joint"),
    message:
        "{wildcards.sequence}: refining body and object together"
    script:
        "../scripts/stage.py"
