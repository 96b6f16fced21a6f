"""A body in motion as little data: its skeleton's transforms, and what skinning leaves out.

A vertex is skinned by its four strongest weights, as viewers do. What that leaves out (weights cut
off, pose correctives, a shape or an expression that changes) is brought to the rest pose and kept
as a few modes over all vertices, each with a number a frame: a truncated singular value
decomposition, with as many modes as bring every vertex near enough.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import PARENTS
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters

WEIGHTS = 4
CLOSE_M = 0.001  # how far a vertex may be from the model's
_MOST_MODES = 64
_BATCH = 32
_STEPS = 32767  # of a mode's largest coordinate: int16


@dataclass(frozen=True, eq=False)
class SkinnedBody:
    """``rest`` (V, 3) vertices; ``joints`` (V, 4) indices and ``weights`` (V, 4), rows of sum 1;
    ``transforms`` (T, 55, 3, 4) rest to posed; ``modes`` (K, V, 3) with ``amounts`` (T, K).

    posed = sum_k weights_k A_k (rest + sum_m amounts_m modes_m), metres. ``error_m``: how far the
    worst vertex of all frames is from the model's.
    """

    rest: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    transforms: np.ndarray
    modes: np.ndarray
    amounts: np.ndarray
    error_m: float

    def posed(self, t: int) -> np.ndarray:
        """Vertices (V, 3) of frame ``t``, as a viewer computes them."""
        shaped = self.rest + np.tensordot(self.amounts[t], self.modes, 1)
        return _skin(shaped, self.transforms[t], self.joints, self.weights)


def skinned(model: BodyModel, parameters: BodyParameters) -> SkinnedBody:
    """Compress T posed bodies, in the frame that ``parameters`` are in."""
    rest, rest_joints = _rest(model, parameters)
    all_weights = model.skinning_weights.cpu().numpy().astype(np.float64)
    strongest = np.argsort(-all_weights, axis=1, kind="stable")[:, :WEIGHTS]
    weights = np.take_along_axis(all_weights, strongest, 1)
    weights /= weights.sum(1, keepdims=True)
    vertices, joints = _posed(model, parameters)
    turns = _global_rotations(parameters.full_pose().cpu().numpy())
    shifts = joints - np.einsum("tjab,jb->tja", turns, rest_joints)
    transforms = np.concatenate([turns, shifts[..., None]], 3)
    left_out = np.stack(
        [
            _unskinned(vertices[t], transforms[t], strongest, weights) - rest
            for t in range(len(vertices))
        ]
    )
    # The mean goes to the rest pose, so that a shape that stays needs no mode.
    rest = rest + left_out.mean(0)
    left_out -= left_out.mean(0)
    modes, amounts, error = _modes(left_out)
    return SkinnedBody(rest, strongest, weights, transforms, modes, amounts, error)


def _rest(model: BodyModel, parameters: BodyParameters) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and joints (55, 3) of the first frame's shape in the T-pose."""
    params = replace(
        model.zeros(1), betas=parameters.betas[:1], expression=parameters.expression[:1]
    )
    with torch.no_grad():
        posed = model.forward(params)
    return posed.vertices[0].double().numpy(), posed.joints[0].double().numpy()


def _posed(model: BodyModel, parameters: BodyParameters) -> tuple[np.ndarray, np.ndarray]:
    vertices, joints = [], []
    with torch.no_grad():
        for first in range(0, parameters.batch, _BATCH):
            posed = model.forward(parameters.frames(slice(first, first + _BATCH)))
            vertices.append(posed.vertices.double().numpy())
            joints.append(posed.joints.double().numpy())
    return np.concatenate(vertices), np.concatenate(joints)


def _global_rotations(pose: np.ndarray) -> np.ndarray:
    """(T, 55, 3, 3) of the pose (T, 55, 3), rotation vectors relative to each joint's parent."""
    local = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix().reshape(*pose.shape, 3)
    turns = local.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            turns[:, joint] = turns[:, parent] @ local[:, joint]
    return turns


def _blended(transforms: np.ndarray, joints: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.einsum("vk,vkab->vab", weights, transforms[joints])


def _skin(
    points: np.ndarray, transforms: np.ndarray, joints: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    blended = _blended(transforms, joints, weights)
    return np.einsum("vab,vb->va", blended[..., :3], points) + blended[..., 3]


def _unskinned(
    points: np.ndarray, transforms: np.ndarray, joints: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """The rest points that skinning brings to ``points`` (V, 3)."""
    blended = _blended(transforms, joints, weights)
    return np.linalg.solve(blended[..., :3], (points - blended[..., 3])[..., None])[..., 0]


def _modes(left_out: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The fewest modes (K, V, 3) and amounts (T, K) that leave no vertex beyond CLOSE_M, and what
    the worst vertex is then off by, metres."""
    frames = len(left_out)
    rows = left_out.reshape(frames, -1)
    # of the small matrix over frames: as precise as float64 needs to be for a tenth of a millimetre
    values, vectors = np.linalg.eigh(rows @ rows.T)
    order = np.argsort(values)[::-1]
    kept = [k for k in order[:_MOST_MODES] if values[k] > 0]
    remaining = rows.copy()
    modes, amounts = [], []
    for k in kept:
        if _worst(remaining) <= CLOSE_M:
            break
        amount = vectors[:, k]
        mode = amount @ rows
        largest = np.abs(mode).max()
        if largest < 1e-9:
            break
        mode = np.rint(mode / largest * _STEPS) / _STEPS  # as it is stored
        modes.append(mode)
        amounts.append(amount * largest)
        remaining -= np.outer(amounts[-1], mode)
    shape = (len(modes), *left_out.shape[1:])
    return (
        np.array(modes).reshape(shape),
        np.array(amounts).reshape(len(modes), frames).T,
        float(_worst(remaining)),
    )


def _worst(rows: np.ndarray) -> float:
    return float(np.sqrt((rows.reshape(len(rows), -1, 3) ** 2).sum(2).max(initial=0.0)))
