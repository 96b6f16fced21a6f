rule object_track:
    """The object's pose in every frame."""
    input:
        unpack(artefacts_read("object_track")),
        object=ancient(object_files),
        annotation=ancient(annotation_input),
        mark=out_of_date("object_track"),
    output:
        object_track=f"{RESULTS}/{{sequence}}/object_track.h5",
    log:
        f"{LOGS}/{{sequence}}/object_track.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/object_track.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        **gpu_of("object_track"),
        mem_mb=memory("object_track"),
        runtime=duration("object_track"),
    params:
        identity=identity_of("object_track"),
    message:
        "{wildcards.sequence}: tracking the object"
    script:
        "../scripts/stage.py"
