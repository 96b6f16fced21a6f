"""The frames stage on folders as InterCap and BEHAVE release them, good ones and bad ones."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from intercap_core.config import FramesSettings
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.layouts import list_unread, open_layout
from intercap_core.geometry.camera.clouds import master_points
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.stages import frames as stage
from tests.helpers.kinect_files import notes_of, row, run
from tests.helpers.release_folders import write_behave, write_intercap
from tests.helpers.synthetic_capture import COLOUR, FURNITURE, ring, room_depth, to_millimetres

LENS = COLOUR.scaled(0.1)
NUMBERS = (0, 1, 2, 4, 5)  # 3 was lost by all cameras
TIMES = ("0003.000", "0004.000", "0005.000", "0008.000")


def rig_of(count: int) -> tuple[Rig, np.ndarray]:
    rig, zup_from_master = ring(count=count)
    cameras = [
        replace(camera, colour=LENS, depth=LENS, colour_from_depth=np.eye(4)) for camera in rig
    ]
    return Rig(tuple(cameras)), zup_from_master


def jpeg_at(t: int, c: int) -> bytes:
    image = np.full((LENS.height, LENS.width, 3), (20 * c, 10 * t, 128), np.uint8)
    cv2.putText(image, f"{t} {c}", (20, 60), cv2.FONT_HERSHEY_SIMPLEX, 1, (255, 255, 255))
    return cv2.imencode(".jpg", image)[1].tobytes()


def depth_at(t: int, c: int) -> np.ndarray:
    return np.full((LENS.height, LENS.width), 1000 + 100 * c + t, np.uint16)


@pytest.fixture
def release(tmp_path) -> SequenceEntry:
    rig, _ = rig_of(3)
    folders = write_intercap(tmp_path, rig, numbers=NUMBERS, colour=jpeg_at, depth=depth_at)
    return row(*folders, layout="intercap")


@pytest.fixture
def behave(tmp_path) -> SequenceEntry:
    rig, _ = rig_of(4)
    folders = write_behave(tmp_path, rig, times=TIMES, colour=jpeg_at, depth=depth_at)
    return row(*folders, layout="behave")


def cam(sequence: SequenceEntry, number: int) -> Path:
    return sequence.recordings / f"Frames_Cam{number}"


def test_release_images_times_and_cameras(release):
    made, _ = rig_of(3)
    output = run(release)
    with Frames.open(output) as frames:
        assert (frames.num_sets, frames.fps, frames.master) == (5, 30.0, "k1")
        assert np.allclose(frames.time_s, np.array(NUMBERS) / 30, atol=1e-6)
        for t, number in enumerate(NUMBERS):
            for c in range(3):
                assert frames.colour_jpeg(t, c) == jpeg_at(number, c)
                assert np.array_equal(frames.depth(t, c), depth_at(number, c))
        rig = frames.rig
    assert "no camera has an image for 1 periods" in notes_of(output)["k1"]
    assert rig.names == ("k1", "k2", "k3")
    for camera, expected in zip(rig, made, strict=True):
        assert np.allclose(camera.colour.parameters, expected.colour.parameters)
        assert np.array_equal(camera.depth.parameters, camera.colour.parameters)
        assert np.array_equal(camera.colour_from_depth, np.eye(4))
        assert np.allclose(camera.master_from_colour, expected.master_from_colour, atol=1e-9)


def test_behave_images_times_and_cameras(behave):
    made, _ = rig_of(4)
    with Frames.open(run(behave)) as frames:
        assert (frames.num_sets, frames.fps, frames.master) == (4, 1.0, "k1")
        assert np.allclose(frames.time_s, [0, 1, 2, 5])
        for t in range(4):
            for c in range(4):
                assert frames.colour_jpeg(t, c) == jpeg_at(t, c)
                assert np.array_equal(frames.depth(t, c), depth_at(t, c))
        rig = frames.rig
    assert rig.names == ("k0", "k1", "k2", "k3")
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    for camera, expected in zip(rig, made, strict=True):
        assert np.allclose(camera.colour.parameters, expected.colour.parameters)
        truth = made[1].colour_from_master @ expected.master_from_colour
        assert np.allclose(apply(camera.master_from_colour, points), apply(truth, points))


def test_behave_sets_keep_the_time_of_their_folders(behave):
    """Also if the first set is dropped."""
    with Frames.open(run(behave)) as frames:
        assert frames.first_set_s == pytest.approx(3.0)
    output = behave.recordings.parent / "dropped.h5"
    stage.run(sequence=behave, output=output, settings=FramesSettings(), frames_to_drop=[0, 2])
    with Frames.open(output) as frames:
        times = frames.first_set_s + frames.time_s
        assert times == pytest.approx([float(text) for text in TIMES])


def test_behave_times_at_thirty_frames_a_second(tmp_path):
    rig, _ = rig_of(2)
    times = [f"{2 + i / 30:08.3f}" for i in range(6)]
    folders = write_behave(tmp_path, rig, times=times, colour=jpeg_at, depth=depth_at)
    with Frames.open(run(row(*folders, layout="behave"))) as frames:
        assert frames.fps == 30 and frames.num_sets == 6 and frames.available.all()


@pytest.mark.parametrize("layout", ["intercap", "behave"])
def test_clouds_of_all_cameras_lie_on_one_room(tmp_path, layout):
    """Poses, lenses and depth agree: every camera's points are on the same planes."""
    rig, zup_from_master = rig_of(4)
    rng = np.random.default_rng(1)
    depths = [
        to_millimetres(room_depth(camera, zup_from_master, FURNITURE), rng, 0) for camera in rig
    ]
    images = dict(colour=jpeg_at, depth=lambda t, c: depths[c])
    if layout == "intercap":
        folders, master = write_intercap(tmp_path, rig, numbers=[0], **images), 0
    else:
        folders, master = write_behave(tmp_path, rig, times=["0000.000"], **images), 1
    zup_from_frame = zup_from_master @ rig[master].master_from_colour
    with Frames.open(run(row(*folders, layout=layout))) as frames:
        for c, camera in enumerate(frames.rig):
            points = apply(zup_from_frame, master_points(frames.depth(0, c), camera).points)
            low = (np.abs(points[:, 2]) < 0.03) & (np.abs(points[:, :2]) < 3.4).all(1)
            assert low.sum() > 1000 and np.percentile(np.abs(points[low, 2]), 90) < 0.001


