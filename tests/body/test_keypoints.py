from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from intercap_core.body.keypoints import FACE, KEYPOINT_NAMES, LEFT_HAND
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.maps import (
    MARKER_NAMES,
    POINT_NAMES,
    REGION_NAMES,
    SMPLX_VERTICES,
    load_maps,
    maps_path,
)
from intercap_core.body.model import BodyModel

from .conftest import open_arrays


def _mirror(name: str) -> str:
    if name.startswith("face_"):
        i = int(name[5:])
        pairs = dict(enumerate(range(16, -1, -1)))
        for low, high in ((17, 26), (31, 35), (48, 54), (60, 64)):
            pairs |= {low + k: high - k for k in range(high - low + 1)}
        pairs |= {55 + k: 59 - k for k in range(5)} | {65 + k: 67 - k for k in range(3)}
        pairs |= {36: 45, 37: 44, 38: 43, 39: 42, 40: 47, 41: 46}
        pairs |= {v: k for k, v in pairs.items()}
        return f"face_{pairs.get(i, i)}"
    if name.startswith("left_"):
        return "right_" + name[5:]
    return "left_" + name[6:] if name.startswith("right_") else name


def test_order_and_names() -> None:
    assert len(KEYPOINT_NAMES) == len(set(KEYPOINT_NAMES)) == 135
    assert KEYPOINT_NAMES[:3] == ("nose", "neck", "right_shoulder")
    assert KEYPOINT_NAMES[8] == "mid_hip"
    assert KEYPOINT_NAMES[25 + 4] == "left_thumb_tip"
    assert KEYPOINT_NAMES[46 + 20] == "right_pinky_tip"
    assert KEYPOINT_NAMES[67] == "face_17" and KEYPOINT_NAMES[-1] == "face_16"
    assert (LEFT_HAND.stop, FACE.stop) == (46, 118)


def test_the_two_sides_mirror_each_other(body64: BodyModel) -> None:
    at = dict(zip(KEYPOINT_NAMES, body64.keypoints_of(body64.zeros())[0].numpy(), strict=True))
    for name, point in at.items():
        gap = np.linalg.norm(point * [-1, 1, 1] - at[_mirror(name)])
        assert gap < 0.008, (name, gap)


def test_points_are_where_their_names_say(body64: BodyModel) -> None:
    at = dict(zip(KEYPOINT_NAMES, body64.keypoints_of(body64.zeros())[0].numpy(), strict=True))
    template = body64.template.numpy()
    assert at["nose"][2] > template[:, 2].max() - 0.02
    assert at["left_eye"][1] > at["nose"][1] > at["face_8"][1]
    assert at["left_ear"][0] > at["left_eye"][0] > 0 > at["right_eye"][0]
    assert at["left_big_toe"][2] > at["left_heel"][2] + 0.18
    assert at["left_small_toe"][0] > at["left_big_toe"][0]
    assert min(at["left_heel"][1], at["right_big_toe"][1]) < template[:, 1].min() + 0.04
    for side, sign in (("left", 1), ("right", -1)):
        wrist = at[f"{side}_hand_wrist"]
        for finger in ("index", "middle", "ring", "pinky"):
            chain = [at[f"{side}_{finger}{i}"] for i in (1, 2, 3)] + [at[f"{side}_{finger}_tip"]]
            reach = [sign * (p - wrist)[0] for p in chain]
            assert reach == sorted(reach) and reach[-1] < 0.25
            assert 0.01 < np.linalg.norm(chain[3] - chain[2]) < 0.04
    # dlib: brows over eyes over nose over mouth over chin, the person's right first
    assert at["face_19"][1] > at["face_37"][1] > at["face_33"][1] > at["face_62"][1]
    assert at["face_57"][1] > at["face_8"][1]
    assert at["face_36"][0] < at["face_39"][0] < at["face_42"][0] < at["face_45"][0]
    assert at["face_48"][0] < at["face_51"][0] < at["face_54"][0]
    assert at["face_30"][2] > at["face_27"][2]


def test_regions_are_disjoint_and_on_the_right_part(body64: BodyModel) -> None:
    regions, weights = body64.regions, body64.skinning_weights.numpy()
    template = body64.template.numpy()
    assert tuple(regions) == REGION_NAMES
    ids = np.concatenate(list(regions.values()))
    assert len(ids) == len(np.unique(ids))
    for side, sign in (("left", 1), ("right", -1)):
        assert (sign * template[regions[f"{side}_hand"], 0]).min() > 0.6
        assert len(regions[f"{side}_hand"]) == len(regions["left_hand"])
        assert template[regions[f"{side}_foot"], 1].max() < template[:, 1].min() + 0.06
    assert weights[regions["left_thigh"], 1].min() > 0.5
    assert template[regions["chest"], 2].mean() > template[regions["back"], 2].mean() + 0.15
    assert np.ptp(template[regions["mouth"]], axis=0).max() < 0.07
    assert template[regions["seat"], 1].max() < template[regions["back"], 1].min() + 0.02


def test_maps_name_every_point_and_marker(body64: BodyModel) -> None:
    assert len(MARKER_NAMES) == 81 and len(body64.markers) == 81
    read = json.loads(maps_path(OPEN_BODY).read_text())
    assert set(read["points"]) == set(POINT_NAMES)
    known = load_maps(Path("SMPLX_MALE.npz"), SMPLX_VERTICES)
    assert len(set(known.markers)) == 81 and max(known.points.values()) < 10_475
    at = dict(zip(MARKER_NAMES, body64.template.numpy()[body64.markers], strict=True))
    for name, point in at.items():
        if name[0] == "L" and "R" + name[1:] in at:
            assert np.linalg.norm(point * [-1, 1, 1] - at["R" + name[1:]]) < 0.03, name
    assert at["C7"][2] < at["CLAV"][2] and at["LHEE"][2] < at["LTOE"][2]
    assert at["LKNE"][0] > at["LKNI"][0] and at["LSHO"][1] > at["LELB"][1]
    assert at["LFHD"][1] > at["LSHO"][1] > at["LFWT"][1] > at["LKNE"][1] > at["LANK"][1]


def test_a_mesh_of_smplx_size_uses_the_published_vertex_ids(tmp_path: Path) -> None:
    """The open body cut to 10,475 vertices stands in for the licensed file: only ids are tested."""
    arrays = open_arrays()
    keep = 10_475
    faces = arrays["f"].astype(np.int64)
    for name in ("v_template", "shapedirs", "weights"):
        arrays[name] = arrays[name][:keep]
    arrays["posedirs"] = np.zeros((keep, 3, 486), np.float32)
    arrays["J_regressor"] = arrays["J_regressor"][:, :keep]
    arrays["f"] = faces[(faces < keep).all(1)]
    for name in ("lmk_faces_idx", "dynamic_lmk_faces_idx"):
        arrays[name] = np.zeros_like(arrays[name])
    path = tmp_path / "SMPLX_FEMALE.npz"
    np.savez(path, **arrays)
    model = BodyModel.load(path)
    points = model.keypoints_of(model.zeros())[0]
    assert torch.allclose(points[0], model.template[9120])
    assert torch.allclose(points[25 + 4], model.template[5361])
    assert model.markers[0] == 3832
    assert tuple(model.regions) == REGION_NAMES
