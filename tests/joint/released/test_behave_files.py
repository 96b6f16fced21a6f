"""Files of BEHAVE's results: what they say, and what may be wrong with them."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.errors import UserError
from intercap_core.formats.released import (
    PERSON_MESH,
    files_of,
    object_fits,
    object_poses_at_30_fps,
    person_poses_at_30_fps,
    read_object_pose,
    read_person_pose,
    read_skin,
)
from tests.helpers.behave_results import write_30_fps, write_mesh

# SMPL-H's joints as its publishers list them: the body, then the hands
SMPLH = [
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
] + [
    f"{side}_{finger}{i}"
    for side in ("left", "right")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for i in (1, 2, 3)
]


def _write(path: Path, values: Any) -> Path:
    path.write_bytes(pickle.dumps(values, protocol=2))
    return path


def test_rotations_go_to_the_joints_of_their_names(tmp_path: Path) -> None:
    pose = np.random.default_rng(0).normal(size=156)
    found = read_person_pose(_write(tmp_path / "person_fit.pkl", {"pose": pose}))
    for i, name in enumerate(SMPLH):
        assert np.array_equal(found[JOINT_INDEX[name]], pose[3 * i : 3 * i + 3]), name
    assert not found[22:25].any()  # jaw and eyes
    of_smpl = read_person_pose(_write(tmp_path / "person_fit.pkl", {"pose": pose[None, :72]}))
    assert np.array_equal(of_smpl[:22], found[:22]) and not of_smpl[22:].any()


def test_poses_at_30_fps_are_told_by_their_times(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    poses, angles, trans = (
        rng.normal(size=(3, 156)),
        rng.normal(size=(2, 3)),
        rng.normal(size=(2, 3)),
    )
    assert person_poses_at_30_fps(tmp_path) == object_poses_at_30_fps(tmp_path) == {}
    write_30_fps(tmp_path, ["0003.000", "0003.033"], poses, angles, trans)
    found = object_poses_at_30_fps(tmp_path)
    assert list(found) == [3_000_000, 3_033_000]
    assert np.array_equal(found[3_033_000], [angles[1], trans[1]])
    # as first released: no times of its own, and one pose more than the object has
    np.savez(tmp_path / "smpl_fit_all.npz", poses=poses)
    persons = person_poses_at_30_fps(tmp_path)
    assert list(persons) == list(found)
    assert np.array_equal(persons[3_033_000][1], poses[1, 3:6])


def test_the_object_is_found_under_the_name_of_its_kind(tmp_path: Path) -> None:
    (tmp_path / "person" / "fit01").mkdir(parents=True)
    (tmp_path / "person" / "fit01" / "person_fit.pkl").touch()
    (tmp_path / "sports ball" / "fit01").mkdir(parents=True)
    assert object_fits(tmp_path) == []
    named = tmp_path / "sports ball" / "fit01" / "sports ball_fit.pkl"
    named.touch()
    (tmp_path / "k0.color.jpg").touch()
    assert object_fits(tmp_path) == [named]


def test_the_workflow_watches_the_folder_and_not_the_files_in_frames(tmp_path: Path) -> None:
    frame = tmp_path / "t0003.000" / PERSON_MESH
    frame.parent.mkdir(parents=True)
    frame.touch()
    assert files_of(tmp_path) == [tmp_path]
    (tmp_path / "object_fit_all.npz").touch()
    assert files_of(tmp_path) == [tmp_path, tmp_path / "object_fit_all.npz"]
    (tmp_path / "res.pkl").touch()  # InterCap's own name for results goes first
    assert files_of(tmp_path) == [tmp_path / "res.pkl"]
    assert files_of(tmp_path / "res.pkl") == [tmp_path / "res.pkl"]


class _Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return print, ("called",)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"betas": np.zeros(10)}, "has no entry 'pose'"),
        ({"pose": np.zeros(165)}, "165 numbers, expected the 156 of SMPL-H or the 72 of SMPL"),
        ({"pose": np.full(156, np.nan)}, "no numbers"),
        ({"pose": np.full(156, 180.0)}, "reaches 180; expected metres and radians"),
        ({"pose": "text"}, "no array of numbers"),
        ([1, 2], "holds list, expected"),
        ({"pose": _Evil()}, "asks for _*builtins?_*.print"),
        (_Evil(), "asks for _*builtins?_*.print"),
    ],
)
def test_bad_poses_of_a_person_are_named(
    tmp_path: Path, values: Any, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _write(tmp_path / "person_fit.pkl", values)
    with pytest.raises(UserError, match=said) as error:
        read_person_pose(path)
    assert str(path) in str(error.value) and "called" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"angle": np.zeros(3)}, "has no entry 'trans'"),
        ({"angle": np.zeros(4), "trans": np.zeros(3)}, "angle holds 4 numbers, expected 3"),
        ({"angle": np.zeros(3), "trans": np.array([0, np.inf, 0])}, "expected 3 finite"),
        ({"angle": np.zeros(3), "trans": np.array([310.0, 200, 2400])}, "trans reaches 2400"),
        ({"angle": _Evil(), "trans": np.zeros(3)}, "asks for"),
    ],
)
def test_bad_poses_of_an_object_are_named(tmp_path: Path, values: Any, said: str) -> None:
    path = _write(tmp_path / "box_fit.pkl", values)
    with pytest.raises(UserError, match=said) as error:
        read_object_pose(path)
    assert str(path) in str(error.value)


def _tube(count: int, length: float) -> tuple[np.ndarray, np.ndarray]:
    """A surface of ``count`` vertices, wound about an axis."""
    i = np.arange(count)
    turn, along = 2 * np.pi * i / 26, length * i / (count - 1)
    vertices = np.column_stack([0.2 * length * np.cos(turn), along, 0.2 * length * np.sin(turn)])
    first = i[: count - 27]
    faces = np.concatenate(
        [
            np.column_stack([first, first + 1, first + 26]),
            np.column_stack([first + 1, first + 27, first + 26]),
        ]
    )
    return vertices, faces


@pytest.mark.parametrize(
    ("count", "length", "said"),
    [
        (6891, 1.6, "6891 vertices, expected the 6890 of SMPL-H"),
        (6890, 1600.0, "is 1600 m large, expected a person of 0.5 to 3 m; write it in metres"),
        (6890, 0.0016, "write it in metres"),
    ],
)
def test_bad_meshes_of_a_person_are_named(
    tmp_path: Path, count: int, length: float, said: str
) -> None:
    path = tmp_path / "person_fit.ply"
    write_mesh(path, *_tube(count, length))
    with pytest.raises(UserError, match=said) as error:
        read_skin(path)
    assert str(path) in str(error.value)


def test_meshes_that_are_none_are_named(tmp_path: Path) -> None:
    vertices, faces = _tube(6890, 1.6)
    write_mesh(tmp_path / "good.ply", vertices, faces)
    assert read_skin(tmp_path / "good.ply").vertices.shape == (6890, 3)
    trimesh.PointCloud(vertices).export(tmp_path / "points.ply")
    vertices[faces[0, 0], 1] = np.nan
    write_mesh(tmp_path / "holes.ply", vertices, faces)
    (tmp_path / "text.ply").write_text("ply? no")
    for name, said in (
        ("points", "not a point cloud"), ("holes", "is no(t a)? number"),
        ("text", "not a readable mesh"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=said) as error:
            read_skin(tmp_path / f"{name}.ply")
        assert f"{name}.ply" in str(error.value)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"frame_times": np.array(["3.0", "soon"])}, "frame_times are not times"),
        ({"frame_times": np.array(["t1.0", "t2.0", "t3.0"])}, "one for each of 2 poses"),
        ({"trans": np.zeros((3, 3))}, r"trans is \(3, 3\), expected \(2, 3\)"),
        ({"trans": np.full((2, 3), 1500.0)}, "trans reaches 1500"),
        ({"angles": np.array([_Evil(), _Evil()], object)}, "has no readable array 'angles'"),
    ],
)
def test_bad_parameters_at_30_fps_are_named(
    tmp_path: Path, changed: dict[str, np.ndarray], said: str
) -> None:
    values = {
        "angles": np.zeros((2, 3)),
        "trans": np.zeros((2, 3)),
        "frame_times": np.array(["t0001.000", "t0001.033"]),
    }
    np.savez(tmp_path / "object_fit_all.npz", **(values | changed))
    with pytest.raises(UserError, match=said) as error:
        object_poses_at_30_fps(tmp_path)
    assert "object_fit_all.npz" in str(error.value)
