"""Start of the fit: a rigid placement of the trunk, then a fit of 3D keypoints in each frame."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import BODY
from intercap_core.body.parameters import NUM_POSE, TRANSL
from intercap_core.body_fit.bridge import bridge
from intercap_core.body_fit.evidence import Evidence
from intercap_core.body_fit.observations import TRUNK_KEYPOINTS
from intercap_core.body_fit.problem import BodyProblem, columns_of
from intercap_core.body_fit.surface import COVERINGS
from intercap_core.body_fit.term_inputs import Targets
from intercap_core.geometry.solve.levenberg_marquardt import Solution, minimise

START_SIGMA_M = 0.04  # of a triangulated keypoint at the start of the fit; tuned on the studio


def place_trunk(rest: np.ndarray, joints: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
    """Align the rest body rigidly with triangulated keypoints, by least squares (Kabsch 1976).

    Args:
        rest: (K, 3) keypoints of the rest pose.
        joints: (T, K, 3) triangulated keypoints, NaN = unknown.
        pelvis: (3,) rest position of the pelvis, about which SMPL-X turns.

    Returns:
        (T, 6) rotation vectors and translations, NaN if fewer than three trunk keypoints are known.
    """
    result = np.full((len(joints), 6), np.nan)
    for t, frame in enumerate(joints[:, TRUNK_KEYPOINTS].astype(float)):
        known = np.isfinite(frame).all(1)
        if known.sum() < 3:
            continue
        source, target = rest[TRUNK_KEYPOINTS][known] - pelvis, frame[known]
        centre_s, centre_t = source.mean(0), target.mean(0)
        u, _, vt = np.linalg.svd((target - centre_t).T @ (source - centre_s))
        flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        rotation = u @ flip @ vt
        result[t, :3] = Rotation.from_matrix(rotation).as_rotvec()
        result[t, 3:] = centre_t - rotation @ centre_s - pelvis
    return result


def interpolate_unknown(placement: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return placements (N, 6), see :func:`place_trunk`, with unknown ones (NaN) interpolated.

    times (N,): seconds. At least one placement must be known.
    """
    known = np.isfinite(placement).all(1)
    vectors = np.zeros((len(placement), NUM_POSE + 3))
    vectors[:, :3], vectors[:, NUM_POSE:] = placement[:, :3], placement[:, 3:]
    filled = bridge(np.nan_to_num(vectors), known, times)
    return np.hstack([filled[:, :3], filled[:, NUM_POSE:]])


def turn_around(placement: np.ndarray) -> np.ndarray:
    """Return placements (T, 6) with the body rotated by 180 degrees about its vertical axis y."""
    result = placement.copy()
    known = np.isfinite(placement).all(1)
    turn = Rotation.from_rotvec([0.0, np.pi, 0.0])
    result[known, :3] = (Rotation.from_rotvec(placement[known, :3]) * turn).as_rotvec()
    return result


def fit_start(evidence: Evidence, problem: BodyProblem) -> torch.Tensor:
    """Return parameters (N, P) fitted to the triangulated body keypoints of each frame.

    ``problem`` provides the keypoints, offsets and terms; each frame has its own shape. Frames that
    cost more than 1.5 times the median (tuned on the studio) are also tried facing the other way.
    """
    model = evidence.model
    rest = model.zeros()
    keypoints = model.keypoints_of(rest)[0].double().numpy()
    pelvis = model.forward(rest, vertex_ids=np.array([0])).joints[0, 0].double().numpy()
    joints = evidence.observations.joints[evidence.frames]
    placed = interpolate_unknown(
        place_trunk(keypoints, joints, pelvis), evidence.observations.times[evidence.frames]
    )
    straight = _fit_triangulated(problem, placed, joints)
    poor = np.flatnonzero((straight.cost > 1.5 * straight.cost.median()).numpy())
    if len(poor):
        turned = _fit_triangulated(problem, turn_around(placed[poor]), joints[poor])
        better = turned.cost < straight.cost[poor]
        straight.own[poor[better.numpy()]] = turned.own[better]
    return straight.own


def _fit_triangulated(problem: BodyProblem, placed: np.ndarray, joints: np.ndarray) -> Solution:
    """Fit n bodies to triangulated keypoints.

    Args:
        problem: provides the model, keypoints, offsets and terms.
        placed: (n, 6) placements at the start.
        joints: (n, K, 3) keypoints, NaN = unknown.

    Returns:
        The solution, whose ``own`` are whole parameter vectors (n, P).
    """
    model = problem.model

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(values, dtype=model.dtype)

    base = model.zeros(len(placed)).vector().clone()
    base[:, 75:120], base[:, 120:165] = model.hand_mean[0], model.hand_mean[1]  # left, right
    base[:, 0:3], base[:, TRANSL] = tensor(placed[:, :3]), tensor(placed[:, 3:])
    for name, sign in (("left_shoulder", -1.0), ("right_shoulder", 1.0)):
        base[:, 3 * JOINT_INDEX[name] + 2] = sign * 0.8  # rad about z: lowers the arms
    joints = joints[:, BODY]
    known = np.isfinite(joints).all(2)
    own = BodyProblem(
        model=model,
        keypoints=problem.keypoints,
        samples=problem.samples,
        base=base,
        columns=columns_of(model, hands=False, face=False, betas=True),
        one_shape=False,
        offsets=problem.offsets,
        u=base.new_zeros(len(COVERINGS)),
        targets=Targets(tensor(np.nan_to_num(joints)), tensor(known), START_SIGMA_M),
        terms=problem.terms,
    )
    solution = minimise(own, own.own_start(), max_trials=15, cost_tolerance=1e-2)
    own.accept(solution.own, solution.shared)
    solution.own = own.base
    return solution
