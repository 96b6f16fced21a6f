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
        mem_mb=memory(4000),
        runtime=120,
    params:
        settings=settings_of("body_fit"),
        subject=tracked_subject,
        device=SETTINGS.device,
        code=code_of("body_fit"),
    message:
        "{wildcards.sequence}: fitting the body"
    script:
        "../scripts/stage.py"
