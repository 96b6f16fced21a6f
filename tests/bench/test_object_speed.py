"""How tracker and baseline are compared: on a synthetic clip, and by which rules."""

from __future__ import annotations

import numpy as np
import pytest

from bench.object_baseline import Recipe
from bench.object_clip import ObjectClip
from bench.object_speed import (
    Run,
    compared_figures,
    one_pass,
    paper,
    print_compared,
    until,
    whole_track,
)
from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.view import View, ViewGeometry
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import ObjectCapture

FRAMES = 3


@pytest.fixture(scope="module")
def clip() -> ObjectClip:
    """The suitcase gliding 3 cm a frame before three cameras."""
    whole = ObjectMesh.load(catalogue()["suitcase"])
    mesh = whole.simplified(600)
    capture = ObjectCapture.make(mesh, FRAMES, cameras=3)
    geometry = [ViewGeometry.for_object(camera, mesh.diameter) for camera in capture.rig]
    views = [
        [View.build(seen, *capture.image(t, c)) for c, seen in enumerate(geometry)]
        for t in range(FRAMES)
    ]
    return ObjectClip(
        whole,
        mesh,
        views,
        capture.times,
        capture.master_from_room[:3, 2],
        np.full((FRAMES, 135, 3), np.nan),
        (capture.label,),
        ObjectTrackSettings(),
        capture.poses[:, :3, :3],
        capture.poses[:, :3, 3],
        np.full(FRAMES, 3),
    )


def test_the_start_is_off_as_an_annotation_is(clip: ObjectClip) -> None:
    millimetres, degrees = clip.errors(clip.annotated, 0)
    assert degrees == pytest.approx(5.0, abs=1e-6)
    # the shift is the origin's; the turn moves the centre of mass
    shift = clip.annotated[:3, 3] - clip.true_translation[0]
    assert 1e3 * np.linalg.norm(shift) == pytest.approx(10.0, abs=1e-6)
    assert millimetres < 60


def test_ours_and_the_baseline_track_the_same_clip(clip: ObjectClip) -> None:
    start = clip.annotated
    for run in (whole_track(clip, start), one_pass(clip, start)):
        assert run.lost == 0 and run.ms > 0
        assert run.translation_mm[0] < 4 and run.rotation_deg[0] < 0.6
    pytest.importorskip("deodr")
    recipe = Recipe(first_steps=50, steps=30, learning_rate_m=4e-3, learning_rate_rad=4e-3)
    run = paper(clip, start, recipe)
    assert run.lost == 0 and run.translation_mm[0] < 8 and run.rotation_deg[0] < 1.5


def _run(translation: float, p95: float = 5.0, lost: float = 0.0) -> Run:
    return Run(1.0, (translation, p95), (0.5, 1.0), lost)


def test_the_shortest_schedule_that_reaches_our_accuracy() -> None:
    ours, bad = _run(2.0), _run(9.0)
    near, good, best = _run(2.03), _run(1.5), _run(1.4)
    assert until(ours, [(5, bad), (20, bad), (20, near), (150, best)]) == (20, near, True)
    wide = _run(1.9, p95=7.0)  # the median alone does not count
    assert until(ours, [(20, wide), (40, good), (150, best)]) == (40, good, True)
    lost = _run(1.5, lost=0.1)
    assert until(ours, [(20, wide), (40, lost), (150, best)]) == (150, best, True)


def test_the_shortest_schedule_near_its_best_where_none_reaches_ours() -> None:
    found = [(5, _run(9.0)), (40, _run(3.1)), (75, _run(2.9, lost=0.2)), (150, _run(3.0))]
    assert until(_run(1.0), found) == (40, found[1][1], False)


def test_objects_count_by_their_frames(capsys: pytest.CaptureFixture[str]) -> None:
    def run(millimetres: float, frames: int, seconds: float) -> Run:
        return Run.of_errors(np.full((2, frames), millimetres), frames, seconds)

    found = {"cup": (run(2, 3, 0.3), run(60, 3, 6)), "stool": (run(3, 1, 0.1), run(1, 1, 2))}
    figures = compared_figures(found)
    assert figures["all_translation_median_mm"] == 2 and figures["cup.baseline_lost_share"] == 1
    assert figures["all_baseline_lost_share"] == 0.75 and figures["all_nearer_count"] == 1
    assert figures["all_ms_per_frame"] == pytest.approx(100)
    assert figures["all_speedup_recipe"] == pytest.approx(20)
    print_compared(found)
    assert "stool" in capsys.readouterr().out
