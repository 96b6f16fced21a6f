"""A second person: clear of the subject, visible to the cameras, not in the truth."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.studio.passer_by import PasserBy
from intercap_core.studio.stage import StudioStage
from tests.helpers.fitted_capture import object_entry

CAPTURE = StudioCapture(interaction="stool_sit", subject="s06", seed=5, frames=10, layout="plain")
SETTINGS = StudioSettings(captures={}, cameras=3, colour_mode="720P", fps=5)


def stage_with(passer_by: str) -> StudioStage:
    capture = CAPTURE.model_copy(update={"passer_by": passer_by})
    return StudioStage(capture, SETTINGS, object_entry("stool"))


@pytest.fixture(scope="module")
def stage() -> StudioStage:
    return stage_with("walks")


@pytest.fixture(scope="module")
def walker(stage: StudioStage) -> PasserBy:
    assert stage.passer_by is not None
    return stage.passer_by


def test_a_second_person_walks_past_without_contact(stage: StudioStage, walker: PasserBy) -> None:
    times = np.arange(0, stage.duration, 1 / 30)
    moment, passing = stage.at(times), walker.at(times)
    assert walker.subject.name != stage.subject.name and passing.present.all()
    apart = np.linalg.norm((passing.joints - moment.joints)[:, 0, :2], axis=1)
    assert PasserBy.passes_m[0] - 0.05 < apart.min() < PasserBy.passes_m[1] + 0.05
    points = stage.prop.vertices[::50]
    for t in range(0, len(times), 5):
        pose = moment.stage_from_object[t]
        at = points @ pose[:3, :3].T + pose[:3, 3]
        gap = np.linalg.norm(at[:, None] - passing.clothed[t][None, ::40], axis=2).min()
        assert gap > 0.1
    assert np.abs(passing.clothed[..., 2].min(1)).max() < 0.003
    pace = np.linalg.norm(np.diff(passing.joints[:, 0], axis=0), axis=1) * 30
    assert pace.min() > 0.8 and pace.max() < 2.2


def test_a_passer_by_leaves_the_recording_unchanged(stage: StudioStage) -> None:
    alone = stage_with("nobody")
    ours, theirs = (s.at(s.set_times[::4]) for s in (stage, alone))
    np.testing.assert_array_equal(ours.body, theirs.body)
    np.testing.assert_array_equal(ours.stage_from_object, theirs.stage_from_object)
    np.testing.assert_array_equal(stage.room.vertices, alone.room.vertices)
    np.testing.assert_array_equal(stage.rig.offset_s, alone.rig.offset_s)
