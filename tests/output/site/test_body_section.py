"""The report's part on a body's fit: the sheet of crops, states of fit and views, deviations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.output.site import body_section, charts
from intercap_core.output.site.body_section import FIT_COLOUR, KEYPOINT_COLOUR
from intercap_core.output.site.fit_section import SquareCrop
from tests.helpers import fitted_capture as fitted


@pytest.fixture(scope="module")
def made(
    captures: dict[str, fitted.Capture], tmp_path_factory: pytest.TempPathFactory
) -> fitted.Capture:
    found = captures["s01_o03"].copied(tmp_path_factory.mktemp("body"), "person", "body_fit")
    with found.edit("person") as person:
        person["keypoints"][...] = 0  # nobody sees any, but for
        person["keypoints"][:, 0, :25] = [240.0, 135.0, 0.9]  # the middle of the first camera
    with found.edit("body_fit") as fit:
        fit["failed"][1] = fit["bridged"][1] = True
        fit["joint_sigma"][1] = 0.04
        fit["joint_sigma"][:, 20] = 0.02  # the left wrist
        fit["keypoint_residual"][...] = np.array([1.9, 2.1, np.nan])  # of 270 rows
    return found


def _section(made: fitted.Capture, **instead: Path) -> dict[str, Any]:
    paths = replace(made.inputs("frames", "scene", "person", "body_fit"), **instead)
    return body_section.read_fit(paths, made.models)


def test_states_of_fit_and_views_and_deviations_by_joint(made: fitted.Capture) -> None:
    section = _section(made)
    timeline = section["timeline"]
    assert timeline.count('class="state moving"') == 2
    assert "1 interpolated" in timeline and timeline.count('class="state lost"') == 1
    # 8 px of 1080 rows are 2 px of 270
    assert timeline.count('class="state agrees"') == 1
    assert timeline.count('class="state partly"') == 1
    assert timeline.count('class="state nothing"') == 1
    assert "100 % visible · 1.9 px" in timeline and "0 % visible" in timeline
    (over_time,), by_joint = section["charts"], section["wide_chart"]
    assert "largest deviation of a joint" in over_time
    assert "left wrist" in by_joint and "20.0, up to 20.0" in by_joint
    assert "10.0, up to 40.0" in by_joint and "right fingers" in by_joint


def test_another_body_file_is_refused(made: fitted.Capture, tmp_path: Path) -> None:
    other = made.copied(tmp_path, "body_fit")
    with other.edit("body_fit") as fit:
        fit.attrs["body_model"] = "0123456789abcdef"
    with pytest.raises(UserError, match=r"body_fit\.h5: the bodies of .* with another body file"):
        _section(other)


def test_the_sheet_shows_fit_and_keypoints(made: fitted.Capture) -> None:
    sheet = _section(made)["sheet"]
    assert sheet is not None and ", 1, " in sheet.caption  # the frame with the largest deviation
    bgr = cv2.imdecode(np.frombuffer(sheet.content, np.uint8), cv2.IMREAD_COLOR)
    assert bgr.shape == (sheet.height, sheet.width, 3)
    first, *others = np.array_split(bgr[..., ::-1].astype(int), 3, axis=1)
    assert all((np.abs(c - FIT_COLOUR).max(-1) < 70).sum() > 100 for c in (first, *others))

    def dots(column: np.ndarray) -> int:
        return int((np.abs(column - KEYPOINT_COLOUR).max(-1) < 50).sum())

    assert dots(first) > 5 * 4 and all(dots(c) < 5 for c in others)


def test_unreadable_images_only_omit_the_sheet(made: fitted.Capture, tmp_path: Path) -> None:
    broken = tmp_path / "frames.h5"
    broken.write_bytes(b"no frames")
    section = _section(made, frames=broken)
    assert section["sheet"] is None and "frames.h5" in section["note"] and section["timeline"]


def test_a_body_that_no_camera_sees_is_not_drawn(made: fitted.Capture, tmp_path: Path) -> None:
    sunk = made.copied(tmp_path, "body_fit")
    with sunk.edit("body_fit") as fit:
        fit["transl"][:, 1] += 50.0  # far under the floor
    sheet = _section(sunk)["sheet"]
    assert sheet is not None
    bgr = cv2.imdecode(np.frombuffer(sheet.content, np.uint8), cv2.IMREAD_COLOR)
    assert (np.abs(bgr[..., ::-1].astype(int) - FIT_COLOUR).max(-1) < 70).sum() < 50


def test_a_crop_places_pixels_and_outlines_alike() -> None:
    crop = SquareCrop(10, 20, 40, 80)
    assert crop.to_cell(np.array([[10.0, 20.0], [49.0, 59.0]])).tolist() == [[0, 0], [78, 78]]
    cell = np.zeros((80, 80, 3), np.uint8)
    crop.outline(cell, np.ones((10, 10), bool), 20, 30, (255, 255, 255))
    rows, columns = np.nonzero(cell[..., 0])
    for at in (rows, columns):  # its rim is drawn softly
        assert 19 <= at.min() <= 20 and 39 <= at.max() <= 40
    outside = np.zeros((80, 80, 3), np.uint8)
    crop.outline(outside, np.ones((10, 10), bool), 200, 30, (255, 255, 255))
    assert not outside.any()


def test_bars_have_their_value_and_most() -> None:
    drawn = charts.bar_pairs([charts.BarPair("a & b", 2.0, 1.0, "1.0, up to 2")], "mm")
    assert "a &amp; b" in drawn and "1.0, up to 2" in drawn
    assert 'width="360.0"' in drawn and 'width="180.0"' in drawn
