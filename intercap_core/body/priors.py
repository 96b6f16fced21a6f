"""Priors of equation 2 with analytic Jacobians, and the ranges of motion of the 55 joints.

E_theta_b and E_theta_f (:func:`rest_pose`), E_theta_h (:func:`hand_pose`), E_alpha
(:func:`bending`), and beyond the paper :func:`joint_limits`. E_beta and E_psi are standard normal.
All are weighted and summed in :mod:`intercap_core.body_fit.prior_term`; VPoser's E_theta_b is in
:mod:`.vposer`. The functions take parameter vectors (B,P) in the order of `BodyParameters.vector`
and return rows: residuals r with their Jacobian. A weight w contributes w^2 r^2 / 2, squared as in
SMPLify-X.

Ranges of motion are components of the axis-angle from the T-pose. They are the means plus about two
standard deviations of
- Soucie et al. 2011, "Range of motion measurements: reference values and a database for comparison
  studies", Haemophilia 17 (hip, knee, ankle, shoulder, elbow, adults);
- American Academy of Orthopaedic Surgeons 1965, "Joint Motion: Method of Measuring and Recording"
  (forearm, wrist, fingers, thumb, toes, neck);
- White and Panjabi 1990, "Clinical Biomechanics of the Spine" (thorax and lumbar spine, divided
  among the three spine joints).
Under the weight of a crouching person an ankle bends farther than in Soucie's passive measurement
(Rabin et al. 2015, "Weight-bearing ankle dorsiflexion range of motion", Journal of Athletic
Training): its range is 20 degrees larger. The components of a rotation vector are clinical angles
only for turns about one axis, so ball joints have 10 to 20 degrees more. Pronation is divided
between elbow and wrist.

Axes in the T-pose (x left, y up, z forward): about +x the trunk bends forward, the leg swings back,
the knee closes, the toes go down; about +z the left leg and the left arm go up to the side; about
-y the left arm swings forward and the left elbow closes; about -z the left fingers close.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX, JOINT_NAMES
from intercap_core.body.parameters import HAND_COLUMNS, NUM_POSE

# Elbows (y) and knees (x): column in the parameter vector, sign of the unnatural direction (Bogo et
# al. 2016, SMPLify).
BENDING = (
    (3 * JOINT_INDEX["left_elbow"] + 1, 1),
    (3 * JOINT_INDEX["right_elbow"] + 1, -1),
    (3 * JOINT_INDEX["left_knee"], -1),
    (3 * JOINT_INDEX["right_knee"], -1),
)

_Range = tuple[float, float]
_FREE: _Range = (-180.0, 180.0)
# Lower and upper limit of x, y, z in degrees. Limbs are left ones; right ones are mirrored: y and z
# change sign.
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

# Mean and standard deviation of x, y, z in degrees of the 25 joints that are not fingers: estimates
# of everyday poses, about a standing person with hanging arms. Limbs are left ones, as above.
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
    """Return the name of a joint in the tables, and whether it is on the right."""
    side, _, rest = joint.partition("_")
    if side not in ("left", "right"):
        return joint, False
    if rest[-1] in "123" and not rest.startswith("thumb"):
        rest = "finger" + rest[-1]
    return rest, side == "right"


def _limits(joint: str) -> tuple[_Range, _Range, _Range]:
    """Return lower and upper limit of x, y, z, degrees."""
    kind, mirror = _kind(joint)
    x, y, z = _TABLE[kind]
    if mirror:
        y, z = (-y[1], -y[0]), (-z[1], -z[0])
    return x, y, z


def _rest(joint: str) -> tuple[_Range, _Range, _Range]:
    """Return mean and standard deviation of x, y, z, degrees."""
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
"""(55, 3 axes, 2: lower and upper limit)"""
REST_SPREAD_DEG = tuple(_rest(joint) for joint in JOINT_NAMES)
"""(55, 3 axes, 2: mean and standard deviation); entries of fingers are not used."""


@dataclass(frozen=True)
class DiagonalRows:
    """Residuals of one parameter each."""

    residuals: Tensor
    """(B, R)"""
    slopes: Tensor
    """(B, R) derivatives by the parameter."""
    columns: Tensor
    """(R,) columns of the parameters."""


@dataclass(frozen=True)
class LinearRows:
    """Residuals with one Jacobian for all bodies."""

    residuals: Tensor
    """(B, R)"""
    jacobian: Tensor
    """(R, C)"""
    columns: Tensor
    """(C,) columns of the parameters."""


def joint_limits(vector: Tensor) -> DiagonalRows:
    """Distance of each axis-angle component from its anatomical range, rad (beyond the paper).

    r = max(theta - upper, 0) + min(theta - lower, 0), zero inside the range `LIMITS_DEG`.
    """
    table = torch.deg2rad(torch.tensor(LIMITS_DEG, dtype=vector.dtype, device=vector.device))
    pose = vector[:, 3:NUM_POSE]  # without the global orientation, joint 0
    lower, upper = table[1:, :, 0].reshape(-1), table[1:, :, 1].reshape(-1)
    residuals = (pose - upper).clamp(min=0) + (pose - lower).clamp(max=0)
    columns = torch.arange(3, NUM_POSE, device=vector.device)
    return DiagonalRows(residuals, (residuals != 0).to(vector.dtype), columns)


def bending(vector: Tensor) -> DiagonalRows:
    """E_alpha: penalty on elbows and knees that bend backward, r = exp(sign * theta)."""
    columns = torch.tensor([c for c, _ in BENDING], device=vector.device)
    sign = torch.tensor([float(s) for _, s in BENDING], dtype=vector.dtype, device=vector.device)
    residuals = torch.exp(sign * vector[:, columns])
    return DiagonalRows(residuals, sign * residuals, columns)


def rest_pose(vector: Tensor, *, first: int = 1) -> DiagonalRows:
    """E_theta_b (21 body joints) and E_theta_f (jaw, eyes) from joint ``first`` on.

    r = (theta - mean) / sigma with `REST_SPREAD_DEG`. The prior is weak: it determines only parts
    of the body without observations.
    """
    columns = torch.arange(3 * first, 75, device=vector.device)  # 75: the hands start
    table = torch.deg2rad(torch.tensor(REST_SPREAD_DEG, dtype=vector.dtype, device=vector.device))[
        first:25
    ].reshape(-1, 2)
    residuals = (vector[:, 3 * first : 75] - table[:, 0]) / table[:, 1]
    return DiagonalRows(residuals, (1 / table[:, 1]).expand_as(residuals), columns)


def hand_pose(
    vector: Tensor, mean: Tensor, components: Tensor, deviation: Tensor, *, side: int
) -> LinearRows:
    """E_theta_h: Gaussian over one hand's pose components, r = C (theta - mean) / deviation.

    mean (2,45), components (2,45,45) orthonormal rows, deviation (2,45) of the model; side 0 is the
    left hand.
    """
    at = HAND_COLUMNS[side]
    jacobian = components[side] / deviation[side, :, None]
    residuals = (vector[:, at] - mean[side]) @ jacobian.T
    return LinearRows(residuals, jacobian, torch.arange(at.start, at.stop, device=vector.device))
