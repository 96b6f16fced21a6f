"""Heavy shoes: flat soles carry the person, leather is round the feet, the truth is bare."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from intercap_core.config import ObjectEntry, StudioCapture, StudioSettings
from intercap_core.errors import UserError
from intercap_core.evaluation.motion import support
from intercap_core.evaluation.truth import Truth
from intercap_core.studio.capture import make_capture
from intercap_core.studio.stage import StudioStage, check_capture
from intercap_core.studio.subjects import (
    FEET,
    LEATHER_M,
    SOLE_M,
    Subject,
    in_heavy_shoes,
    shoe_area,
    subject_names,
)

Entry = Callable[[str], ObjectEntry]
SETTINGS = StudioSettings(captures={}, cameras=1, colour_mode="720P")


@pytest.mark.parametrize("name", subject_names())
def test_soles_are_flat_and_leather_is_as_thick_as_stated(name: str) -> None:
    bare = Subject.load(name)
    shod = in_heavy_shoes(bare, np.random.default_rng(3))
    np.testing.assert_array_equal(shod.rest, bare.rest)
    away = ~shoe_area(bare)
    np.testing.assert_array_equal(shod.clothing[away], bare.clothing[away])
    normals = bare.normals(bare.rest[None])[0]
    for foot in FEET:
        own = shoe_area(bare) & (np.asarray(bare.weights[:, foot].sum(1)).ravel() > 0.5)
        ground = bare.rest[own, 1].min() - SOLE_M
        assert shod.rest_clothed[own, 1].min() == pytest.approx(ground, abs=1e-4)
        under = own & (normals[:, 1] < -0.9)
        assert np.percentile(shod.rest_clothed[under, 1] - ground, 90) < 0.001
        level = own & (np.abs(normals[:, 1]) < 0.2) & (bare.rest[:, 1] < ground + SOLE_M + 0.03)
        thick = shod.clothing[level]
        assert LEATHER_M[0] <= thick.min() and thick.max() <= LEATHER_M[1]


def test_a_person_stands_on_the_soles(object_entry: Entry) -> None:
    lowest = {}
    for shoes in ("plain", "heavy"):
        capture = StudioCapture(
            interaction="suitcase_carry", subject="s06", seed=11, frames=20, shoes=shoes
        )
        stage = StudioStage(capture, SETTINGS, object_entry("suitcase"))
        moment = stage.at(stage.set_times[::2])
        lowest[shoes] = [part[..., 2].min(1) for part in (moment.body, moment.clothed)]
    for shoes in lowest:
        assert np.abs(lowest[shoes][1]).max() < 0.001
    assert np.abs(lowest["heavy"][0] - SOLE_M).max() < 0.001


def test_metrics_know_that_a_foot_in_its_shoe_stands(tmp_path: Path, object_entry: Entry) -> None:
    capture = StudioCapture(
        interaction="stool_sit", subject="s06", seed=7, frames=2, shoes="heavy", room="bare"
    )
    folder = tmp_path / "shod"
    make_capture(capture, SETTINGS, sequence="shod", objects=object_entry("stool"), output=folder)
    corresponding = len(Subject.load("s06").fitted_face)
    truth = Truth.load(folder / "truth.h5", np.arange(2) / 15, 15, corresponding)
    assert truth.vertices is not None
    height = truth.floor.height(truth.vertices)
    assert abs(height.min()) < 0.001
    standing = truth.vertices[:, height.max(0) < 0.01]
    still = np.repeat(standing[:1], 2, 0)
    assert support(still, truth.floor, 15).all()


@pytest.mark.parametrize(
    ("interaction", "thing"), [("football_kick", "football"), ("skateboard_ride", "skateboard")]
)
def test_bare_soles_that_meet_the_object_have_no_shoes(interaction: str, thing: str) -> None:
    capture = StudioCapture(interaction=interaction, subject="s06", seed=7, shoes="heavy")
    with pytest.raises(UserError, match="bare soles meet the object"):
        check_capture(capture, SETTINGS, thing)
