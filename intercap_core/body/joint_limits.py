"""Ranges of motion of the 55 joints, as components of the axis-angle from the T-pose.

Ranges are the means plus about two standard deviations of
- Soucie et al. 2011, "Range of motion measurements: reference values and a database for comparison
  studies", Haemophilia 17 (hip, knee, ankle, shoulder, elbow, adults);
- American Academy of Orthopaedic Surgeons 1965, "Joint Motion: Method of Measuring and Recording"
  (forearm, wrist, fingers, thumb, toes, neck);
- White and Panjabi 1990, "Clinical Biomechanics of the Spine" (thorax and lumbar spine, shared out
  over the three spine joints).
Under the weight of somebody who crouches an ankle bends up farther than in Soucie's passive
measurement (Rabin et al. 2015, "Weight-bearing ankle dorsiflexion range of motion", Journal of
Athletic Training): it gets 20 degrees more room.
The rotation vector's components are clinical angles only for turns about one axis, so ball joints
get 10 to 20 degrees of room. Pronation is shared by elbow and wrist.

Axes in the T-pose (x left, y up, z forward): about +x the trunk bends forward, the leg swings back,
the knee closes, the toes go down; about +z the left leg and the left arm go up to the side; about
-y the left arm swings forward and the left elbow closes; about -z the left fingers close.
"""

from __future__ import annotations

from intercap_core.body.joints import JOINT_NAMES

_Range = tuple[float, float]
_FREE: _Range = (-180.0, 180.0)
# x, y, z in degrees; left limbs (right ones are mirrored: y and z change sign)
_TABLE: dict[str, tuple[_Range, _Range, _Range]] = {
    "pelvis": (_FREE, _FREE, _FREE),
    "spine1": ((-20, 45), (-15, 15), (-20, 20)),
    "spine2": ((-15, 35), (-20, 20), (-20, 20)),
    "spine3": ((-15, 25), (-25, 25), (-20, 20)),
    "neck": ((-35, 40), (-45, 45), (-30, 30)),
    "head": ((-35, 30), (-45, 45), (-25, 25)),
    "jaw": ((-3, 32), (-8, 8), (-5, 5)),
    "eye_smplhf": ((-40, 40), (-45, 45), (-8, 8)),
    "collar": ((-20, 20), (-35, 30), (-15, 40)),
    "shoulder": ((-100, 100), (-145, 55), (-115, 95)),
    "elbow": ((-90, 90), (-155, 6), (-25, 25)),
    "wrist": ((-70, 70), (-30, 45), (-90, 80)),
    "hip": ((-135, 35), (-55, 55), (-40, 60)),
    "knee": ((-5, 155), (-25, 25), (-12, 12)),
    "ankle": ((-55, 60), (-30, 30), (-40, 40)),
    "foot": ((-75, 45), (-8, 8), (-8, 8)),
    "finger1": ((-35, 35), (-30, 30), (-95, 30)),
    "finger2": ((-30, 30), (-12, 12), (-112, 6)),
    "finger3": ((-30, 30), (-12, 12), (-85, 15)),
    "thumb1": ((-60, 70), (-60, 60), (-60, 60)),
    "thumb2": ((-45, 45), (-30, 65), (-65, 40)),
    "thumb3": ((-50, 50), (-30, 85), (-85, 40)),
}  # fmt: skip

# Mean and spread in degrees of the 25 joints that are no fingers: arms hang (SMPL-X rests in a T)
_REST: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "shoulder": ((10, 40), (-20, 45), (-55, 40)),
    "elbow": ((0, 30), (-40, 45), (0, 12)),
    "wrist": ((0, 25), (0, 15), (0, 25)),
    "collar": ((0, 8), (0, 10), (-5, 10)),
    "hip": ((-15, 40), (0, 20), (0, 15)),
    "knee": ((20, 40), (0, 8), (0, 5)),
    "ankle": ((0, 20), (0, 12), (0, 12)),
    "foot": ((0, 15), (0, 3), (0, 3)),
    "spine": ((5, 12), (0, 10), (0, 8)),
    "neck": ((5, 15), (0, 20), (0, 10)),
    "head": ((0, 15), (0, 20), (0, 10)),
    "jaw": ((3, 6), (0, 2), (0, 1)),
    "eye_smplhf": ((0, 12), (0, 15), (0, 2)),
    "pelvis": ((0, 180), (0, 180), (0, 180)),
}  # fmt: skip


def _kind(joint: str) -> tuple[str, bool]:
    """The table's name for a joint, and whether it is on the right."""
    side, _, rest = joint.partition("_")
    if side not in ("left", "right"):
        return joint, False
    if rest[-1] in "123" and not rest.startswith("thumb"):
        rest = "finger" + rest[-1]
    return rest, side == "right"


def _limits(joint: str) -> tuple[_Range, _Range, _Range]:
    kind, mirror = _kind(joint)
    x, y, z = _TABLE[kind]
    if mirror:
        y, z = (-y[1], -y[0]), (-z[1], -z[0])
    return x, y, z


def _rest(joint: str) -> tuple[_Range, _Range, _Range]:
    kind, mirror = _kind(joint)
    if kind.startswith("spine"):
        kind = "spine"
    if kind not in _REST:
        return ((0, 180), (0, 180), (0, 180))
    x, y, z = _REST[kind]
    if mirror:
        y, z = (-y[0], y[1]), (-z[0], z[1])
    return x, y, z


LIMITS_DEG = tuple(_limits(joint) for joint in JOINT_NAMES)
"""(55, 3 axes, lower and upper)"""
REST_SPREAD_DEG = tuple(_rest(joint) for joint in JOINT_NAMES)
"""(55, 3 axes, mean and spread)"""
