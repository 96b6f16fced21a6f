"""Named points of a body mesh: keypoint vertices, motion-capture markers, contact regions.

Those of the open body are in data/open_body_maps.json. SMPL-X's mesh of 10,475 vertices has
published vertex ids. Its contact regions are found on the T-posed template by rules that fit every
mesh in SMPL-X's format: skinning weights determine the limb of a vertex, normals its side. Lengths
scale with the bones of the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core.body.joints import JOINT_INDEX, JOINT_NAMES
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.surfaces import vertex_normals
from intercap_core.inputs.documents import read_json
from intercap_core.inputs.files import quoted

SMPLX_VERTICES = 10_475  # Pavlakos et al. 2019

# Vertex ids that the smplx package appends as joints 55 to 75 (its table of extra joints).
_SMPLX_POINTS = {
    "nose": 9120, "right_eye": 9929, "left_eye": 9448, "right_ear": 616, "left_ear": 6,
    "left_big_toe": 5770, "left_small_toe": 5780, "left_heel": 8846,
    "right_big_toe": 8463, "right_small_toe": 8474, "right_heel": 8635,
    "left_thumb": 5361, "left_index": 4933, "left_middle": 5058, "left_ring": 5169,
    "left_pinky": 5286,
    "right_thumb": 8079, "right_index": 7669, "right_middle": 7794, "right_ring": 7905,
    "right_pinky": 8022,
}  # fmt: skip

# Vertex ids of the 81 markers of the LEMO motion prior on SMPL-X: 67 of the SSM2 marker set, 4 of
# the face, 10 finger tips.
_SMPLX_MARKERS = {
    "C7": 3832, "CLAV": 5533, "LANK": 5882, "LFWT": 3486, "LBAK": 3336, "LBCEP": 4029,
    "LBSH": 4137, "LBUM": 5694, "LBUST": 3228, "LCHEECK": 2081, "LELB": 4302, "LELBIN": 4363,
    "LFIN": 4788, "LFRM2": 4379, "LFTHI": 3504, "LFTHIIN": 3998, "LHEE": 8846, "LIWR": 4726,
    "LKNE": 3682, "LKNI": 3688, "LMT1": 5890, "LMT5": 5901, "LNWST": 3260, "LOWR": 4722,
    "LBWT": 5697, "LRSTBEEF": 5838, "LSHO": 4481, "LTHI": 4088, "LTHMB": 4839, "LTIB": 3745,
    "LTOE": 5787, "MBLLY": 5942, "RANK": 8576, "RFWT": 6248, "RBAK": 6127, "RBCEP": 6776,
    "RBSH": 7192, "RBUM": 8388, "RBUSTLO": 8157, "RCHEECK": 8786, "RELB": 7040, "RELBIN": 7099,
    "RFIN": 7524, "RFRM2": 7115, "RFRM2IN": 7303, "RFTHI": 6265, "RFTHIIN": 6746, "RHEE": 8634,
    "RKNE": 6443, "RKNI": 6449, "RMT1": 8584, "RMT5": 8595, "RNWST": 6023, "ROWR": 7458,
    "RBWT": 8391, "RRSTBEEF": 8532, "RSHO": 6627, "RTHI": 6832, "RTHMB": 7575, "RTIB": 6503,
    "RTOE": 8481, "STRN": 5531, "T8": 5487, "LFHD": 707, "LBHD": 2026, "RFHD": 2198, "RBHD": 3066,
    "CHN1": 8757, "CHN2": 9066, "MTH3": 8985, "MTH7": 8947, "LIDX3": 4931, "LMID3": 5045,
    "LPNK3": 5268, "LRNG3": 5149, "LTHM4": 5346, "RIDX3": 7667, "RMID3": 7781, "RPNK3": 8001,
    "RRNG3": 7884, "RTHM4": 8082,
}  # fmt: skip
MARKER_NAMES: tuple[str, ...] = tuple(_SMPLX_MARKERS)
POINT_NAMES: tuple[str, ...] = tuple(_SMPLX_POINTS)
REGION_NAMES: tuple[str, ...] = (
    "left_hand", "right_hand", "left_foot", "right_foot", "left_thigh", "right_thigh", "seat",
    "back", "chest", "left_forearm", "right_forearm", "mouth", "left_shoulder", "right_shoulder",
)  # fmt: skip


@dataclass(frozen=True)
class BodyMaps:
    """Named points of a mesh."""

    points: dict[str, int]
    """Vertex id of each of `POINT_NAMES`."""
    markers: np.ndarray
    """(81,) vertex ids in the order of `MARKER_NAMES`."""
    regions: dict[str, np.ndarray] | None
    """Vertex ids by region; None = find them on the template."""


def maps_path(body_path: Path) -> Path:
    """Return the path of the maps of a body file."""
    return body_path.with_name(body_path.stem + "_maps.json")


def _vertex(value: object) -> int:
    if type(value) is not int:
        raise ValueError(f"{quoted(value, 40)} is not a vertex id")
    return value


def load_maps(body_path: Path, num_vertices: int) -> BodyMaps:
    """Read `<body>_maps.json` next to the body file, or return the published ids of SMPL-X."""
    path = maps_path(body_path)
    if path.exists():
        read = read_json(path)
        try:
            points = {name: _vertex(read["points"][name]) for name in POINT_NAMES}
            markers = np.array([_vertex(read["markers"][name]) for name in MARKER_NAMES])
            regions = {
                name: np.array([_vertex(i) for i in ids], int)
                for name, ids in read["regions"].items()
            }
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UserError(
                f"Body map {path} cannot be used ({quoted(error)}): expected the objects points, "
                "markers and regions, each with every name; compare it with the open body's map."
            ) from error
        used = [*points.values(), *markers, *(i for ids in regions.values() for i in ids)]
        if min(used) < 0 or max(used) >= num_vertices:
            raise UserError(
                f"Body map {path} names vertices outside the body's {num_vertices}: take the map "
                "that was made for this mesh."
            )
        return BodyMaps(points, markers, regions)
    if num_vertices == SMPLX_VERTICES:
        return BodyMaps(_SMPLX_POINTS, np.array(list(_SMPLX_MARKERS.values())), None)
    raise UserError(
        f"Body file {body_path} has {num_vertices} vertices, not SMPL-X's {SMPLX_VERTICES}, and no "
        f"{path.name} next to it: add that map, or use an SMPLX_*.npz file."
    )


def _inside_polygon(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Flag points (N,2) inside the closed polygon (M,2), by crossing number."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = points[:, :1], points[:, 1:]
    spans = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
    at = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise
    return ((spans & (x < at)).sum(1) % 2) == 1


def find_regions(
    vertices: np.ndarray,
    faces: np.ndarray,
    weights: np.ndarray,
    joints: np.ndarray,
    mouth_outline: np.ndarray,
) -> dict[str, np.ndarray]:
    """Return the vertex ids of each region, ascending.

    Regions are disjoint: a vertex belongs to the first region below that claims it. Shares are sums
    of skinning weights; limits of ``normals`` are cosines with the named direction.

    Args:
        vertices: (V, 3) of the T-posed template, y up, facing +z, metres.
        faces: (F, 3)
        weights: (V, 55)
        joints: (55, 3)
        mouth_outline: (12, 3) outer lip landmarks in order.
    """
    normals = vertex_normals(vertices, faces)
    at = {name: joints[i] for name, i in JOINT_INDEX.items()}

    def share(*names: str) -> np.ndarray:
        return weights[:, [JOINT_INDEX[n] for n in names]].sum(1)

    regions: dict[str, np.ndarray] = {}
    free = np.ones(len(vertices), bool)

    def claim(name: str, mask: np.ndarray) -> None:
        regions[name] = np.flatnonzero(mask & free)
        free[regions[name]] = False

    thigh_length = np.linalg.norm(at["left_knee"] - at["left_hip"])
    hip_y = (at["left_hip"][1] + at["right_hip"][1]) / 2
    torso = share("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar")

    outline = mouth_outline[:, :2]
    outline = outline.mean(0) + (outline - outline.mean(0)) * 1.06  # enlarged by 6 %
    front = vertices[:, 2] > mouth_outline[:, 2].min() - 0.012  # 12 mm behind the lips
    claim(
        "mouth",
        (share("head", "jaw") > 0.6)
        & front
        & (normals[:, 2] > 0)
        & _inside_polygon(vertices[:, :2], outline),
    )
    for side, out in (("left", 1.0), ("right", -1.0)):
        fingers = [n for n in JOINT_NAMES if n.startswith(f"{side}_") and n[-1] in "123"]
        hand = share(f"{side}_wrist", *fingers) > 0.5
        past_wrist = out * (vertices[:, 0] - at[f"{side}_wrist"][0]) > 0
        thumb = share(*(n for n in fingers if "thumb" in n)) > 0.5
        down = np.array([0.0, -1, 0])  # of palms in the T-pose
        # the pad of the thumb faces the little finger (-z) and down: a unit vector
        across = np.array([0.0, -0.55, -0.83])
        pad = np.where(thumb[:, None], across, down)
        claim(f"{side}_hand", hand & past_wrist & ((normals * pad).sum(1) > 0.15))
        claim(
            f"{side}_foot", (share(f"{side}_ankle", f"{side}_foot") > 0.5) & (normals[:, 1] < -0.5)
        )
    seat_low, seat_high = hip_y - 0.32 * thigh_length, hip_y + 0.18 * thigh_length
    legs = share("pelvis", "left_hip", "right_hip")
    claim(
        "seat",
        (legs > 0.5)
        & (vertices[:, 1] > seat_low)
        & (vertices[:, 1] < seat_high)
        & (normals[:, 2] < 0.1)
        & (vertices[:, 2] < joints[[1, 2], 2].mean()),  # behind the hips
    )
    arm_length = np.linalg.norm(at["left_elbow"] - at["left_shoulder"])
    for side, out in (("left", 1.0), ("right", -1.0)):
        near = np.linalg.norm(vertices - at[f"{side}_shoulder"], axis=1) < 0.42 * arm_length
        upper_outer = normals @ np.array([0.35 * out, 0.94, 0.0])  # up and slightly outward
        claim(
            f"{side}_shoulder",
            (share(f"{side}_collar", f"{side}_shoulder") > 0.4) & near & (upper_outer > 0.3),
        )
        claim(f"{side}_thigh", share(f"{side}_hip") > 0.5)
        claim(f"{side}_forearm", share(f"{side}_elbow") > 0.5)
    claim("back", (torso > 0.5) & (normals[:, 2] < -0.3) & (vertices[:, 1] > seat_high))
    claim("chest", (torso > 0.5) & (normals[:, 2] > 0.3) & (vertices[:, 1] > seat_high))
    return {name: regions[name] for name in REGION_NAMES}