def remove(*names: str):
    """Remove files and folders below the recordings."""

    def edit(sequence):
        for name in names:
            path = sequence.recordings / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return edit


def overwrite(pattern: str, content):
    """Write bytes, an image, or a function of the file's bytes, to files below the recordings."""

    def edit(sequence):
        for path in sequence.recordings.glob(pattern):
            if isinstance(content, np.ndarray):
                cv2.imwrite(str(path), content)
            else:
                path.write_bytes(
                    content if isinstance(content, bytes) else content(path.read_bytes())
                )

    return edit


def set_lens(**entries):
    """Set entries of the second camera's lens; None removes one."""

    def edit(sequence):
        path = sequence.calibration / "Color_2.json"
        content = json.loads(path.read_text()) | entries
        path.write_text(json.dumps({key: v for key, v in content.items() if v is not None}))

    return edit


COLOUR_2, DEPTH_2 = "Frames_Cam2/color", "Frames_Cam2/depth"
GREY = np.full((LENS.height, LENS.width), 100, np.uint8)
# what is broken, the words of the note, whether k2 stays, how many of its images, has it depth
SURVIVED = [
    (remove(f"{COLOUR_2}/00001.jpg"), "no image in 1 frame sets", True, 4, True),
    (remove(f"{DEPTH_2}/00002.png"), "no depth image with 1 of its colour images", True, 5, True),
    (remove("Frames_Cam2"), "no recording of k2", False, 0, False),
    (remove(DEPTH_2), "has no depth", True, 5, False),
    (overwrite(f"{DEPTH_2}/00001.png", lambda content: content[:-40]),
     "1 damaged images left out (first: 00001.png is cut off)", True, 5, True),
    (overwrite(f"{DEPTH_2}/00001.png", lambda content: content[:50] + bytes(10) + content[60:]),
     "00001.png does not decode", True, 5, True),
    (overwrite(f"{DEPTH_2}/00002.png", b""), "00002.png is no PNG", True, 5, True),
    (overwrite(f"{COLOUR_2}/00004.jpg", b""), "00004.jpg is no whole JPEG", True, 4, True),
    (overwrite(f"{DEPTH_2}/*.png", GREY),
     "no depth used: 00000.png is no 16-bit grey PNG (8 bits", True, 5, False),
    (overwrite(f"{DEPTH_2}/00001.png", GREY), "00001.png is no 16-bit grey PNG", True, 5, True),
    (overwrite(f"{DEPTH_2}/*.png", np.full((64, 80), 1000, np.uint16)),
     "has 80x64 pixels, expected 192x108", True, 5, False),
    (overwrite(f"{COLOUR_2}/*.jpg", np.zeros((72, 128, 3), np.uint8)),
     "the images have 128x72", False, 0, False),
    (remove(COLOUR_2), "no readable color/<number>.jpg", False, 0, False),
    (set_lens(f=None), "calibration_first/Color_2.json: expected 'f'", False, 0, False),
    (set_lens(k=[0.0] * 6), "6 coefficients", False, 0, False),
]  # fmt: skip


