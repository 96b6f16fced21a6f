"""What jobs ask of a scheduler: more for more, more with every attempt, whatever a user raises."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from intercap_core.config import FramesSettings
from intercap_core.errors import UserError
from intercap_core.pipeline.resources import (
    CUDA_MB,
    IMAGES_MB,
    JOBS,
    LEAST_MINUTES,
    disk_usage,
    extent_of,
    memory_mb,
    minutes,
    on_gpu,
    recorded_mb,
    total_extent,
)
from intercap_core.project import Project, load_project
from intercap_core.stage_list import STAGES, Extent
from intercap_core.stages import frames
from tests.conftest import PROJECT_ROOT
from tests.helpers.plain_capture import CAMERAS, plain_entry, write_rig

SHORT, LONG, FEW = Extent(45, 6), Extent(1000, 6), Extent(1000, 2)
# Largest resident set of the stage's process, MB: frames, cameras, measured.
MEASURED = [
    ("frames", 45, 6, 160), ("frames", 45, 12, 143),
    ("detections", 45, 2, 226), ("detections", 45, 12, 231),
    ("person", 45, 2, 564), ("person", 45, 12, 770), ("person", 300, 6, 748),
    ("person", 1000, 6, 788),
    ("scene", 45, 2, 339), ("scene", 45, 12, 597), ("scene", 300, 6, 541), ("scene", 1000, 6, 668),
    ("object_track", 45, 3, 407), ("object_track", 45, 12, 645), ("object_track", 300, 6, 905),
    ("object_track", 1000, 6, 974),
    ("body_fit", 45, 2, 605), ("body_fit", 45, 12, 724), ("body_fit", 300, 6, 753),
    ("body_fit", 1000, 6, 895), ("body_fit", 1200, 6, 1021),
    ("joint", 45, 2, 752), ("joint", 45, 12, 1046), ("joint", 300, 6, 1628),
    ("joint", 1200, 6, 2239),
    ("metrics", 45, 2, 797), ("metrics", 45, 12, 1186), ("metrics", 300, 6, 1978),
    ("metrics", 1000, 6, 2179),
    ("summary", 45, 2, 393), ("summary", 45, 12, 393), ("summary", 300, 6, 383),
    ("page", 45, 2, 823), ("page", 45, 12, 901), ("page", 300, 6, 971),
    ("page", 1200, 6, 1341),
    ("export", 45, 2, 591), ("export", 45, 12, 748),
]  # fmt: skip


def project(**settings: object) -> Project:
    return load_project(PROJECT_ROOT / "config" / "test" / "config.yaml", settings)


@pytest.mark.parametrize(("stage", "frames", "cameras", "peak"), MEASURED)
def test_requests_exceed_the_measured_memory(
    stage: str, frames: int, cameras: int, peak: int
) -> None:
    asked = memory_mb(project(), stage, Extent(frames, cameras))
    assert 1.25 * peak + 230 < asked < 2.5 * peak + 500


@pytest.mark.parametrize("stage", [*STAGES, "dataset"])
def test_requests_grow_with_length_and_attempt(stage: str) -> None:
    tiny = project()
    for ask, named in ((memory_mb, stage), (minutes, [stage])):
        assert ask(tiny, named, SHORT) <= ask(tiny, named, FEW) <= ask(tiny, named, LONG)
        first = ask(tiny, named, LONG)
        assert ask(tiny, named, LONG, 3) == 3 * first


def test_scaled_memory_grows_with_attempts() -> None:
    raised = project(cluster={"memory_scale": {"joint": 2, "all": 1.5}, "time_scale": {"joint": 3}})
    for stage, times in (("joint", 2), ("metrics", 1.5)):
        for attempt in (1, 2, 3):
            asked = memory_mb(raised, stage, LONG, attempt)
            assert asked == pytest.approx(times * memory_mb(project(), stage, LONG, attempt), abs=3)
    assert minutes(raised, ["joint"], LONG) == pytest.approx(
        3 * minutes(project(), ["joint"], LONG), abs=3
    )
    assert minutes(raised, ["metrics"], LONG) == minutes(project(), ["metrics"], LONG)
    both = minutes(raised, ["joint", "metrics"], LONG)
    assert both == pytest.approx(
        minutes(raised, ["joint"], LONG) + minutes(raised, ["metrics"], LONG) - LEAST_MINUTES, abs=2
    )


def test_detectors_run_on_a_gpu_if_the_settings_say_so(tmp_path: Path) -> None:
    model = tmp_path / "model.onnx"
    model.touch()
    on_cpu = project(detections={"keypoint_model": str(model)})
    on_cuda = project(detections={"keypoint_model": str(model), "keypoint_device": "cuda"})
    assert {stage for stage in JOBS if on_gpu(on_cuda, stage)} == {"detections"}
    assert not any(on_gpu(on_cpu, stage) for stage in JOBS)
    # without a model nothing runs on it
    assert not on_gpu(project(detections={"keypoint_device": "cuda"}), "detections")
    for stage in JOBS:
        more = memory_mb(on_cuda, stage, SHORT) - memory_mb(on_cpu, stage, SHORT)
        assert more == (CUDA_MB if stage == "detections" else 0)


def test_exported_images_take_time_and_memory() -> None:
    plain = project()
    for name in ("images", "undistort"):
        more = project(export={name: True})
        assert memory_mb(more, "export", LONG) == memory_mb(plain, "export", LONG) + IMAGES_MB
        assert minutes(more, ["export"], LONG) > minutes(plain, ["export"], LONG) + 100
        assert minutes(more, ["joint"], LONG) == minutes(plain, ["joint"], LONG)


def test_disk_space_counts_images_of_exports_once(tmp_path: Path) -> None:
    given = [project(), project(export={"images": True})]
    moved = [p.config.model_copy(update={"results": tmp_path}) for p in given]
    plain, tiny = (replace(p, config=c) for p, c in zip(given, moved, strict=True))
    more = disk_usage(tiny)
    less = disk_usage(plain)
    added = more.per_output["export"] - less.per_output["export"]
    assert added == less.per_output["frames"] > 0 and more.missing > less.missing
    folder = tiny.artefact(next(iter(tiny.sequences)), "export")
    (folder / "bop").mkdir(parents=True)
    (folder / "bop" / "1.jpg").write_bytes(b"0" * 1000)
    (folder / "1.jpg").hardlink_to(folder / "bop" / "1.jpg")
    assert disk_usage(tiny).per_output["export"] == 1000


def test_sequences_together_have_all_frames() -> None:
    assert total_extent([SHORT, LONG, FEW]) == Extent(2045, 6)
    assert total_extent([]) == Extent(0, 0)


def test_virtual_recordings_have_the_extent_of_their_settings() -> None:
    assert extent_of(project(), "cup_drink_s04") == Extent(6, 3)


def test_the_extent_of_frames_that_are_read_is_theirs(tmp_path: Path) -> None:
    write_rig(tmp_path, (8, 6), 5.0)
    for number, name in itertools.product(range(4), CAMERAS):
        image = np.full((6, 8, 3), 40 * number, np.uint8)
        cv2.imwrite(str(tmp_path / "recordings" / name / f"{number}.png"), image)
    frames.run(sequence=plain_entry(tmp_path), output=tmp_path / "f.h5", settings=FramesSettings())
    read = SimpleNamespace(artefact=lambda sequence, stage: tmp_path / "f.h5")
    assert extent_of(read, "s1") == Extent(4, 2)


def test_recorded_megabytes_count_videos(tmp_path: Path) -> None:
    assert recorded_mb(tmp_path / "missing") == 0
    for name in ("k1.mkv", "k2.mkv", "notes.txt"):
        (tmp_path / name).write_bytes(b"0" * 500_000)
    assert recorded_mb(tmp_path) == 1.0
    tiny = project()
    assert minutes(tiny, ["frames"], SHORT, read_mb=40_000) > 60 + minutes(tiny, ["frames"], SHORT)


def test_a_factor_of_no_stage_is_refused() -> None:
    with pytest.raises(UserError, match="'jiont' is no stage; expected one of all, studio, frames"):
        project(cluster={"memory_scale": {"jiont": 2}})
