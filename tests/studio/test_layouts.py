"""Each layout, written by the studio and read by the program's own readers; aligned depth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.config import FramesSettings, StudioCapture, StudioSettings
from intercap_core.config_types import LayoutName
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.layouts import open_layout
from intercap_core.formats.recordings.source import Image
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.schemas import FRAMES
from intercap_core.stages import frames
from intercap_core.studio.capture_folder import Device, DeviceFrame
from intercap_core.studio.layouts import FOLDERS, camera_names
from intercap_core.studio.render import Aligner
from intercap_core.studio.rig import StudioRig, build_rig
from tests.helpers.synthetic_capture import FURNITURE, ring, room_depth

FPS, SETS = 15, (0, 1, 4)
LAYOUTS = get_args(LayoutName)
SETTINGS = FramesSettings()
COMPARED = (
    "master_from_colour", "colour_from_depth", "colour_intrinsics", "colour_distortion",
    "colour_size", "depth_intrinsics", "depth_distortion", "depth_size", "present", "truncated",
    "times", "colour_index", "depth_index", "skew", "gravity",
)  # fmt: skip


def rig_of(layout: LayoutName, cameras: int = 3) -> StudioRig:
    capture = StudioCapture(interaction="stool_sit", subject="s01", seed=1, frames=6)
    settings = StudioSettings(captures={}, cameras=cameras, colour_mode="720P")
    names = camera_names(layout, cameras)
    return build_rig(np.random.default_rng(4), capture, settings, names)


def write(folder: Path, layout: LayoutName, faults: tuple[str, ...] = (),
          broken: dict[str, int] | None = None, cameras: int = 3, video: bool = False,
          sets: Iterable[int] = SETS) -> tuple[StudioRig, bytes, np.ndarray]:  # fmt: skip
    """A recording of a grey wall, two metres before every depth camera."""
    rig = rig_of(layout, cameras)
    jpeg = cv2.imencode(".jpg", np.full((720, 1280, 3), 90, np.uint8))[1].tobytes()
    depth = np.full((576, 640), 2000, np.uint16)
    capture = StudioCapture(
        interaction="cup_drink", subject="s01", seed=1, layout=layout, faults=faults, video=video
    )
    place = FOLDERS[layout](folder, capture, broken or {})
    for index, camera in enumerate(rig.claimed):
        device = Device(index, camera, f"{index}", "720P", "NFOV_UNBINNED", True, FPS, 1_000_000)
        with place.open(device) as files:
            for t in sets:
                time_us = 1_000_000 + round(t * 1e6 / FPS) + 160 * index
                samples = [(np.array([-1.5, 0.5, -9.6]), np.zeros(3), time_us)]
                files.write(DeviceFrame(t, time_us, jpeg, depth if t else None, samples))
    place.write_calibration(rig.claimed, FPS)
    return rig, jpeg, depth


def row_of(folder: Path, layout: LayoutName) -> SequenceEntry:
    calibration = folder / FOLDERS[layout].calibration
    return SequenceEntry(
        sequence="one", subject="p", object="cup", recordings=folder, layout=layout,
        calibration=calibration,
    )  # fmt: skip


def test_a_bag_gives_the_frames_artefact_of_a_kinect_file(tmp_path: Path) -> None:
    """Equal images, times, sets, poses, lenses; the bag lacks the lens's limit."""
    written = {}
    for layout in ("k4a", "ros"):
        (tmp_path / layout).mkdir()
        write(tmp_path / layout, layout, sets=range(6))
        path = tmp_path / f"{layout}.h5"
        frames.run(sequence=row_of(tmp_path / layout, layout), output=path, settings=SETTINGS)
        with artefacts.read(path, FRAMES) as artefact:
            assert artefact.attributes["fps"] == pytest.approx(FPS, rel=1e-4)
            written[layout] = {key: artefact[key] for key in COMPARED}
            for name in artefact.text("camera_names"):
                for key in ("colour", "colour_offsets", "colour_time", "depth", "depth_time"):
                    key = f"cameras/{name}/{key}"
                    written[layout][key] = artefact[key]
    for key, of_kinect in written["k4a"].items():
        exact = of_kinect.dtype.kind in "iub"
        # inertial samples of a Kinect's file are of single precision
        tolerance = 0 if exact else 1e-6 if key == "gravity" else 1e-9
        assert exact or np.isfinite(of_kinect).all()
        np.testing.assert_allclose(written["ros"][key], of_kinect, atol=tolerance, err_msg=key)
    assert (written["ros"]["depth_index"] >= 0).sum() == 15


def images_of(folder: Path, layout: LayoutName, name: str) -> tuple[Camera, list[Image]]:
    with open_layout(row_of(folder, layout)).open(name) as recording:
        return recording.camera, list(recording.images())


