"""Results as the InterCap release has them: what our own export writes, and what may be wrong."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.joint.released.intercap import read_results

T = 4


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


def _write(path: Path, values: Any) -> Path:
    path.write_bytes(pickle.dumps(values, protocol=2))
    return path


def test_every_frame_has_its_numbers(tmp_path: Path) -> None:
    values = _values()
    _write(tmp_path / "res.pkl", values)
    found = read_results(tmp_path)  # the folder of a sequence
    assert len(found) == T and found.known.all() and found.path.name == "res.pkl"
    assert found.turns["body_pose"] == pytest.approx(values["body_pose"].reshape(T, 63))
    assert found.hands[1] == pytest.approx(values["right_hand_pose"])
    turns = Rotation.from_rotvec(np.array(values["ob_pose"])).as_matrix()
    assert found.rotation == pytest.approx(turns)
    assert found.translation == pytest.approx(np.array(values["ob_trans"]))


def test_a_list_of_frames_and_npz_say_the_same(tmp_path: Path) -> None:
    values = _values(body_pose=np.zeros((T, 63)))
    whole = read_results(_write(tmp_path / "res_2.pkl", values))
    frames = [{k: np.asarray(v)[t : t + 1] for k, v in values.items()
               if k != "pose_embedding"} for t in range(T)]  # fmt: skip
    single = read_results(_write(tmp_path / "res_1.pkl", frames))
    np.savez(tmp_path / "res.npz", **{k: np.asarray(v) for k, v in values.items()})
    arrays = read_results(tmp_path / "res.npz")
    for other in (single, arrays):
        assert other.transl == pytest.approx(whole.transl)
        assert other.rotation == pytest.approx(whole.rotation)
        assert other.betas == pytest.approx(whole.betas)
    assert read_results(tmp_path).path.name == "res.npz"  # the newest name of those that are there


def test_one_shape_full_hands_no_object_and_gaps(tmp_path: Path) -> None:
    orient = np.zeros((T, 3))
    orient[2] = np.nan
    values = _values(
        betas=np.ones(10), left_hand_pose=np.zeros((T, 45)), global_orient=orient,
        ob_pose=None, ob_trans=None,
    )  # fmt: skip
    found = read_results(_write(tmp_path / "res.pkl", values))
    assert found.betas.shape == (T, 10) and found.hands[0].shape == (T, 45)
    assert found.known.tolist() == [True, True, False, True]
    assert np.isnan(found.rotation).all()


class _Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return print, ("called",)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (_values(transl=None), "has no entry 'transl'"),
        (_values(transl=np.zeros((T, 2))), "transl is .* expected"),
        (_values(body_pose=np.zeros((1, 62 * T))), "body_pose is .* expected"),
        (_values(jaw_pose=np.zeros((T + 1, 3))), "jaw_pose is .* expected"),
        (_values(betas=np.zeros((2, 10))), "betas is .* expected"),
        (_values(right_hand_pose=np.zeros((T, 60))), "60 numbers a frame"),
        (_values(ob_trans=[np.array([1500.0, 20, 900])] * T), "expected metres"),
        (_values(ob_trans=[np.zeros(3)] * (T - 1)), "ob_trans is .* expected"),
        (_values(global_orient="text"), "no array of numbers"),
        ([1, 2], "holds list, expected"),
        (_Evil(), "asks for _*builtins?_*.print"),
        (_values(betas=_Evil()), "asks for _*builtins?_*.print"),
    ],
)
def test_bad_files_are_named(
    tmp_path: Path, values: Any, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _write(tmp_path / "res.pkl", values)
    with pytest.raises(UserError, match=said) as error:
        read_results(path)
    assert str(path) in str(error.value) and "called" not in capsys.readouterr().out


def test_folders_and_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"holds none of res\.pkl"):
        read_results(tmp_path)
    with pytest.raises(UserError, match="cannot be read"):
        read_results(tmp_path / "none.pkl")
    (tmp_path / "res.npz").write_bytes(b"no")
    with pytest.raises(UserError, match=r"is not a readable \.npz archive"):
        read_results(tmp_path / "res.npz")
