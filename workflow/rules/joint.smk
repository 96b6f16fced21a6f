rule joint:
    """Body and object together, over all frames."""
    input:
        **artefacts_read("joint"),
        object=object_files,
        body=body_file,
        pose_prior=pose_prior_file,
        motion_prior=motion_prior_files,
        annotation=ancient(annotation_input("contact")),
        results=results_file,
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
        settings=settings_of("joint"),
        annotation=annotation_of("contact"),
        object=tracked_object,
        subject=tracked_subject,
        device=SETTINGS.device,
        results=results_of,
        code=code_of("joint"),
    message:
        "{wildcards.sequence}: refining body and object together"
    script:
        "../scripts/stage.py"
