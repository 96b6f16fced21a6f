rule page:
    """The sequence's page of the site."""
    input:
        **artefacts_read("page"),
        object=object_files,
        body=body_file,
        truth=recorded("truth"),
        annotation=ancient(annotation_input("contact")),
    output:
        folder=report(
            directory(f"{RESULTS}/site/sequences/{{sequence}}"),
            htmlindex="index.html",
            category="Sequences",
            labels={"sequence": "{sequence}"},
        ),
    log:
        f"{LOGS}/{{sequence}}/page.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/page.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("page"),
        runtime=duration("page"),
    params:
        settings=settings_of("page"),
        annotation=annotation_of("contact"),
        object=tracked_object,
        subject=tracked_subject,
        intent=intent_of,
        code=code_of("page"),
    message:
        "{wildcards.sequence}: drawing the page"
    script:
        "../scripts/stage.py"
