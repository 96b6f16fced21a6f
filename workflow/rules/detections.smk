# Files that the settings name for all sequences: models and class names.
DETECTORS = [
    path
    for path in (
        SETTINGS.detections.segmentation_model,
        SETTINGS.detections.keypoint_model,
        SETTINGS.detections.segmentation_labels,
        SETTINGS.detections.category_names,
    )
    if isinstance(path, Path)
]
MODEL_THREADS = 8


rule detections:
    """Keypoints and segmentation candidates, from files or from a model."""
    input:
        unpack(artefacts_read("detections")),
        keypoints=recorded("keypoints"),
        candidates=recorded("candidates"),
        detectors=ancient(existing(*DETECTORS)),
        mark=out_of_date("detections"),
    output:
        detections=f"{RESULTS}/{{sequence}}/detections.h5",
    log:
        f"{LOGS}/{{sequence}}/detections.log",
    benchmark:
        f"{BENCHMARKS}/{{sequence}}/detections.tsv"
    conda:
        ENVIRONMENT
    threads: MODEL_THREADS if has_model(PROJECT) else 1
    resources:
        **gpu_of("detections"),
        mem_mb=memory("detections"),
        runtime=duration("detections"),
    params:
        identity=identity_of("detections"),
    message:
        "{wildcards.sequence}: reading keypoints and candidates"
    script:
        "../scripts/stage.py"
