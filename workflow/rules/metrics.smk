rule metrics:
    """Distances, penetration, and errors against truth where it is known."""
    input:
        truth=recorded("truth"),
        object=object_files,
        body=body_file,
        frames=rules.frames.output.frames,
        scene=rules.scene.output.scene,
        detections=rules.detections.output.detections,
        person=rules.person.output.person,
        object_track=rules.object_track.output.object_track,
        body_fit=rules.body_fit.output.body_fit,
        joint=rules.joint.output.joint,
    output:
        metrics=f"{RESULTS}/{{sequence}}/metrics.h5",
    log:
        f"{LOGS}/{{sequence}}/metrics.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/metrics.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory(4000),
        runtime=60,
    params:
        settings=settings_of("metrics"),
        object=tracked_object,
        subject=tracked_subject,
        code=code_of("metrics"),
    message:
        "{wildcards.sequence}: measuring"
    script:
        "../scripts/stage.py"
