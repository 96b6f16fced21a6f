rule body_fit:
    """The body in every frame."""
    input:
        **artefacts_read("body_fit"),
        body=body_file,
        pose_prior=pose_prior_file,
        keypoint_definition=keypoint_definition_file,
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
        settings=settings_of("body_fit"),
        subject=tracked_subject,
        device=SETTINGS.device,
        code=code_of("body_fit"),
    message:
        "{wildcards.sequence}: fitting the body"
    script:
        "../scripts/stage.py"
