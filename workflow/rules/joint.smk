rule joint:
    """Body and object together, over all frames."""
    input:
        object=object_files,
        body=body_file,
        pose_prior=pose_prior_file,
        frames=rules.frames.output.frames,
        scene=rules.scene.output.scene,
        person=rules.person.output.person,
        object_track=rules.object_track.output.object_track,
        body_fit=rules.body_fit.output.body_fit,
        annotation=ancient(annotation_input("contact")),
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
        mem_mb=memory(4000),
        runtime=120,
    params:
        settings=settings_of("joint"),
        annotation=annotation_of("contact"),
        object=tracked_object,
        subject=tracked_subject,
        device=SETTINGS.device,
        code=code_of("joint"),
    message:
        "{wildcards.sequence}: refining body and object together"
    script:
        "../scripts/stage.py"
