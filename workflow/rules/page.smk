rule page:
    """The sequence's page of the site."""
    input:
        unpack(artefacts_read("page")),
        object=ancient(object_files),
        body=ancient(body_file),
        truth=recorded("truth"),
        annotation=ancient(annotation_input),
        mark=out_of_date("page"),
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
        identity=identity_of("page"),
    message:
        "{wildcards.sequence}: drawing the page"
    script:
        "../scripts/stage.py"
