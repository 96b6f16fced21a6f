"""Rig files and release folders with faults are refused by file and camera."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import read_extrinsics

EYE = np.eye(4).tolist()


def _moved(x: float) -> list[list[float]]:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose.tolist()


def _rig(pose: object = EYE, *names: str) -> str:
    """The text of a rig file with k1 as master; the other cameras, usually k2, are at ``pose``."""
    cameras = {"k1": {"master_from_camera": EYE}}
    cameras |= {name: {"master_from_camera": pose} for name in names or ("k2",)}
    return json.dumps({"master": "k1", "cameras": cameras})


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    path.write_bytes(b"\xef\xbb\xbf" + _rig(_moved(1.5)).encode())
    assert read_extrinsics(path).master_from_colour["k2"][0, 3] == 1.5


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "not valid JSON"),
        ("[]", "found list"),
        ("{}", "expected 'master'"),
        ('{"master": "k9", "cameras": {"k1": {}}}', "'k9' is none of the cameras"),
        (_rig(None), "camera 'k2' has no rigid"),
        (_rig([[1, 2], [3]]), "camera 'k2' has no rigid"),
        (_rig(np.diag([1.0, 1, -1, 1]).tolist()), "camera 'k2' has no rigid"),
        (_rig(_moved(np.nan)), "camera 'k2' has no rigid"),
        (_rig([[10**400] * 4] * 4), "camera 'k2' has no rigid"),
        (_rig(_moved(1500.0)), "1500 m.*millimetres"),
        (_rig(_moved(90.0)), "likely in centimetres"),
        (_rig(_moved(1.0), "k2", "k3"), "'k2' and 'k3' are in one place"),
        (_rig(_moved(1.0)).replace("k2", "k1"), "'k1' is given twice"),
        (_rig(EYE, "../k2"), "rename"),
        (_rig(EYE, "k2\n"), "rename"),
    ],
)
def test_wrong_rig_files_are_refused(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "rig.json"
    path.write_text(content)
    with pytest.raises(UserError, match=words) as caught:
        read_extrinsics(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"R": [0, 0, 0]}, "T is None, expected finite numbers"),
        ({"R": [0, 0], "T": [0, 0, 0]}, "R is no rotation"),
        ({"R": [0, 0, float("nan")], "T": [0, 0, 0]}, "finite"),
        ({"R": [0, 0, 0], "T": [0, float("inf"), 0]}, "finite"),
        ({"R": [0, 0, 0], "T": [0, 1500, 0]}, "1500 m.*millimetres"),
        ({"R": [0, 90, 0], "T": [0, 1, 0]}, "length 90, expected radians"),
    ],
)
def test_wrong_release_files_are_refused(tmp_path: Path, content: object, words: str) -> None:
    (tmp_path / "Color.json").write_text('{"R": [0, 0, 0], "T": [0, 0, 0]}')
    (tmp_path / "Color_2.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=words) as caught:
        read_extrinsics(tmp_path)
    assert str(tmp_path / "Color_2.json") in str(caught.value)
