for _stage in STAGES.values():

    rule:
        """One stage of one sequence: a rule for each entry of `stage_list.STAGES`."""
        name:
            _stage.name
        input:
            unpack(inputs_of(_stage.name)),
            annotation=ancient(annotation_input),
            mark=out_of_date(_stage.name),
        output:
            output_of(_stage.name),
        log:
            f"{LOGS}/{{sequence}}/{_stage.name}.log",
        benchmark:
            f"{BENCHMARKS}/{{sequence}}/{_stage.name}.tsv"
        conda:
            ENVIRONMENT
        threads: threads_of(_stage.name)
        resources:
            **gpu_of(_stage.name),
            mem_mb=memory(_stage.name),
            runtime=duration(_stage.name),
        params:
            identity=identity_of(_stage.name),
            files=files_of(_stage.name),
        message:
            f"{{wildcards.sequence}}: {_stage.name} ({_stage.purpose})"
        script:
            "../scripts/stage.py"


rule broken_annotation:
    """Fails with the reason. A job of the run only if the sequence's annotation is invalid."""
    output:
        checked=f"{RESULTS}/{{sequence}}/annotation.checked",
    log:
        f"{LOGS}/{{sequence}}/annotation.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/annotation.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("annotation"),
        runtime=duration("annotation"),
    message:
        "{wildcards.sequence}: checking the annotation"
    script:
        "../scripts/annotation.py"
