"""The interface of the terms of the body's energy E_B (equation 2): inputs, columns, results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.correctives_kernel import RestPoints
from intercap_core.body.joints import NUM_JOINTS, PARENTS, ancestors
from intercap_core.body.model import BodyModel
from intercap_core.body.selection import Limbs
from intercap_core.body.skeleton_kernel import Skeleton
from intercap_core.body.vposer import PoseGaussian

# --- observations ----------------------------------------------------------------------------


@dataclass
class Views:
    """Detections of K keypoints in C cameras, for T frames."""

    observed: Tensor
    """(T, C, K, 2) detected keypoints, px."""
    confidence: Tensor
    """(T, C, K) confidence, 0 = not detected."""
    sigma: Tensor
    """(T, C, K) standard deviation, px."""
    lenses: Tensor
    """(C, 13) colour intrinsics."""
    colour_from_master: Tensor
    """(C, 4, 4) extrinsics."""
    shift: Tensor | None = None
    """(T, C, K, 3) displacement of the keypoints until the camera exposes, metres."""

    def frames(self, index: Tensor | slice) -> Views:
        """Return the detections of the frames ``index`` (b,)."""
        return Views(
            self.observed[index],
            self.confidence[index],
            self.sigma[index],
            self.lenses,
            self.colour_from_master,
            None if self.shift is None else self.shift[index],
        )


@dataclass
class Targets:
    """Triangulated positions of K keypoints, for T frames."""

    points: Tensor
    """(T, K, 3) positions in the master frame, metres."""
    confidence: Tensor
    """(T, K) confidence, 0 = no target."""
    sigma: float
    """Standard deviation, metres."""

    def frames(self, index: Tensor) -> Targets:
        """Return the targets of the frames ``index`` (b,)."""
        return Targets(self.points[index], self.confidence[index], self.sigma)


class CloudRows(NamedTuple):
    """Residual rows of E_D, one for each of N samples, for T frames; see :mod:`.cloud_term`."""

    target: Tensor
    """(T, N) mean of normal . point over the points matched to the sample, metres."""
    normal: Tensor
    """(T, N, 3) normal of the surface at the sample."""
    weight: Tensor
    """(T, N) weight, 1/m^2, 0 = no point."""

    def frames(self, index: Tensor | np.ndarray | slice) -> CloudRows:
        """Return the rows of the frames ``index`` (b,)."""
        return CloudRows(*(values[index] for values in self))


class Pairs(NamedTuple):
    """M pairs for E_P_self: a sample inside or close to another part of the body, and a vertex of
    that part. Pairs and normals are fixed between two searches (:mod:`.self_contact`)."""

    frame: Tensor
    """(M,) index of the frame of each pair, ascending."""
    inner: Tensor
    """(M,) index of the sample in ``vertices``."""
    outer: Tensor
    """(M,) index of the vertex of the other part in ``vertices``."""
    normal: Tensor
    """(M, 3) outward normal at that vertex, master frame."""
    vertices: Tensor
    """(U,) vertex ids."""


# --- keypoints -------------------------------------------------------------------------------


@dataclass(frozen=True)
class KeypointSet:
    """K of the 135 keypoints, as combinations of N vertices and the joints."""

    index: Tensor
    """(K,) index among the 135 keypoints."""
    vertices: Tensor
    """(N,) vertex ids."""
    matrix: Tensor
    """(K, N + 55) weights of the vertices and the joints."""
    carrier: Tensor
    """(K,) joint whose bone carries the offset of the keypoint."""
    turned_by: Tensor
    """(K, 55) 1 for the joints that turn this bone, else 0."""
    limbs: Limbs
    """Keypoints on the same chain of joints."""


def keypoint_set(model: BodyModel, index: Sequence[int] | range) -> KeypointSet:
    """Return the keypoints ``index`` of the 135.

    The carrier of a keypoint at a joint is the joint's parent. That of a keypoint on the mesh is
    the joint with the largest skinning weight.
    """
    keypoints, rows = model.keypoint_map, np.asarray(index)
    heaviest = model.skinning_weights.argmax(1).numpy()
    carrier = [
        max(PARENTS[joint], 0) if joint >= 0 else int(heaviest[ids[weights.argmax()]])
        for joint, ids, weights in zip(
            keypoints.joint[rows], keypoints.ids[rows], keypoints.weights[rows], strict=True
        )
    ]
    turned = np.zeros((len(rows), NUM_JOINTS))
    for row, joint in enumerate(carrier):
        turned[row, list(ancestors(joint))] = 1
    matrix = keypoints.matrix[rows]
    count = len(keypoints.vertex_ids)
    used = np.flatnonzero(matrix[:, :count].any(0))
    matrix = np.concatenate([matrix[:, used], matrix[:, count:]], 1)
    vertices = keypoints.vertex_ids[used]
    # a joint follows only its parent
    follows = np.zeros((len(vertices) + NUM_JOINTS, NUM_JOINTS), bool)
    follows[: len(vertices)] = model.skinning_weights[torch.as_tensor(vertices)].numpy() != 0
    follows[len(vertices) + np.arange(NUM_JOINTS), [max(parent, 0) for parent in PARENTS]] = True
    chains = [_chain(np.flatnonzero(bones)) for bones in (matrix != 0) @ follows]
    return KeypointSet(
        torch.as_tensor(rows),
        torch.as_tensor(vertices),
        torch.as_tensor(matrix, dtype=model.dtype),
        torch.as_tensor(carrier),
        torch.as_tensor(turned, dtype=model.dtype),
        _limbs(chains),
    )


def _chain(bones: np.ndarray) -> frozenset[int]:
    """Return all joints that move any of the ``bones``: these joints and their ancestors."""
    return frozenset().union(*(ancestors(bone) for bone in bones.tolist()))


def _limbs(chains: list[frozenset[int]]) -> Limbs:
    """Group keypoints into limbs, from the longest chain of joints to the shortest.

    A keypoint joins the first limb whose chain contains its own; otherwise it starts a limb.
    """
    limbs: list[list[int]] = []
    for k in sorted(range(len(chains)), key=lambda k: (-len(chains[k]), k)):
        home = next((limb for limb in limbs if chains[k] <= chains[limb[0]]), None)
        if home is None:
            limbs.append([k])
        else:
            home.append(k)
    moved_by = np.array([[joint in chain for joint in range(NUM_JOINTS)] for chain in chains])
    return Limbs.of([np.array(limb) for limb in limbs], moved_by)


# --- inputs, bodies and columns --------------------------------------------------------------


@dataclass(kw_only=True)
class TermInputs:
    """Observations of T frames and settings of the terms."""

    keypoints: KeypointSet
    """Keypoints of E_J, the 25 of the body first."""
    views: Views | None = None
    """Detections for E_J."""
    targets: Targets | None = None
    """Triangulated keypoints for E_J."""
    rows: CloudRows | None = None
    """Rows of E_D; None switches the term off."""
    pairs: Pairs | None = None
    """Contacts of E_P_self; None switches the term off."""
    self_weight: float = 1.0
    """Factor of E_P_self."""
    pose: PoseGaussian | None = None
    """Learned prior of each frame's body pose, in place of the open prior."""
    one_shape: bool
    """All frames share the betas; else each frame has its own betas, with their prior."""
    hand_share: float = 1.0
    """Factor of E_theta_h in one frame: 1 if frames are independent, less if hand poses last."""