@pytest.mark.parametrize(("fault", "words", "present", "images", "depth"), SURVIVED)
def test_faults_of_release_folders_are_noted(release, fault, words, present, images, depth):
    fault(release)
    output = run(release)
    notes = notes_of(output)
    assert words in notes["k2"]
    assert str(release.recordings.parents[3]) not in notes["k2"]  # no path of a machine
    with Frames.open(output) as frames:
        assert frames.present.tolist() == [True, present, True]
        assert frames.colour_available[:, 1].sum() == images
        assert (frames.rig[1].depth is not None) == depth
        assert frames.depth_available[:, [0, 2]].all()


def test_the_aligned_one_of_several_depth_folders_is_used(release):
    for number, name in ((1, "Depth"), (2, "depth_aligned"), (3, "DEPTH_raw")):
        (cam(release, number) / "depth").rename(cam(release, number) / name)
    (cam(release, 2) / "depth").mkdir()
    with Frames.open(run(release)) as frames:
        assert frames.depth_available.all()
    (cam(release, 2) / "depth" / "00000.png").touch()
    with open_layout(release).open("k2") as recording:
        assert "the images in depth/ are not read" in recording.notes[0]


def test_files_beside_those_of_behave_are_listed(behave):
    first = next(path for path in sorted(behave.recordings.iterdir()) if path.is_dir())
    for name in (
        "k0.depth.tiff",
        "k1.person_mask.jpg",
        "k1.color.json",
        "../T0009.000/k0.color.jpg",
    ):
        (first / name).parent.mkdir(exist_ok=True)
        (first / name).touch()
    notes = list_unread(behave)
    assert len(notes) == 2 and "T0009.000/k0.color.jpg is not used" in notes[0]
    assert "k0.depth.tiff is not used" in notes[1]


def calibration_of_another_resolution(sequence):
    for path in sequence.calibration.glob("*.json"):
        content = json.loads(path.read_text())
        path.write_text(json.dumps({**content, "c": [959.0, 540.0], "f": [913.0, 913.0]}))


def calibration_is_a_file(sequence):
    return sequence.model_copy(update={"calibration": sequence.calibration / "Color.json"})


