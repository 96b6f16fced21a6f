"""A recording played forward and backward: every frame's rows, and what is stored end to end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.stage_resources import _nearest_sets, lengthen, there_and_back
from intercap_core import artefacts
from intercap_core.artefacts import pack_ragged, unpack_ragged
from intercap_core.errors import UserError
from intercap_core.schemas import PERSON

VIEWS = 2


def _write(path: Path, frames: int) -> None:
    """A person whose every row and mask says which frame and view it is of."""
    rng = np.random.default_rng(0)
    masks = [b"" if i == 1 else f"{i:b}".encode() for i in range(frames * VIEWS)]
    rles = [bytes([i]) * (i % 3) for i in range(frames)]  # a candidate in each first view
    with artefacts.write(
        path, PERSON, sequence="s", images_alone=True, chosen_by="alone", doubts=""
    ) as writer:
        writer.put("camera_names", ["k1", "k2"])
        offsets, data = pack_ragged(masks)
        writer.put("mask_offsets", offsets)
        writer.put("mask_rle", data)
        writer.put("candidate_offsets", np.repeat(np.arange(frames + 1), VIEWS)[1:])
        for name in ("candidate_scores", "candidate_extents", "candidate_things"):
            writer.put(name, np.arange(frames))
        offsets, data = pack_ragged(rles)
        writer.put("candidate_rle_offsets", offsets)
        writer.put("candidate_rle", data)
        writer.put("missing", np.zeros(frames, bool))
        for name, shape in {
            "person": (VIEWS,), "keypoints": (VIEWS, 135, 3), "joints": (135, 3),
            "joint_views": (135,), "joint_error": (135,), "inlier": (VIEWS, 135),
            "mask_source": (VIEWS,), "others": (),
        }.items():  # fmt: skip
            writer.put(name, rng.integers(0, 2, (frames, *shape)))


def test_frames_go_there_and_back() -> None:
    assert there_and_back(4, 9).tolist() == [0, 1, 2, 3, 2, 1, 0, 1, 2]
    assert there_and_back(2, 5).tolist() == [0, 1, 0, 1, 0]
    assert (np.abs(np.diff(there_and_back(45, 1000))) == 1).all()


def test_rows_masks_and_candidates_follow_their_frames(tmp_path: Path) -> None:
    source, output = tmp_path / "short.h5", tmp_path / "person.h5"
    _write(source, 4)
    lengthen(source, "person", output, 9)
    order = there_and_back(4, 9)
    with artefacts.read(source, PERSON) as short, artefacts.read(output, PERSON) as long:
        for key in ("keypoints", "joints", "person", "inlier", "mask_source"):
            assert np.array_equal(long[key], short[key][order])
        before, after = (
            unpack_ragged(one["mask_offsets"], one["mask_rle"]) for one in (short, long)
        )
        assert after == [before[t * VIEWS + c] for t in order for c in range(VIEWS)]
        assert long["candidate_scores"].tolist() == order.tolist()
        before, after = (
            unpack_ragged(one["candidate_rle_offsets"], one["candidate_rle"])
            for one in (short, long)
        )
        assert after == [before[t] for t in order]


def test_images_are_of_the_nearest_set_that_has_them() -> None:
    order = there_and_back(4, 7)  # 0 1 2 3 2 1 0
    image_of = np.array([[0], [0], [1], [-1]])  # a camera that is a set late
    assert _nearest_sets(image_of, order)[:, 0].tolist() == [0, 0, 1, -1, 5, 6, 6]


def test_one_frame_cannot_be_played_back(tmp_path: Path) -> None:
    _write(tmp_path / "one.h5", 1)
    with pytest.raises(UserError, match="has 1 frame"):
        lengthen(tmp_path / "one.h5", "person", tmp_path / "long.h5", 5)