class Bodies(NamedTuple):
    """The b bodies at which the energy is evaluated."""

    vectors: Tensor
    """(b, P) parameter vectors."""
    offsets: Tensor
    """(K, 3) keypoint offsets in the frames of their bones, metres."""
    thickness: Tensor
    """(G,) thickness of the coverings, metres."""
    frames: Tensor
    """(b,) frame of each body among the T frames of the inputs."""


class Columns(NamedTuple):
    """Columns of the normal equations: parameters, then keypoint offsets, then coverings."""

    parameters: Tensor
    """(n,) body parameter of each of the first n columns."""
    offsets: int
    """Number of keypoints whose offsets have three columns each."""
    coverings: int
    """Number of columns for the logarithms u of the thickness of the coverings."""

    @property
    def offsets_at(self) -> slice:
        """Columns of the offsets."""
        first = len(self.parameters)
        return slice(first, first + 3 * self.offsets)

    @property
    def coverings_at(self) -> slice:
        """Columns of the coverings."""
        first = self.offsets_at.stop
        return slice(first, first + self.coverings)

    def of_parameters(self, count: int) -> np.ndarray:
        """Return the column of each of ``count`` body parameters, -1 = fixed."""
        columns = np.full(count, -1)
        columns[self.parameters.numpy()] = np.arange(len(self.parameters))
        return columns

    def of_coverings(self, count: int) -> np.ndarray:
        """Return the column of each of ``count`` coverings, -1 = fixed."""
        at = self.coverings_at
        return np.arange(at.start, at.stop) if self.coverings else np.full(count, -1)


# --- results ---------------------------------------------------------------------------------


class Batch(NamedTuple):
    """B of the b bodies of an evaluation, which one thread computes."""

    at: slice
    """Places of the B bodies among the b bodies."""
    vectors: np.ndarray
    """(B, P) parameter vectors."""
    frames: np.ndarray
    """(B,) frames."""
    skeleton: Skeleton
    """Posed skeletons."""


class BatchEquations(NamedTuple):
    """The normal equations of a batch, which the kernels fill in place."""

    place: np.ndarray
    """(P,) column of each body parameter, -1 = fixed."""
    place_u: np.ndarray
    """(G,) column of each covering, -1 = fixed."""
    first_offset: int
    """First column of the keypoint offsets."""
    offsets: int
    """Number of keypoints whose offsets have three columns each."""
    cost: np.ndarray
    """(B,)"""
    gradient: np.ndarray
    """(B, n)"""
    hessian: np.ndarray
    """(B, n, n)"""
    by_pose: np.ndarray
    """(B, 54, 3, 9) derivatives of the rotations by the pose, see
    :mod:`intercap_core.body.correctives_kernel`; B = 0 without pose blend shapes."""


class CompiledTerm(NamedTuple):
    """A term at the b bodies of one evaluation."""

    rest: RestPoints | None
    """Points of the term at rest, which pose blend shapes move; None = no points."""
    used: Callable[[np.ndarray], np.ndarray]
    """Returns which of the N points of ``rest`` the term uses in the frames (B,), (B, N) bool."""
    add_cost: Callable[[Batch, np.ndarray], None]
    """Adds the cost (B,) in place."""
    add: Callable[[Batch, BatchEquations], None]
    """Adds the normal equations in place."""


def contiguous(values: Tensor) -> np.ndarray:
    """Return the tensor as an array, as the kernels expect it."""
    return values.contiguous().numpy()
