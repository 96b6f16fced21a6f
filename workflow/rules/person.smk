rule person:
    """The subject over views, and the triangulated keypoints."""
    input:
        unpack(artefacts_read("person")),
        annotation=ancient(annotation_input),
        mark=out_of_date("person"),
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
        identity=identity_of("person"),
    message:
        "{wildcards.sequence}: finding the subject in all views"
    script:
        "../scripts/stage.py"
