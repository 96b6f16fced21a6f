"""`intercap calibrate` on files of plain cameras: a walking person, a board, and bad input."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.evaluate.board_recording import write_board_recording
from intercap_core.body.keypoints import BODY
from intercap_core.commands.calibrate import calibrate
from intercap_core.config import FramesSettings
from intercap_core.errors import UserError
from intercap_core.evaluation.scene_errors import displacement
from intercap_core.formats.calibration.boards import parse_board
from intercap_core.formats.calibration.files import read_calibration
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.stages import frames
from tests.calibrate.plain_project import FPS, PlainProject, lenses_of, small_ring, write_walk
from tests.helpers.synthetic_people import seen_by, stick_person, walker

BOARD = "charuco:5x4:0.2:0.15:4X4_50"
TRUTH, UP = small_ring()
NEAR = Rig(small_ring(6)[0].cameras[:2])


def run(project: PlainProject, **options: Any) -> tuple[Path, Path]:
    usual: dict[str, Any] = dict.fromkeys(("output", "lenses", "board", "distance", "master"))
    usual |= {"lenses": project.folder / "lenses.json", "recordings": [], "replace": False}
    return calibrate(project.load(), "walk", **(usual | options))


def distance(a: int = 0, b: int = 1) -> str:
    poses = TRUTH.master_from_colour[:, :3, 3]
    names = TRUTH.names
    return f"{names[a]}:{names[b]}:{np.linalg.norm(poses[a] - poses[b]):.4f}"


def errors_m(path: Path, true: Rig = TRUTH, master: int = 0) -> np.ndarray:
    """Displacement (C,) of a 2 m cube at the ring's centre by the written calibration."""
    found = read_calibration(path).extrinsics.master_from_colour
    poses = np.stack([found[name] for name in true.names])
    return displacement(poses, true.master_from_colour, master)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> PlainProject:
    """A person who walks for four seconds. Tests write their results elsewhere."""
    return write_walk(tmp_path_factory.mktemp("walk"), TRUTH, UP)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> PlainProject:
    """A person who walks for two seconds. Tests write their results elsewhere."""
    return write_walk(tmp_path_factory.mktemp("short"), TRUTH, UP, sets=30)


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> PlainProject:
    """A board before two neighbours of a ring of six, which see it at the same time."""
    folder = tmp_path_factory.mktemp("board")
    write_board_recording(folder / "recordings", NEAR, parse_board(BOARD), sets=40, fps=2, seed=3)
    (folder / "lenses.json").write_text(json.dumps(lenses_of(NEAR) | {"fps": 2}))
    return PlainProject(folder).write(keypoints=False)


def test_poses_follow_from_a_walk(walk: PlainProject, tmp_path: Path) -> None:
    path, page = run(walk, output=tmp_path / "rig.json", distance=distance(), master="k2")
    assert errors_m(path, master=1).max() < 0.02
    assert page.read_text().count("<svg") >= 2
    assert all(name in page.read_text() for name in TRUTH.names)
    row = walk.load().sequences["walk"].model_copy(update={"calibration": path})
    frames.run(sequence=row, output=tmp_path / "frames.h5", settings=FramesSettings())
    with Frames.open(tmp_path / "frames.h5") as written:
        assert written.available.all()


def test_the_height_of_the_subject_gives_the_scale(short: PlainProject, tmp_path: Path) -> None:
    path, _ = run(short, output=tmp_path / "rig.json")
    found = read_calibration(path).extrinsics.master_from_colour["k2"][:3, 3]
    ratio = np.linalg.norm(found) / np.linalg.norm(TRUTH.master_from_colour[1, :3, 3])
    assert abs(ratio - 1) < 0.12  # a stick person of 1.7 m


def test_poses_and_lenses_follow_from_a_board(board: PlainProject, tmp_path: Path) -> None:
    with_lenses, _ = run(board, output=tmp_path / "with.json", board=BOARD)
    assert errors_m(with_lenses, NEAR).max() < 0.01
    sizes = {"fps": 2, "cameras": {name: {} for name in NEAR.names}}
    (tmp_path / "sizes.json").write_text(json.dumps(sizes))
    without, _ = run(
        board, output=tmp_path / "without.json", board=BOARD, lenses=tmp_path / "sizes.json"
    )
    assert errors_m(without, NEAR).max() < 0.02
    lens = json.loads(without.read_text())["cameras"]["k1"]["camera_matrix"]
    assert abs(lens[0][0] / NEAR[0].colour.fx - 1) < 0.01


def refuse(project: PlainProject, *words: str, **options: Any) -> None:
    """Run, expect a UserError with the words, and nothing written."""
    path = project.folder / "refused.json"
    with pytest.raises(UserError) as raised:
        run(project, **({"output": path} | options))
    missing = [word for word in words if word not in str(raised.value)]
    assert not missing, f"{missing} not in: {raised.value}"
    assert not path.exists()
    assert not (project.folder / "rig.json").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"board": "charuco:6x4:15:11:4X4_50"}, ["--board", "metres"]),
        ({"board": BOARD}, ["board is visible to no camera", "--board"]),
        ({"distance": "k1:k2"}, ["--distance", "CAMERA:CAMERA:METRES"]),
        ({"distance": "k1:k2:inf"}, ["--distance", "CAMERA:CAMERA:METRES"]),
        ({"distance": "k1:k1:2"}, ["--distance", "CAMERA:CAMERA:METRES"]),
        ({"distance": "k1:left:2"}, ["--distance", "'left'", "k1, k2, k3"]),
        ({"master": "left"}, ["'left'", "k1, k2, k3"]),
        ({"lenses": Path("nowhere.json")}, ["nowhere.json"]),
        ({"recordings": [Path("nowhere")]}, ["nowhere"]),
    ],
)
def test_wrong_options_are_explained(
    walk: PlainProject, options: dict[str, Any], words: list[str]
) -> None:
    refuse(walk, *words, **options)


