for _stages, _sequences in jobs().items():

    rule:
        """One stage of one sequence, or consecutive stages that share a process.

        A rule for each entry of `stage_list.STAGES`, named after it, and for each group of stages
        that the setting `one_process` joins in this run, named after the first and the last.
        """
        name:
            rule_name(_stages)
        input:
            unpack(inputs_of(*_stages)),
            annotation=ancient(annotation_input),
            mark=out_of_date(*_stages),
        output:
            [output_of(stage) for stage in _stages],
        log:
            [f"{LOGS}/{{sequence}}/{stage}.log" for stage in _stages],
        benchmark:
            f"{BENCHMARKS}/{{sequence}}/{rule_name(_stages)}.tsv"
        wildcard_constraints:
            sequence=one_of(_sequences),
        conda:
            ENVIRONMENT
        threads: max(map(threads_of, _stages))
        resources:
            **gpu_of(_stages[0]),
            mem_mb=memory(*_stages),
            runtime=duration(*_stages),
        params:
            stages=_stages,
            identity=identity_of(*_stages),
            files=files_of(*_stages),
        message:
            f"{{wildcards.sequence}}: {', '.join(_stages)}"
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
