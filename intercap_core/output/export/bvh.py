"""The body's skeleton as a BVH file: 55 joints with the offsets of the fitted shape, and hands.

BVH states neither units nor axes. These files are in centimetres, y up, as those of CMU and LAFAN1,
and in degrees. The hierarchy's rest pose is SMPL-X's T-pose, facing +z. The object is not
included, because readers expect a single root.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_NAMES, PARENTS
from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.motion import Coordinates, Motion, rest_body

UNITS = "centimetres, degrees, seconds"
_CM = 100.0
_YUP_FROM_ZUP = rigid(Rotation.from_euler("x", -90, degrees=True).as_matrix(), np.zeros(3))
# Ends of bones without a child joint; BVH requires an "End Site" for them. Jaw and eyes have none.
_TIPS = {
    **{f"{side}_{finger}3": f"{side}_{finger}_tip"
       for side in ("left", "right") for finger in ("thumb", "index", "middle", "ring", "pinky")},
    "left_foot": "left_big_toe",
    "right_foot": "right_big_toe",
}  # fmt: skip
_AHEAD = np.array([0.0, 0.0, 0.01])  # metres; end of jaw and eyes, which has no meaning
_CHILDREN = {
    joint: [child for child, parent in enumerate(PARENTS) if parent == joint]
    for joint in range(len(PARENTS))
}


def _bvh_text(motion: Motion) -> str:
    """Serialize a motion whose frame has y up.

    The root has six channels, x, y, z in centimetres and three angles; the other joints have
    three. A rotation is Rz Rx Ry by the angles of the channels Zrotation, Xrotation, Yrotation.
    """
    rest = rest_body(motion.model, motion.parameters)
    joints = rest.joints[0].double().numpy()
    keypoints = motion.model.keypoints(rest)[0].double().numpy()
    order: list[int] = []
    hierarchy = "\n".join(_joint_lines(0, "", joints, keypoints, order))
    poses = motion.parameters.full_pose().double().numpy()
    turns = [Rotation.from_rotvec(poses[:, joint]).as_euler("ZXY", degrees=True) for joint in order]
    # continuous in time, because programs interpolate each channel alone
    angles = [np.unwrap(turn, axis=0, period=360) for turn in turns]
    root = _CM * (motion.parameters.transl.numpy() + motion.pelvis)
    rows = np.concatenate([root, *angles], axis=1)
    frames = "\n".join(" ".join(f"{value:.6f}" for value in row) for row in rows)
    return (
        f"HIERARCHY\n{hierarchy}\nMOTION\nFrames: {len(rows)}\n"
        f"Frame Time: {1 / motion.fps:.9f}\n{frames}\n"
    )


def _joint_lines(
    joint: int, indent: str, joints: np.ndarray, keypoints: np.ndarray, order: list[int]
) -> Iterator[str]:
    """Yield the lines of a joint and of those below it; appends their numbers to ``order``."""
    order.append(joint)
    name, parent = JOINT_NAMES[joint], PARENTS[joint]
    is_root = parent < 0
    offset = np.zeros(3) if is_root else joints[joint] - joints[parent]
    yield f"{indent}{'ROOT' if is_root else 'JOINT'} {name}"
    yield f"{indent}{{"
    inner = indent + "\t"
    yield f"{inner}OFFSET {_numbers(offset)}"
    position = "6 Xposition Yposition Zposition" if is_root else "3"
    yield f"{inner}CHANNELS {position} Zrotation Xrotation Yrotation"
    for child in _CHILDREN[joint]:
        yield from _joint_lines(child, inner, joints, keypoints, order)
    if not _CHILDREN[joint]:
        tip = _TIPS.get(name)
        end = keypoints[KEYPOINT_INDEX[tip]] - joints[joint] if tip else _AHEAD
        yield f"{inner}End Site"
        yield f"{inner}{{"
        yield f"{inner}\tOFFSET {_numbers(end)}"
        yield f"{inner}}}"
    yield f"{indent}}}"


def _numbers(metres: np.ndarray) -> str:
    return " ".join(f"{_CM * value:.6f}" for value in metres)


def _write(folder: Path, content: Content) -> Coordinates:
    frame = f"y up, turned by -90 degrees about x from: {content.z_up.frame}"
    motion = content.z_up.moved(_YUP_FROM_ZUP, frame)
    coordinates = Coordinates.of(motion, UNITS)
    (folder / f"{motion.sequence}.bvh").write_text(_bvh_text(motion), encoding="ascii")
    content.about.write_json(folder / "about.json", coordinates)
    return coordinates


_README = """
bvh/*.bvh           skeleton of the body (55 joints, hands included); centimetres, degrees, y up
  ground at y = 0 if a floor is known; offsets of the first frame's shape in the T-pose
  rotations are Rz Rx Ry; joints are named as in SMPL-X; the object is not included
bvh/about.json      the body file, and the facts about each frame, below
"""
FORMATS = (
    ExportFormat(
        name="bvh",
        content="skeleton with hands, centimetres, y up",
        includes="*/export/bvh/*.bvh",
        media_type="text/plain",
        readme=_README,
        write=_write,
    ),
)
