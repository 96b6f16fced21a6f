_recordings = f"{RESULTS}/recordings/{{sequence}}"


rule studio:
    """Make one virtual recording whose truth is known; never matches a real recording.

    Its files depend on the layout: the manifest, written last, stands for all of them.
    """
    input:
        mark=out_of_date("studio"),
    output:
        truth=f"{_recordings}/truth.h5",
        manifest=f"{_recordings}/capture.json",
    log:
        f"{LOGS}/{{sequence}}/studio.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/studio.tsv"
    wildcard_constraints:
        sequence=one_of(VIRTUAL),
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("studio"),
        runtime=duration("studio"),
    params:
        identity=identity_of("studio"),
    message:
        "{wildcards.sequence}: making a virtual recording"
    script:
        "../scripts/studio.py"
