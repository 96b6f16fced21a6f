rule detections:
    """Keypoints and segmentation candidates, from files."""
    input:
        keypoints=recorded("keypoints"),
        candidates=recorded("candidates"),
        frames=rules.frames.output.frames,
    output:
        detections=f"{RESULTS}/{{sequence}}/detections.h5",
    log:
        f"{LOGS}/{{sequence}}/detections.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/detections.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory(1500),
        runtime=30,
    params:
        settings=settings_of("detections"),
        code=code_of("detections"),
    message:
        "{wildcards.sequence}: reading keypoints and candidates"
    script:
        "../scripts/stage.py"
