"""The report's part on an object's track: the sheet of crops, states of track and views."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from intercap_core.geometry.camera.masks import encode
from intercap_core.output.site import track_section
from intercap_core.output.site.track_section import CANDIDATE_COLOUR, TRACK_COLOUR
from tests.helpers import fitted_capture as fitted

SETS = 4


@pytest.fixture(scope="module")
def made(
    captures: dict[str, fitted.Capture], tmp_path_factory: pytest.TempPathFactory
) -> fitted.Capture:
    found = captures["s01_o03"].copied(tmp_path_factory.mktemp("track"), "object_track")
    with found.edit("object_track") as file:
        file["lost"][...] = np.arange(SETS) == 1
        file["ambiguous"][...] = np.arange(SETS) == 2
        file["resting"][...] = np.arange(SETS) > 2
        file["recovered"][2] = True
        file["overlap"][...] = np.nan
        file["overlap"][:, 0] = np.linspace(0.5, 0.9, SETS)
        file["covariance"][...] = np.diag([1e-4] * 3 + [4e-6] * 3)
    return found


def _section(made: fitted.Capture, **instead: Path) -> dict[str, Any]:
    whole = encode(np.ones((270, 480), bool))
    kept = [whole, b"", b""]
    return track_section.read_track(
        replace(made.inputs("frames", "scene", "object_track"), **instead),
        made.mesh,
        lambda t, c: kept[c],
    )


def test_states_of_track_and_views(made: fitted.Capture) -> None:
    timeline = _section(made)["timeline"]
    assert re.findall(r'class="state (\w+)"', timeline)[:4] == [
        "moving", "lost", "doubtful", "resting",
    ]  # fmt: skip
    assert "1 lost · 1 doubtful · 1 resting" in timeline
    assert 'class="state partly"' in timeline and 'class="state agrees"' in timeline
    assert "2: found again" in timeline and "0 % used" in timeline


def test_the_largest_deviation_of_a_covariance() -> None:
    covariance = np.array([np.diag([1.0, 9.0, 4.0]), np.full((3, 3), np.nan)])
    np.testing.assert_array_equal(track_section._largest(covariance), [3.0, np.nan])


def test_carried_takes_precedence_over_doubtful() -> None:
    none, all_ = np.zeros(3, bool), np.ones(3, bool)
    found = track_section._states(
        gone=none, lost=np.arange(3) == 0, carried=np.arange(3) < 2, doubtful=all_, resting=none
    )
    assert found == ["lost", "carried", "doubtful"] and set(found) <= set(
        track_section.TRACK_STATES
    )


def test_the_sheet_shows_both_outlines_in_every_camera(made: fitted.Capture) -> None:
    sheet = _section(made)["sheet"]
    assert sheet is not None and sheet.caption.count(", ") == 4
    bgr = cv2.imdecode(np.frombuffer(sheet.content, np.uint8), cv2.IMREAD_COLOR)
    assert bgr.shape == (sheet.height, sheet.width, 3)
    columns = np.array_split(bgr[..., ::-1].astype(int), 3, axis=1)
    for column in columns:
        assert (np.abs(column - TRACK_COLOUR).max(-1) < 70).sum() > 100
    # a mask of the whole image has no rim inside a cell
    assert all((np.abs(c - CANDIDATE_COLOUR).max(-1) < 40).sum() < 400 for c in columns)


def test_unreadable_images_only_omit_the_sheet(made: fitted.Capture, tmp_path: Path) -> None:
    broken = tmp_path / "frames.h5"
    broken.write_bytes(b"no frames")
    section = _section(made, frames=broken)
    assert section["sheet"] is None and "frames.h5" in section["note"] and section["timeline"]
