rule person:
    """The subject over views, and the triangulated keypoints."""
    input:
        **artefacts_read("person"),
        annotation=ancient(annotation_input("subject")),
    output:
        person=f"{RESULTS}/{{sequence}}/person.h5",
    log:
        f"{LOGS}/{{sequence}}/person.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/person.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("person"),
        runtime=duration("person"),
    params:
        settings=settings_of("person"),
        annotation=annotation_of("subject"),
        object=tracked_object,
        code=code_of("person"),
    message:
        "{wildcards.sequence}: finding the subject in all views"
    script:
        "../scripts/stage.py"
