"""Charts and shaded pictures."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest
import trimesh

from intercap_core.evaluation.summary import SurfaceHeat
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.output.site import charts, drawing, heat_pictures, overlays


def test_ticks_are_round_and_inside() -> None:
    assert charts.ticks(0, 30) == [0, 5, 10, 15, 20, 25, 30]
    assert charts.ticks(0, 1) == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1])
    assert charts.ticks(0, 45, 8) == [0, 10, 20, 30, 40]


def test_charts_are_well_formed_xml() -> None:
    x = np.array([0.0, 1, 2])
    chart = charts.line_chart(
        [charts.Series("a < b", "c1", x, x)], ("x & y", 0, 2), ("y", 0, 2), marks=((1, "1"),)
    )
    line = charts.timeline([charts.TimelineRow("flag", [(0, 3, "fill flag", 'a "b" <c>')])], 10)
    for text in (chart, line):
        ElementTree.fromstring(text)
    points = ElementTree.fromstring(chart).find(".//polyline").get("points").split()
    first, last = ([float(v) for v in p.split(",")] for p in (points[0], points[-1]))
    assert first[0] < last[0] and first[1] > last[1]  # grows to the right and upwards
    assert chart == charts.line_chart(
        [charts.Series("a < b", "c1", x, x)], ("x & y", 0, 2), ("y", 0, 2), marks=((1, "1"),)
    )


def test_a_band_is_filled_to_its_level_in_every_frame() -> None:
    levels = np.array([0.0, 0.9, 0.9, 0.2, np.nan])
    row = charts.TimelineRow("hand", [(1, 2, "hover", "90 %")], levels=levels)
    found = ElementTree.fromstring(charts.timeline([row], 5))
    path = found.find(".//path").get("d")
    track = found.find(".//rect[@class='track']")
    left, wide, low = (float(track.get(key)) for key in ("x", "width", "height"))
    bottom = float(track.get("y")) + low
    steps = [tuple(map(float, step.split("V"))) for step in path.split("Z")[0].split("H")[1:]]
    heights = {round(5 * (x - left) / wide): (bottom - y) / low for x, y in steps[:-1]}
    assert heights == pytest.approx({0: 0, 1: 0.9, 3: 0.2, 4: 0}, abs=0.01)
    assert found.find(".//title").text == "1–2: 90 %"


def test_a_legend_that_is_too_long_takes_another_row() -> None:
    x = np.array([0.0, 1.0])
    lines = [charts.Series(f"a name of some length {i}", "c1", x, x) for i in range(3)]
    found = ElementTree.fromstring(charts.line_chart(lines, ("x", 0, 1), ("y", 0, 1)))
    width = float(found.get("viewBox").split()[2])
    places = [
        (float(t.get("x")), float(t.get("y"))) for t in found.findall(".//text[@class='legend']")
    ]
    assert len({y for _, y in places}) == 3
    assert all(x + 6 * len(lines[0].name) < width for x, _ in places)


def test_pictures_hide_what_is_behind_and_keep_colours() -> None:
    ball = trimesh.creation.icosphere(3, 0.3)
    lens = Intrinsics(120, 100, 100.0, 100.0, 59.5, 49.5)
    red, green = (np.tile(colour, (len(ball.vertices), 1)) for colour in ([1.0, 0, 0], [0, 1.0, 0]))
    place = np.eye(4)
    place[2, 3] = 2
    behind = place.copy()
    behind[:3, 3] = [0.25, 0, 3]
    picture = drawing.draw(
        [
            drawing.ColouredMesh(ball.vertices, ball.faces, behind, colours=green),
            drawing.ColouredMesh(ball.vertices, ball.faces, place, colours=red),
        ],
        lens,
    )
    middle = picture.rgb[49, 59]
    assert middle[0] > 0.3 and middle[1] == pytest.approx(0, abs=1e-6)
    assert picture.alpha[49, 59] == 1 and picture.alpha[2, 2] == 0
    assert (picture.rgb[..., 1] > 0.2).any()
    radius = np.sqrt((picture.rgb[..., 0] > 0).sum() / np.pi)
    assert radius == pytest.approx(100 * 0.3 / np.sqrt(2**2 - 0.3**2), abs=1.0)
    white = np.ones((100, 120, 3), np.float32)
    laid = picture.over(white, 0.5)
    assert laid[2, 2] == pytest.approx(1) and laid[49, 59, 1] == pytest.approx(0.5)


def test_frames_are_spread_and_hold_the_worst() -> None:
    residual = np.zeros(45)
    residual[7] = 1
    chosen = overlays.choose_frames(residual, 4)
    assert len(chosen) == 4 and 7 in chosen and chosen == sorted(chosen)
    assert len(overlays.choose_frames(np.full(45, np.nan), 4)) == 4
    assert overlays.choose_frames(residual[:3], 4) == [0, 1, 2]


def test_object_heat_shows_on_the_side_that_is_touched() -> None:
    ball = trimesh.creation.icosphere(2, 0.1)
    points = trimesh.creation.icosphere(4, 0.1).vertices
    side = np.array([0.8, -0.9, 0.5]) / np.linalg.norm([0.8, -0.9, 0.5])
    likelihood = (points @ side > 0.09).astype(float)
    heat = SurfaceHeat(points, likelihood, 10)
    one, other = heat_pictures.object_pictures(
        np.asarray(ball.vertices), np.asarray(ball.faces), heat, 1.0
    )
    seen, hidden = (
        cv2.imdecode(np.frombuffer(p.content, np.uint8), cv2.IMREAD_UNCHANGED).astype(int)
        for p in (one, other)
    )
    assert seen.shape == (one.height, one.width, 4)
    assert seen[2, 2, 3] == 0 and seen[one.height // 2, one.width // 2, 3] == 255
    red = seen[..., 2] - seen[..., 0]  # BGR
    assert red[one.height // 2, one.width // 2] > 40
    assert (hidden[..., 2] - hidden[..., 0]).max() < 25
