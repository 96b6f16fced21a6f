"""Compact body motion: transforms of the skeleton, and modes of the residual of skinning.

Vertices are skinned by their four largest weights. The residual (smaller weights, pose correctives,
changes of shape or expression) is transformed to the rest pose and approximated by a truncated
singular value decomposition: modes over all vertices with an amount per frame. Modes are added,
largest singular value first, until every vertex is within ``CLOSE_M``, at most ``_MOST_MODES``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import PARENTS
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.output.export.motion import posed_batches, rest_pose

CLOSE_M = 0.001  # largest distance of a vertex from the model's
_MOST_MODES = 64


@dataclass(frozen=True, eq=False)
class SkinnedBody:
    """Body motion: posed = sum_k weights_k A_k (rest + sum_m amounts_m modes_m), metres."""

    rest: np.ndarray
    """(V, 3) vertices in the rest pose: shape of the first frame, plus the mean residual."""
    joints: np.ndarray
    """(V, 4) indices of the joints that move each vertex."""
    weights: np.ndarray
    """(V, 4) with rows of sum 1."""
    transforms: np.ndarray
    """A: (T, 55, 3, 4) posed_from_rest of the joints."""
    modes: np.ndarray
    """(K, V, 3) displacements of the vertices in the rest pose."""
    amounts: np.ndarray
    """(T, K) factor of each mode in each frame."""
    error_m: float
    """Largest distance of a vertex from the model's, over all frames."""

    def posed(self, t: int) -> np.ndarray:
        """Return the vertices (V, 3) of frame ``t``, as the viewer computes them."""
        shaped = self.rest + np.tensordot(self.amounts[t], self.modes, 1)
        return _skin(shaped, self.transforms[t], self.joints, self.weights)


def skinned(model: BodyModel, parameters: BodyParameters) -> SkinnedBody:
    """Compress T posed bodies in the frame of the parameters."""
    rest, rest_joints = rest_pose(model, parameters)
    all_weights = model.skinning_weights.numpy().astype(np.float64)
    strongest = np.argsort(-all_weights, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(all_weights, strongest, 1)
    weights /= weights.sum(1, keepdims=True)
    batches = list(posed_batches(model, parameters))
    vertices = np.concatenate([posed.vertices.double().numpy() for posed in batches])
    joints = np.concatenate([posed.joints.double().numpy() for posed in batches])
    turns = _global_rotations(parameters.full_pose().numpy())
    shifts = joints - np.einsum("tjab,jb->tja", turns, rest_joints)
    transforms = np.concatenate([turns, shifts[..., None]], 3)
    residual = np.stack(
        [
            _unskinned(vertices[t], transforms[t], strongest, weights) - rest
            for t in range(len(vertices))
        ]
    )
    # A constant residual belongs to the rest pose and needs no mode.
    rest = rest + residual.mean(0)
    residual -= residual.mean(0)
    modes, amounts, error = _modes(residual)
    return SkinnedBody(rest, strongest, weights, transforms, modes, amounts, error)


def _global_rotations(pose: np.ndarray) -> np.ndarray:
    """Compose rotation vectors (T, 55, 3) relative to the parents to rotations (T, 55, 3, 3)."""
    local = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix().reshape(*pose.shape, 3)
    turns = local.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            turns[:, joint] = turns[:, parent] @ local[:, joint]
    return turns


def _blended(transforms: np.ndarray, joints: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Blend the joints' transforms (55, 3, 4) to one transform (V, 3, 4) of each vertex."""
    return np.einsum("vk,vkab->vab", weights, transforms[joints])


def _skin(
    points: np.ndarray, transforms: np.ndarray, joints: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    blended = _blended(transforms, joints, weights)
    return np.einsum("vab,vb->va", blended[..., :3], points) + blended[..., 3]


def _unskinned(
    points: np.ndarray, transforms: np.ndarray, joints: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Return the rest points that skinning maps to ``points`` (V, 3)."""
    blended = _blended(transforms, joints, weights)
    return np.linalg.solve(blended[..., :3], (points - blended[..., 3])[..., None])[..., 0]


def _modes(residual: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Approximate residuals (T, V, 3) by the leading singular vectors.

    Returns modes (K, V, 3), amounts (T, K) and the largest remaining distance, metres. It exceeds
    ``CLOSE_M`` only if ``_MOST_MODES`` modes do not suffice.
    """
    frames = len(residual)
    rows = residual.reshape(frames, -1)
    # Eigenvectors of the (T, T) Gram matrix are the left singular vectors. Squaring the singular
    # values costs precision, but float64 leaves a tenth of a millimetre.
    values, vectors = np.linalg.eigh(rows @ rows.T)
    order = np.argsort(values)[::-1]
    kept = [k for k in order[:_MOST_MODES] if values[k] > 0]
    remaining = rows.copy()
    modes, amounts = [], []
    for k in kept:
        if _largest_norm(remaining) <= CLOSE_M:
            break
        amount = vectors[:, k]
        mode = amount @ rows
        largest = np.abs(mode).max()
        if largest < 1e-9:
            break
        mode = np.rint(mode / largest * 32767) / 32767  # as stored in int16
        modes.append(mode)
        amounts.append(amount * largest)
        remaining -= np.outer(amounts[-1], mode)
    shape = (len(modes), *residual.shape[1:])
    return (
        np.array(modes).reshape(shape),
        np.array(amounts).reshape(len(modes), frames).T,
        float(_largest_norm(remaining)),
    )


def _largest_norm(rows: np.ndarray) -> float:
    return float(np.sqrt((rows.reshape(len(rows), -1, 3) ** 2).sum(2).max(initial=0.0)))