def test_hidden_files_are_ignored(release):
    for folder in cam(release, 2).iterdir():
        (folder / "._00001.png").write_bytes(b"\0\5\x16\7")
    assert notes_of(run(release))["k2"] == ""


def test_a_repeated_number_excludes_the_camera(release):
    folder = cam(release, 2) / "color"
    shutil.copy(folder / "00001.jpg", folder / "1.jpg")
    assert "image 1 is there twice, as 00001.jpg and 1.jpg" in notes_of(run(release))["k2"]


def lens_of_another_resolution(sequence):
    path = sequence.calibration.parents[1] / "intrinsics" / "2" / "calibration.json"
    content = json.loads(path.read_text())
    content["color"] |= {"width": 2048, "height": 1536}
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("fault", "words", "present"),
    [
        (lambda s: shutil.rmtree(s.calibration / "2"), "no pose in config", False),
        (lambda s: shutil.rmtree(s.calibration.parents[1] / "intrinsics" / "2"),
         "no intrinsics/2/calibration.json", False),
        (lens_of_another_resolution, "are for 2048x1536, its colour images have 192x108", False),
        (remove("t0004.000/k2.color.jpg"), "no image in 1 frame sets", True),
    ],
)  # fmt: skip
def test_faults_of_behave_folders_are_noted(behave, fault, words, present):
    fault(behave)
    output = run(behave)
    assert words in notes_of(output)["k2"]
    with Frames.open(output) as frames:
        assert frames.present[list(frames.rig.names).index("k2")] == present


def set_pose(**entries):
    def edit(sequence):
        path = sequence.calibration / "2" / "config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | entries))

    return edit


def copy_first_folder(sequence) -> None:
    shutil.copytree(sequence.recordings / "t0003.000", sequence.recordings / "t3")


@pytest.mark.parametrize(
    ("layout", "fault", "words"),
    [
        ("release", calibration_is_a_file, "needs a folder of Color.json"),
        ("release", lambda s: (s.calibration / "Color.json").unlink(), "holds no Color.json"),
        ("release", remove("Frames_Cam1", "Frames_Cam2", "Frames_Cam3"), "no recording of k1"),
        ("release", calibration_of_another_resolution, "give the calibration of this resolution"),
        ("behave", lambda s: shutil.rmtree(s.calibration / "1"), "no 1/config.json"),
        ("behave", set_pose(rotation=[1.0] * 9), "2/config.json: expected a rotation matrix"),
        ("behave", set_pose(translation=[2000.0, 0, 0]), "translation of 2000 m"),
        ("behave", remove(*(f"t{time}" for time in TIMES)), "no frame folders"),
        ("behave", copy_first_folder, "t0003.000 and t3 have one time"),
    ],
)
def test_unusable_folders_are_refused(layout, fault, words, request):
    sequence = request.getfixturevalue(layout)
    with pytest.raises(UserError, match=words):
        run(fault(sequence) or sequence)


def test_every_other_image_halves_the_frame_rate(tmp_path):
    rig, _ = rig_of(2)
    folders = write_intercap(tmp_path, rig, numbers=[4, 6, 8, 12], colour=jpeg_at, depth=depth_at)
    with Frames.open(run(row(*folders, layout="intercap"))) as frames:
        assert frames.fps == 15 and frames.available.all()
        assert np.allclose(frames.time_s, np.array([0, 2, 4, 8]) / 30, atol=1e-6)


@pytest.mark.parametrize("layout", ["release", "behave"])
def test_colour_may_be_png(layout, request):
    sequence = request.getfixturevalue(layout)
    for path in sequence.recordings.rglob("*.jpg"):
        image = cv2.imread(str(path))
        cv2.imwrite(str(path.with_suffix(".png")), image)
        path.unlink()
    with Frames.open(run(sequence)) as frames:
        assert frames.available.all()
        assert frames.colour(1, 1).shape == (LENS.height, LENS.width, 3)
