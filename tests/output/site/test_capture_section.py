"""The report's part on a capture: pictures, timeline, pairs and cameras, on good and bad rigs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.output.site import capture_section, charts
from intercap_core.output.site.capture_pictures import choose_set, floor_profiles
from intercap_core.output.site.drawing import EncodedImage, pinhole
from intercap_core.output.site.point_cloud import FusedCloud, Viewpoint, fuse, splat
from tests.helpers import fitted_capture as fitted
from tests.helpers.reduced_capture import Reduction

STAGES = ("frames", "scene")
WHEN = ("before", "after")


@pytest.fixture(scope="module")
def made(captures: dict[str, fitted.Capture]) -> fitted.Capture:
    return captures["s01_o03"]


@pytest.fixture(scope="module")
def facts(made: fitted.Capture) -> dict[str, Any]:
    return capture_section.read_capture(made.paths["frames"], made.paths["scene"])


def _decoded(picture: EncodedImage) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (picture.height, picture.width, 3)
    return image


def test_pictures_are_drawn_before_and_after_refinement(
    made: fitted.Capture, facts: dict[str, Any]
) -> None:
    pictures = facts["pictures"]
    assert [p.caption for p in pictures[0]] == [f"front, {w} refinement" for w in WHEN]
    before, after = (_decoded(picture).astype(int) for picture in pictures[0])
    assert np.abs(before - after).max() > 60
    again = capture_section.read_capture(made.paths["frames"], made.paths["scene"])["pictures"]
    assert [p.content for row in again for p in row] == [p.content for row in pictures for p in row]
    blue, green, red = cv2.split(after)
    person = (red - blue > 60) & (red - green > 40)  # red in the recorded images, all else is grey
    assert person.sum() > 5000 and np.ptp(np.nonzero(person)[0]) > 150


def test_facts_of_cameras_and_pairs(facts: dict[str, Any]) -> None:
    assert [row["moved"] for row in facts["cameras"]] == pytest.approx([0, 12, 0], abs=1e-3)
    assert [row["turned"] for row in facts["cameras"]] == pytest.approx([0, 0, 0], abs=1e-4)
    places = [facts["pairs"][0][1].index(f">{pair}<") for pair in ("k1–k2", "k2–k3", "k3–k1")]
    assert places == sorted(places)
    assert "1,000 supporting points" in facts["ground"] and "4.0 mm" in facts["ground"]


def test_a_depth_bias_has_its_deviation(made: fitted.Capture, tmp_path: Path) -> None:
    changed = made.copied(tmp_path, "scene")
    with changed.edit("scene") as file:
        file["depth_bias"][...] = [0.0021, -0.004, 0.001]
        covariance = np.zeros((3, 7, 3, 7))
        covariance[0, 6, 0, 6], covariance[1, 6, 1, 6] = 0.0003**2, 0.0012**2
        covariance[2, 3:6, 2, 3:6] = 1e-6 * np.eye(3)  # of the pose alone
        file["camera_covariance"][...] = covariance
    paths = changed.paths["frames"], changed.paths["scene"]
    rows = capture_section.read_capture(*paths)["cameras"]
    assert [row["bias"] for row in rows] == ["2.1 ± 0.3", "-4.0 ± 1.2", "1.0"]
    with changed.edit("scene") as file:
        file["depth_size"][2] = 0
    assert capture_section.read_capture(*paths)["cameras"][2]["bias"] == ""


REDUCTIONS = {
    "one set of one camera": Reduction(cameras={"k1"}, sets=1),
    "no depth at all": Reduction(depth=()),
    "depth of one camera": Reduction(depth={"k2"}),
    "a camera without any image, one that dies": Reduction(images_until={"k3": 0, "k2": 2}),
}


@pytest.mark.parametrize("name", REDUCTIONS)
def test_any_rig_has_its_page(made: fitted.Capture, name: str, tmp_path: Path) -> None:
    paths = REDUCTIONS[name].apply({s: made.paths[s] for s in STAGES}, tmp_path)
    facts = capture_section.read_capture(paths["frames"], paths["scene"])
    assert facts["note"] == ""
    assert facts["pictures"]
    assert all(_decoded(p).std() > 1 for row in facts["pictures"] for p in row)
    assert len(facts["cameras"]) == (1 if REDUCTIONS[name].cameras else 3)
    assert "nan" not in facts["timeline"] and "nan" not in str(facts["pairs"])
    if REDUCTIONS[name].cameras:
        captions = [p.caption for row in facts["pictures"] for p in row]
        assert captions == ["front", "other side, from above"]
    if REDUCTIONS[name].images_until:
        assert facts["cameras"][2]["recorded"] == 0 and "no image" in facts["timeline"]


def test_states_of_a_cameras_frames() -> None:
    colour = np.array([1, 1, 0, 0, 1, 1], bool)
    depth = np.array([1, 0, 1, 0, 1, 0], bool)
    slip = np.array([0, 0, 0, 0, 2, 0])
    dropped = np.array([0, 0, 0, 0, 0, 1], bool)
    states = capture_section.camera_states(colour, depth, slip, dropped)
    assert states == ["recorded", "part", "part", "missing", "slipped", "dropped"]
    without = capture_section.camera_states(colour, 0 * colour > 0, 0 * slip, dropped)
    assert without == ["recorded", "recorded", "missing", "missing", "recorded", "dropped"]


def test_the_timeline_states_how_late_slipped_images_are(
    made: fitted.Capture, tmp_path: Path
) -> None:
    late = made.copied(tmp_path, *STAGES)
    with late.edit("scene") as file:
        file["slip"][:, 1] = [2, 2, 1, 0]
    with late.edit("frames") as file:
        file["colour_index"][3, 1] = file["depth_index"][3, 1] = -1
    drawn = capture_section.read_capture(late.paths["frames"], late.paths["scene"])["timeline"]
    assert "0–1: shows an earlier frame (images lost), 2 frames before" in drawn
    assert "2: shows an earlier frame (images lost), 1 frame before" in drawn
    assert "3 earlier by 1 or 2" in drawn and "1 missing" in drawn


def test_gaps_between_sets() -> None:
    assert capture_section.gaps(np.array([0, 1, 2, 5, 6]) / 15, 15) == [(2, 2)]
    assert capture_section.gaps(np.zeros(1), 15) == []


def test_names_and_notes_are_escaped(made: fitted.Capture, tmp_path: Path) -> None:
    row = charts.TimelineRow("<b>k1</b>", [(0, 1, "state recorded", "<i>")], "<u>")
    drawn = charts.timeline([row], 2, [(0, "<s>")])
    change = charts.BarPair.change("<b>", 1.0, float("nan"), "<i>", True)
    pair = charts.bar_pairs([change], "<u>")
    for text in (drawn, pair):
        assert not re.search(r"<[bius]>", text)
        assert "nan" not in text


def test_the_set_with_most_cameras_is_drawn() -> None:
    class Images:
        depth_available = np.array([[1, 1], [0, 1], [1, 1], [1, 1], [0, 0]], bool)
        colour_available = depth_available

    assert choose_set(Images()) == 2  # type: ignore[arg-type]


def _wall(z: float, camera: int = 0) -> FusedCloud:
    x, y = np.meshgrid(np.linspace(-1, 1, 200), np.linspace(-1, 1, 200))
    points = np.stack([np.full(x.size, z), x.ravel(), y.ravel()], 1).astype(np.float32)
    normals = np.tile(np.float32([1, 0, 0]), (x.size, 1))
    colours = np.full((x.size, 3), 0.25 + 0.5 * camera, np.float32)
    return FusedCloud(points, normals, colours, np.full(x.size, camera, np.int32))


def _both(first: FusedCloud, second: FusedCloud) -> FusedCloud:
    parts = zip(vars(first).values(), vars(second).values(), strict=True)
    return FusedCloud(*(np.concatenate(pair) for pair in parts))


def test_near_points_occlude_far_points() -> None:
    view = Viewpoint.towards(np.zeros(3), 0.0, 0.0, 4.0, pinhole(60, 60, 100.0))
    cloud = _both(_wall(0.0), _wall(1.0, camera=1))
    picture, depth = splat(cloud, view)
    assert depth[30, 30] == pytest.approx(3.0) and picture[30, 30, 0] == pytest.approx(0.75)
    assert depth[15:45, 15:45].max() == pytest.approx(3.0)  # no holes
    behind = Viewpoint.towards(np.zeros(3), np.pi, 0.0, 4.0, pinhole(60, 60, 100.0))
    assert np.isinf(splat(_wall(0.0), behind)[1]).all()


def test_a_point_is_drawn_where_the_view_projects_it() -> None:
    view = Viewpoint.towards(np.array([0, 0, 1.0]), np.pi / 2, 0.0, 5.0, pinhole(101, 101, 100.0))
    at, z = view.project(np.array([[0, 0, 1.0], [-1, 0, 1], [0, 0, 2]]))
    assert z == pytest.approx([5, 5, 5])
    assert at == pytest.approx(np.array([[50, 50], [70, 50], [50, 30]]))  # x to the left, z up
    assert view.eye == pytest.approx([0, 5, 1])


def test_fusing_applies_poses_and_depth_bias() -> None:
    from intercap_core.output.site.point_cloud import CameraPoints

    lens = Intrinsics(10, 10, 10.0, 10.0, 4.5, 4.5)
    pose = np.eye(4)
    pose[0, 3] = 1.0
    rig = Rig((Camera("k1", lens, lens, np.eye(4), pose),))
    rays = np.float32([[0, 0, 1], [0.5, 0, 1]])
    points = CameraPoints(0, 2 * rays, -rays, rays, np.zeros((2, 3), np.float32))
    cloud = fuse([points], rig, np.eye(4), np.array([0.1]))
    assert cloud.points == pytest.approx(np.array([[1, 0, 1.9], [1.95, 0, 1.9]]))


def test_floor_profiles_are_median_heights_by_camera() -> None:
    x, y = np.meshgrid(np.linspace(-1, 1, 400), np.linspace(-0.1, 0.1, 9))
    points = np.stack([x.ravel(), y.ravel(), 0.01 * x.ravel()], 1).astype(np.float32)
    up = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    camera = np.zeros(len(points), np.int32)
    (profile,) = floor_profiles(FusedCloud(points, up, up, camera), np.zeros(2))
    assert profile.y == pytest.approx(10 * profile.x, abs=0.3)  # mm
    assert not floor_profiles(FusedCloud(points, -up, up, camera), np.zeros(2))


def test_floor_profiles_avoid_objects() -> None:
    x, y = np.meshgrid(np.linspace(-1, 1, 200), np.linspace(-0.8, 0.8, 65))
    box = (np.abs(x) < 0.2) & (np.abs(y) < 0.1)
    z = np.where(box, 0.07, 0)
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], 1).astype(np.float32)
    leg = np.float32([[0, 0, 0.2]])
    up = np.tile(np.float32([0, 0, 1]), (len(points) + 1, 1))
    cloud = FusedCloud(np.concatenate([points, leg]), up, up, np.zeros(len(up), np.int32))
    (profile,) = floor_profiles(cloud, np.zeros(2))
    assert profile.y == pytest.approx(0 * profile.x)
