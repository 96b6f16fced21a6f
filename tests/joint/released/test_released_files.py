"""Files of released results, in BEHAVE's and InterCap's formats: contents and damage."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.errors import UserError
from intercap_core.formats.released import (
    BEHAVE_OBJECT,
    BEHAVE_PERSON,
    intercap_file,
    object_fits,
    object_poses_at_30_fps,
    person_poses_at_30_fps,
    read_object_pose,
    read_person_pose,
    read_skin,
)
from intercap_core.joint.released.intercap import read_results
from tests.helpers.behave_results import write_30_fps, write_mesh

# SMPL-H's joints as its publishers list them: the body, then the hands.
SMPLH = [
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2",
    "left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar",
    "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist",
    *(
        f"{side}_{finger}{i}"
        for side in ("left", "right")
        for finger in ("index", "middle", "pinky", "ring", "thumb")
        for i in (1, 2, 3)
    ),
]  # fmt: skip
T = 4


def _write(path: Path, values: Any) -> Path:
    path.write_bytes(pickle.dumps(values, protocol=2))
    return path


class _Code:
    """A pickle that calls ``print`` when it is loaded."""

    def __reduce__(self) -> tuple[Any, ...]:
        return print, ("called",)


CODE = "asks for _*builtins?_*.print"


# --- BEHAVE


def test_rotations_are_assigned_to_joints_by_name(tmp_path):
    pose = np.random.default_rng(0).normal(size=156)
    smplh = read_person_pose(_write(tmp_path / "person_fit.pkl", {"pose": pose}))
    for i, name in enumerate(SMPLH):
        assert np.array_equal(smplh[JOINT_INDEX[name]], pose[3 * i : 3 * i + 3]), name
    assert not smplh[22:25].any()  # jaw and eyes
    smpl = read_person_pose(_write(tmp_path / "person_fit.pkl", {"pose": pose[None, :72]}))
    assert np.array_equal(smpl[:22], smplh[:22]) and not smpl[22:].any()


def test_poses_at_30_fps_are_listed_by_time(tmp_path):
    rng = np.random.default_rng(0)
    poses, angles, trans = (rng.normal(size=size) for size in ((3, 156), (2, 3), (2, 3)))
    assert person_poses_at_30_fps(tmp_path) == object_poses_at_30_fps(tmp_path) == {}
    for name, read in (
        (BEHAVE_PERSON, person_poses_at_30_fps),
        (BEHAVE_OBJECT, object_poses_at_30_fps),
    ):
        (tmp_path / name).symlink_to("nowhere")
        with pytest.raises(UserError, match=name):
            read(tmp_path)
        (tmp_path / name).unlink()
    write_30_fps(tmp_path, ["0003.000", "0003.033"], poses, angles, trans)
    objects = object_poses_at_30_fps(tmp_path)
    assert list(objects) == [3_000_000, 3_033_000]
    assert np.array_equal(objects[3_033_000], [angles[1], trans[1]])
    # as first released: without times, and with one pose more than the object has
    np.savez(tmp_path / "smpl_fit_all.npz", poses=poses)
    persons = person_poses_at_30_fps(tmp_path)
    assert list(persons) == list(objects)
    assert np.array_equal(persons[3_033_000][1], poses[1, 3:6])


def test_object_may_have_the_name_of_its_category(tmp_path):
    (tmp_path / "person" / "fit01").mkdir(parents=True)
    (tmp_path / "person" / "fit01" / "person_fit.pkl").touch()
    (tmp_path / "sports ball" / "fit01").mkdir(parents=True)
    assert object_fits(tmp_path) == []
    fit = tmp_path / "sports ball" / "fit01" / "sports ball_fit.pkl"
    fit.touch()
    (tmp_path / "k0.color.jpg").touch()
    assert object_fits(tmp_path) == [fit]


def test_results_of_a_folder_are_those_of_intercap_or_the_folder(tmp_path):
    assert intercap_file(tmp_path) == tmp_path
    (tmp_path / "res.pkl").touch()
    assert intercap_file(tmp_path) == tmp_path / "res.pkl"
    assert intercap_file(tmp_path / "res.pkl") == tmp_path / "res.pkl"


def _tube(count: int, length: float) -> tuple[np.ndarray, np.ndarray]:
    """A surface of ``count`` vertices, wound about an axis."""
    i = np.arange(count)
    turn, along = 2 * np.pi * i / 26, length * i / (count - 1)
    vertices = np.column_stack([0.2 * length * np.cos(turn), along, 0.2 * length * np.sin(turn)])
    first = i[: count - 27]
    lower = np.column_stack([first, first + 1, first + 26])
    return vertices, np.concatenate([lower, np.column_stack([first + 1, first + 27, first + 26])])


def test_bad_meshes_of_a_person_are_refused(tmp_path):
    vertices, faces = _tube(6890, 1.6)
    write_mesh(tmp_path / "good.ply", vertices, faces)
    assert read_skin(tmp_path / "good.ply").vertices.shape == (6890, 3)
    write_mesh(tmp_path / "more.ply", *_tube(6891, 1.6))
    write_mesh(tmp_path / "millimetres.ply", 1e3 * vertices, faces)
    write_mesh(tmp_path / "kilometres.ply", 1e-3 * vertices, faces)
    trimesh.PointCloud(vertices).export(tmp_path / "points.ply")
    vertices[faces[0, 0], 1] = np.nan
    write_mesh(tmp_path / "holes.ply", vertices, faces)
    (tmp_path / "text.ply").write_text("ply? no")
    for name, message in (
        ("more", "6891 vertices, expected the 6890 of SMPL-H"),
        ("millimetres", "is 1600 m large, expected a person of 0.5 to 3 m; write it in metres"),
        ("kilometres", "write it in metres"),
        ("points", "not a point cloud"),
        ("holes", "is no(t a)? number"),
        ("text", "not a readable mesh"),
    ):
        with pytest.raises(UserError, match=message) as error:
            read_skin(tmp_path / f"{name}.ply")
        assert f"{name}.ply" in str(error.value)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"frame_times": np.array(["3.0", "soon"])}, "frame_times are not times"),
        ({"frame_times": np.array(["t1.0", "t2.0", "t3.0"])}, "one for each of 2 poses"),
        ({"trans": np.zeros((3, 3))}, r"trans is \(3, 3\), expected \(2, 3\)"),
        ({"trans": np.full((2, 3), 1500.0)}, "trans reaches 1500"),
        ({"angles": np.array([_Code(), _Code()], object)}, "has no readable array 'angles'"),
    ],
)
def test_bad_parameters_at_30_fps_are_refused(
    tmp_path, changed: dict[str, np.ndarray], message: str
):
    values = {
        "angles": np.zeros((2, 3)),
        "trans": np.zeros((2, 3)),
        "frame_times": np.array(["t0001.000", "t0001.033"]),
    }
    np.savez(tmp_path / "object_fit_all.npz", **(values | changed))
    with pytest.raises(UserError, match=message) as error:
        object_poses_at_30_fps(tmp_path)
    assert "object_fit_all.npz" in str(error.value)


# --- InterCap


def _values(**changed: Any) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    values = {
        "global_orient": rng.normal(size=(T, 3)),
        "transl": rng.normal(size=(T, 3)),
        "body_pose": rng.normal(size=(1, 63 * T)).astype(np.float32),
        "left_hand_pose": rng.normal(size=(T, 12)),
        "right_hand_pose": rng.normal(size=(T, 12)),
        "betas": rng.normal(size=(T, 10)),
        "expression": rng.normal(size=(T, 10)),
        **{f"{name}_pose": rng.normal(size=(T, 3)) for name in ("jaw", "leye", "reye")},
        "pose_embedding": rng.normal(size=(1, 32 * T)),
        "ob_pose": list(rng.normal(size=(T, 3))),
        "ob_trans": list(rng.normal(size=(T, 3))),
    }
    return {name: value for name, value in (values | changed).items() if value is not None}


def test_results_of_intercap_are_read_by_frame(tmp_path):
    values = _values()
    _write(tmp_path / "res.pkl", values)
    results = read_results(tmp_path)  # the folder of a sequence
    assert len(results) == T and results.known.all() and results.path.name == "res.pkl"
    assert results.turns["body_pose"] == pytest.approx(values["body_pose"].reshape(T, 63))
    assert results.hands[1] == pytest.approx(values["right_hand_pose"])
    turns = Rotation.from_rotvec(np.array(values["ob_pose"])).as_matrix()
    assert results.rotation == pytest.approx(turns)
    assert results.translation == pytest.approx(np.array(values["ob_trans"]))


def test_list_of_frames_and_npz_have_the_same_results(tmp_path):
    values = _values(body_pose=np.zeros((T, 63)))
    expected = read_results(_write(tmp_path / "res_2.pkl", values))
    frames = [{k: np.asarray(v)[t : t + 1] for k, v in values.items()
               if k != "pose_embedding"} for t in range(T)]  # fmt: skip
    np.savez(tmp_path / "res.npz", **{k: np.asarray(v) for k, v in values.items()})
    for path in (_write(tmp_path / "res_1.pkl", frames), tmp_path / "res.npz"):
        for name in ("transl", "rotation", "betas"):
            assert getattr(read_results(path), name) == pytest.approx(getattr(expected, name))
    assert read_results(tmp_path).path.name == "res.npz"  # the newest of the names


def test_shape_full_hands_and_gaps_without_an_object(tmp_path):
    orient = np.zeros((T, 3))
    orient[2] = np.nan
    values = _values(
        betas=np.ones(10), left_hand_pose=np.zeros((T, 45)), global_orient=orient,
        ob_pose=None, ob_trans=None,
    )  # fmt: skip
    results = read_results(_write(tmp_path / "res.pkl", values))
    assert results.betas.shape == (T, 10) and results.hands[0].shape == (T, 45)
    assert results.known.tolist() == [True, True, False, True]
    assert np.isnan(results.rotation).all()


@pytest.mark.parametrize(
    ("read", "values", "message"),
    [
        (read_person_pose, {"betas": np.zeros(10)}, "has no entry 'pose'"),
        (read_person_pose, {"pose": np.zeros(165)}, "165 numbers, expected the 156 of SMPL-H or"),
        (read_person_pose, {"pose": np.full(156, np.nan)}, "no numbers"),
        (read_person_pose, {"pose": np.full(156, 180.0)}, "reaches 180; expected metres and rad"),
        (read_person_pose, {"pose": "text"}, "no array of numbers"),
        (read_person_pose, [1, 2], "holds list, expected"),
        (read_person_pose, {"pose": _Code()}, CODE),
        (read_person_pose, _Code(), CODE),
        (read_object_pose, {"angle": np.zeros(3)}, "has no entry 'trans'"),
        (read_object_pose, {"angle": np.zeros(4), "trans": np.zeros(3)}, "4 numbers, expected 3"),
        (read_object_pose, {"angle": np.zeros(3), "trans": [0, np.inf, 0]}, "expected 3 finite"),
        (read_object_pose, {"angle": np.zeros(3), "trans": [310, 2400, 1]}, "trans reaches 2400"),
        (read_object_pose, {"angle": _Code(), "trans": np.zeros(3)}, CODE),
        (read_results, _values(transl=None), "has no entry 'transl'"),
        (read_results, _values(transl=np.zeros((T, 2))), "transl is .* expected"),
        (read_results, _values(body_pose=np.zeros((1, 62 * T))), "body_pose is .* expected"),
        (read_results, _values(jaw_pose=np.zeros((T + 1, 3))), "jaw_pose is .* expected"),
        (read_results, _values(betas=np.zeros((2, 10))), "betas is .* expected"),
        (read_results, _values(right_hand_pose=np.zeros((T, 60))), "60 numbers a frame"),
        (read_results, _values(ob_trans=[np.array([1500.0, 20, 900])] * T), "expected metres"),
        (read_results, _values(ob_trans=[np.zeros(3)] * (T - 1)), "ob_trans is .* expected"),
        (read_results, _values(global_orient="text"), "no array of numbers"),
        (read_results, [1, 2], "holds list, expected"),
        (read_results, _Code(), CODE),
        (read_results, _values(betas=_Code()), CODE),
    ],
)
def test_bad_entries_are_named(
    tmp_path, read: Callable[[Path], object], values: Any, message: str, capsys
):
    path = _write(tmp_path / "res.pkl", values)
    with pytest.raises(UserError, match=message) as error:
        read(path)
    assert str(path) in str(error.value) and "called" not in capsys.readouterr().out


def test_missing_and_unreadable_files_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"holds none of res\.pkl"):
        read_results(tmp_path)
    with pytest.raises(UserError, match="cannot be read"):
        read_results(tmp_path / "none.pkl")
    (tmp_path / "res.npz").write_bytes(b"no")
    with pytest.raises(UserError, match=r"is not a readable \.npz archive"):
        read_results(tmp_path / "res.npz")