@pytest.mark.parametrize(
    ("layout", "video"), [*((layout, False) for layout in LAYOUTS), ("plain", True)]
)
def test_recordings_are_read_as_written(tmp_path: Path, layout: LayoutName, video: bool) -> None:
    rig, jpeg, depth = write(tmp_path, layout, video=video)
    found = open_layout(row_of(tmp_path, layout))
    assert found.extrinsics.master == rig.claimed.names[0]
    assert sorted(found.names) == sorted(rig.claimed.names)
    for claimed in rig.claimed:
        camera, images = images_of(tmp_path, layout, claimed.name)
        np.testing.assert_allclose(
            found.extrinsics.master_from_colour[claimed.name], claimed.master_from_colour, atol=1e-9
        )
        points = np.array([[0.1, 0.2, 1.0], [-0.5, 0.3, 1.4], [0.8, -0.4, 1.2]])
        np.testing.assert_allclose(
            camera.colour.project(points), claimed.colour.project(points), atol=1e-6
        )
        colour = [image for image in images if image.kind == "colour"]
        assert [image.content for image in colour] == [jpeg] * len(SETS)
        times = np.array([image.time_us for image in colour])
        np.testing.assert_allclose(np.diff(times) / 1e6, np.diff(SETS) / FPS, atol=1e-3)
        depths = [image for image in images if image.kind == "depth"]
        assert [image.time_us for image in depths] == times[1:].tolist()
        assert camera.depth is not None and camera.colour_from_depth is not None
        if layout in ("k4a", "ros", "plain"):
            assert all(np.array_equal(image.content, depth) for image in depths)
            np.testing.assert_allclose(camera.colour_from_depth, claimed.colour_from_depth)
        else:
            assert depths[0].content.shape == (720, 1280)  # type: ignore[union-attr]
            assert np.array_equal(camera.colour_from_depth, np.eye(4))


def wall_seen_in_colour(camera: Camera, distance: float) -> np.ndarray:
    """z (Hc, Wc) in the colour camera of the plane z = ``distance`` of its depth camera."""
    assert camera.colour_from_depth is not None
    depth_from_colour = invert(camera.colour_from_depth)
    rays = np.dstack([camera.colour.rays, np.ones(camera.colour.rays.shape[:2])])
    normal, offset = depth_from_colour[2, :3], distance - depth_from_colour[2, 3]
    return offset / (rays @ normal)


def test_depth_unseen_by_the_depth_camera_is_empty() -> None:
    """A card before a wall: a strip of the wall next to it has no depth, the card is whole."""
    camera = rig_of("intercap").claimed[1]
    assert camera.depth is not None and camera.colour_from_depth is not None
    depth = np.full((576, 640), 2500, np.uint16)
    depth[200:380, 250:400] = 900
    aligned = Aligner(camera).align(depth)
    card, wall = (wall_seen_in_colour(camera, z) * 1000 for z in (0.9, 2.5))
    on_card = (aligned > 0) & (np.abs(aligned - card) < 1)
    on_wall = (aligned > 0) & (np.abs(aligned - wall) < 1)
    assert (on_card | on_wall | (aligned == 0)).all()
    assert on_wall[150:190, 400:880].all()
    corners = np.array([[250, 200], [399, 379]])
    at = camera.colour.project(
        apply(camera.colour_from_depth, camera.depth.unproject(corners) * 0.9)
    )
    (left, top), (right, bottom) = at.round().astype(int)
    assert on_card[top + 3 : bottom - 3, left + 3 : right - 3].all()
    middle = (top + bottom) // 2
    strip = aligned[middle, left - 40 : right + 40]
    shift = 32.0 * (1 / 900 - 1 / 2500) * camera.colour.fx  # px, of the baseline's parallax
    assert abs((strip == 0).sum() - shift) < 5


def test_swapped_lenses_are_in_the_calibration(tmp_path: Path) -> None:
    rig, _, _ = write(tmp_path, "intercap", ("swapped_lenses",), cameras=5)
    for name, index in (("k4", 4), ("k5", 3), ("k3", 2)):
        camera, _ = images_of(tmp_path, "intercap", name)
        assert camera.colour.fx == pytest.approx(rig.claimed[index].colour.fx, abs=1e-9)


@pytest.mark.parametrize("layout", ["intercap", "behave"])
def test_a_calibration_of_another_resolution_is_refused(tmp_path: Path, layout: LayoutName) -> None:
    rig, _, _ = write(tmp_path, layout, ("wrong_resolution",), {"wrong_resolution": 2})
    images_of(tmp_path, layout, rig.claimed.names[1])
    with pytest.raises(UserError, match="resolution"):
        images_of(tmp_path, layout, rig.claimed.names[2])


def test_aligned_depth_is_that_of_the_colour_camera():
    rig, zup_from_master = ring(count=2)
    for camera in rig:
        camera = replace(camera, colour=camera.colour.scaled(0.3))
        depth = np.rint(room_depth(camera, zup_from_master, FURNITURE) * 1000).astype(np.uint16)
        found = Aligner(camera).align(depth)
        colour_as_depth = replace(camera, depth=camera.colour, colour_from_depth=np.eye(4))
        truth = room_depth(colour_as_depth, zup_from_master, FURNITURE) * 1000
        both = (found > 0) & (truth > 0)
        error = np.abs(found[both] - truth[both])
        assert both.mean() > 0.5  # the depth image is narrower than the colour image
        assert np.median(error) < 1.2 and np.percentile(error, 90) < 4
        # Beyond that only silhouettes differ, where the two cameras see different surfaces.
        assert (error > 100).mean() < 0.02