def test_a_camera_without_lens_and_board_is_named(walk: PlainProject, tmp_path: Path) -> None:
    (tmp_path / "rate.json").write_text(json.dumps({"fps": FPS, "cameras": {}}))
    refuse(walk, "k1", "no lens", "camera_matrix", lenses=tmp_path / "rate.json")


def test_an_existing_calibration_is_kept(walk: PlainProject, tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    path.write_text("{}")
    with pytest.raises(UserError, match="exists"):
        run(walk, output=path, distance=distance())
    assert path.read_text() == "{}"


@pytest.mark.parametrize("layout", ["intercap", "behave"])
def test_layouts_with_poses_are_refused(walk: PlainProject, tmp_path: Path, layout: str) -> None:
    other = PlainProject(tmp_path).write(layout=layout, keypoints=False)
    shutil.copytree(walk.recordings, other.recordings)
    refuse(other, layout, "k4a, ros or plain", lenses=None)


def walking_people() -> np.ndarray:
    return seen_by(walker(np.arange(30) / FPS), TRUTH, UP)


def still(people: np.ndarray) -> np.ndarray:
    return np.broadcast_to(seen_by(stick_person()[None], TRUTH, UP), people.shape)


def without_common_view(people: np.ndarray) -> np.ndarray:
    people[:15, 0], people[15:, 1:] = np.nan, np.nan
    return people


def nobody(people: np.ndarray) -> np.ndarray:
    return np.full_like(people, np.nan)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (still, ["0.0", "m of its way", "walk"]),
        (without_common_view, ["k1", "walk"]),
        (nobody, ["a person is detected by 0 of 3 cameras", "keypoints", "--board"]),
        (lambda people: people[:20], ["1.3 s", "expected at least 1.5 s", "walk"]),
    ],
)
def test_walks_that_do_not_determine_the_poses_are_refused(
    tmp_path: Path, change: Callable[[np.ndarray], np.ndarray], words: list[str]
) -> None:
    people = change(walking_people())
    refuse(write_walk(tmp_path, TRUTH, UP, sets=len(people), people=people), *words)


def test_a_short_walk_gives_poses_and_a_note(short: PlainProject, tmp_path: Path) -> None:
    path, page = run(short, output=tmp_path / "out.json", distance=distance())
    assert errors_m(path).max() < 0.05
    assert "together for only 1.9 s" in page.read_text()


def test_exchanged_sides_in_one_camera_do_not_lead_astray(tmp_path: Path) -> None:
    """A camera whose keypoints have left and right exchanged is refused or placed right."""
    from intercap_core.person.sides import swap_sides

    people = walking_people()
    people[:, 2] = swap_sides(people[:, 2])
    assert np.isfinite(people[:, :, BODY]).all()
    project = write_walk(tmp_path, TRUTH, UP, sets=len(people), people=people)
    try:
        path, _ = run(project, output=tmp_path / "out.json", distance=distance())
    except UserError as error:
        assert "k3" in str(error)
    else:
        assert errors_m(path).max() < 0.05


def test_one_camera_needs_no_calibration(walk: PlainProject, tmp_path: Path) -> None:
    project = PlainProject(tmp_path).write(keypoints=False)
    shutil.copytree(walk.recordings / "k1", project.recordings / "k1")
    refuse(project, "'k1' only", "two cameras", lenses=walk.folder / "lenses.json")


def test_a_camera_without_images_is_named(walk: PlainProject, tmp_path: Path) -> None:
    project = PlainProject(tmp_path).write(keypoints=False)
    shutil.copytree(walk.recordings, project.recordings)
    for path in (project.recordings / "k2").iterdir():
        path.write_bytes(b"no image")
    refuse(project, "k2", lenses=walk.folder / "lenses.json")


def test_settings_that_leave_out_a_camera_are_refused(walk: PlainProject, tmp_path: Path) -> None:
    project = PlainProject(tmp_path).write(settings={"frames": {"cameras": ["k1", "k3"]}})
    for name in ("recordings", "keypoints"):
        shutil.copytree(walk.folder / name, tmp_path / name)
    refuse(project, "frames.cameras leaves out k2", lenses=walk.folder / "lenses.json")


def test_other_recordings_must_have_the_same_cameras(walk: PlainProject, tmp_path: Path) -> None:
    shutil.copytree(walk.recordings / "k1", tmp_path / "k1")
    shutil.copytree(walk.recordings / "k2", tmp_path / "left")
    refuse(walk, "left", recordings=[tmp_path])


def test_a_board_seen_by_one_camera_only_is_refused(board: PlainProject, tmp_path: Path) -> None:
    project = PlainProject(tmp_path).write(keypoints=False)
    shutil.copytree(board.recordings, project.recordings)
    grey = next((board.recordings / "k2").glob("*.jpg"))
    for path in (project.recordings / "k2").glob("*.jpg"):
        shutil.copy(grey, path)
    refuse(project, "k1", lenses=board.folder / "lenses.json", board=BOARD)
