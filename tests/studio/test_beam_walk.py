"""A person on a beam: feet truly stand on it, and nothing goes through it."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.evaluation.motion import Floor, support
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.studio.capture import support_height
from intercap_core.studio.interactions.alone import BeamWalk
from intercap_core.studio.stage import StudioStage

FPS, FLOOR = 15, Floor(np.array([0.0, 0.0, 1.0]), 0.0)


@pytest.fixture(scope="module", params=[("s03", 9001), ("s01", 9002), ("s12", 9003)])
def stage(request: pytest.FixtureRequest) -> StudioStage:
    subject, seed = request.param
    capture = StudioCapture(interaction="beam_walk", subject=subject, seed=seed, frames=45)
    return StudioStage(capture, StudioSettings(captures={}, fps=FPS), None)


def test_feet_stand_on_the_beam_and_on_the_floor(stage: StudioStage) -> None:
    moment = stage.at(stage.set_times)
    script = stage.interaction
    assert isinstance(script, BeamWalk)
    assert script.beam_height_m[0] <= script.height <= script.beam_height_m[1]
    (beam,) = script.furniture
    assert beam.high[1] - beam.low[1] == pytest.approx(2 * BeamWalk.beam_half_m)
    levels = support_height(stage, moment)
    np.testing.assert_allclose(levels[[0, -1]], 0.0, atol=1e-6)
    np.testing.assert_allclose(levels.max(0), script.height, atol=1e-6)
    clothed = stage.subject.on_fitted_topology(moment.clothed)
    for side, foot in enumerate(("left_foot", "right_foot")):
        carrying = support(clothed[:, stage.fitted.regions[foot]], FLOOR, FPS, levels[:, side])
        standing = carrying.any(1)
        on_beam = levels[1:, side] > script.height / 2
        assert standing[on_beam].mean() > 0.3 and standing[~on_beam].mean() > 0.3
    pelvis = moment.joints[:, 0, 2]
    middle = len(pelvis) // 2
    assert pelvis[middle] - pelvis[0] == pytest.approx(script.height, abs=0.05)


def test_nothing_goes_through_beam_or_floor(stage: StudioStage) -> None:
    points = stage.at(np.arange(0, 3, 1 / 30)).clothed
    points = apply(invert(stage.stage_from_script), points)
    (beam,) = stage.interaction.furniture
    inside = np.minimum(points - beam.low, np.array(beam.high) - points).min(-1)
    assert inside.max() < 0.001
    assert points[..., 2].min() > -0.001


def test_the_other_foot_is_passed_at_a_distance(stage: StudioStage) -> None:
    joints = stage.at(np.arange(0, 3, 1 / 30)).joints
    assert np.linalg.norm(joints[:, 7] - joints[:, 8], axis=1).min() > 0.11
    assert np.linalg.norm(joints[:, 4] - joints[:, 5], axis=1).min() > 0.13
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=2) * 30
    assert speed.max() < 4.5
