"""Compact body motion: transforms of the skeleton, and modes of the residual of skinning.

Vertices are skinned by their four largest weights. The residual (smaller weights, pose correctives,
changes of shape or expression) is transformed to the rest pose and approximated by a truncated
singular value decomposition: modes over all vertices with an amount per frame. Modes are added,
largest singular value first, until every vertex is within ``CLOSE_M``, at most ``_MOST_MODES``.
Long recordings have the modes of ``_MODE_FRAMES`` frames; other frames are projected onto them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from intercap_core.body.kinematics import pose_joints, rotation_from_axis_angle
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.geometry.solve.time_series import sample_evenly
from intercap_core.output.export.motion import posed_batches, rest_pose

CLOSE_M = 0.001  # largest distance of a vertex from the model's
_MOST_MODES = 64
# Largest number of frames that determine the modes. Two copies of a residual take 650 kB, and time
# grows with the cube of their number.
_MODE_FRAMES = 512


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


def skinned(model: BodyModel, parameters: BodyParameters) -> SkinnedBody:
    """Compress T posed bodies in the frame of the parameters."""
    rest, rest_joints = rest_pose(model, parameters)
    all_weights = model.skinning_weights.numpy().astype(np.float64)
    strongest = np.argsort(-all_weights, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(all_weights, strongest, 1)
    weights /= weights.sum(1, keepdims=True)
    count = parameters.batch
    chosen = sample_evenly(np.ones(count, bool), _MODE_FRAMES)
    transforms = np.empty((count, len(rest_joints), 3, 4))

    def residuals(frames: np.ndarray) -> Iterator[np.ndarray]:
        """Set the transforms of ``frames``; yield residuals (b, V, 3) in the rest pose."""
        some = parameters.frames(torch.from_numpy(frames))
        local = rotation_from_axis_angle(some.full_pose().double())
        rest_of_all = torch.from_numpy(rest_joints).expand(len(local), -1, -1)
        turns = pose_joints(rest_of_all, local, torch.zeros(len(local), 3)).rotations.numpy()
        first = 0
        for posed in posed_batches(model, some):
            at = slice(first, first := first + len(posed.joints))
            shifts = posed.joints.double().numpy()
            shifts -= np.einsum("tjab,jb->tja", turns[at], rest_joints)
            own = transforms[frames[at]] = np.concatenate([turns[at], shifts[..., None]], 3)
            vertices = posed.vertices.double().numpy()
            yield np.stack(
                [
                    _unskinned(points, of_frame, strongest, weights) - rest
                    for points, of_frame in zip(vertices, own, strict=True)
                ]
            )

    residual = np.concatenate(list(residuals(chosen)))
    # A constant residual belongs to the rest pose and needs no mode.
    constant = residual.mean(0)
    residual -= constant
    modes, of_chosen, error = _modes(residual)
    amounts = np.empty((count, len(modes)))
    amounts[chosen] = of_chosen
    del residual
    others, first = np.setdiff1d(np.arange(count), chosen), 0
    for residual in residuals(others):
        at = others[first : first + len(residual)]
        amounts[at], largest = _project(residual - constant, modes)
        error, first = max(error, largest), first + len(residual)
    return SkinnedBody(rest + constant, strongest, weights, transforms, modes, amounts, error)


def _unskinned(
    points: np.ndarray, transforms: np.ndarray, joints: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Return the rest points that skinning maps to ``points`` (V, 3)."""
    blended = np.einsum("vk,vkab->vab", weights, transforms[joints])  # (V, 3, 4)
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


def _project(residual: np.ndarray, modes: np.ndarray) -> tuple[np.ndarray, float]:
    """Project residuals (b, V, 3) onto modes (K, V, 3), one after the other.

    Returns amounts (b, K) and the largest remaining distance, metres.
    """
    remaining, amounts = residual.reshape(len(residual), -1), np.empty((len(residual), len(modes)))
    for k, mode in enumerate(modes.reshape(len(modes), -1)):
        amounts[:, k] = remaining @ mode / (mode @ mode)
        remaining = remaining - np.outer(amounts[:, k], mode)
    return amounts, _largest_norm(remaining)


def _largest_norm(rows: np.ndarray) -> float:
    return float(np.sqrt((rows.reshape(len(rows), -1, 3) ** 2).sum(2).max(initial=0.0)))
