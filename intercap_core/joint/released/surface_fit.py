"""Fit a body in SMPL-X's format to surfaces of another body model, such as SMPL-H.

Point-to-plane distances in both directions are minimised by Levenberg-Marquardt with the skin's
exact Jacobian (:mod:`intercap_core.body.jacobian`), alternating with searches of correspondences.
Some frames together determine the shape; then each frame's pose is fitted. A Gaussian about the
other body's rotations determines turns of limbs about their own axes, on which surfaces have no
information. Jaw, eyes and expression stay at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import NUM_POSE, POSE_COLUMNS, TRANSL
from intercap_core.body_fit.matching import MATCH_COSINE, average, match_points
from intercap_core.body_fit.surface import SkinSurface, choose_samples
from intercap_core.formats.released import Skin
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.surfaces import vertex_normals
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations, minimise
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.joint.state import frame_chunks

SHAPE_FRAMES = 16  # evenly spread; the skin is within 0.1 mm of that of 48, measured on the studio
# Difference between two body models at equal pose and shape, metres. Measured on the studio: after
# the fit, the open body is 1.4 to 2.7 mm (mean) and 4 to 8 mm (95th percentile) from the skin of
# people on another mesh.
SURFACE_SIGMA_M = 0.004
FAR_M = 0.03  # distance at which a correspondence counts a quarter (Geman-McClure); tuned


@dataclass(frozen=True, eq=False)
class FittedBodies:
    """Bodies that were fitted to N surfaces."""

    vectors: Tensor  # (N, P) parameters; all frames have the same shape
    distance: np.ndarray  # (N, 2) distance of the surfaces, metres: mean, 95th percentile


def fit_surfaces(model: BodyModel, skins: Sequence[Skin], rotations: np.ndarray) -> FittedBodies:
    """Fit ``model`` to N surfaces, from rotation vectors (N, 55, 3) in SMPL-X's order."""
    fit = _SurfaceFit(model)
    expected = fit.initialise(skins, torch.as_tensor(rotations, dtype=model.dtype))
    vectors = expected.clone()
    count = len(skins)
    chosen = np.unique(np.linspace(0, count - 1, SHAPE_FRAMES).round().astype(int))
    posed = fit.minimise(
        [skins[i] for i in chosen], vectors[chosen], expected[chosen], with_shape=True
    )
    vectors[:, fit.shape] = posed[0, fit.shape]
    vectors[chosen] = posed
    distance = np.zeros((count, 2))
    for at in frame_chunks(count):
        vectors[at] = fit.minimise(skins[at], vectors[at], expected[at], with_shape=False)
        distance[at] = fit.measure_distance(skins[at], vectors[at])
    return FittedBodies(vectors, distance)


class _SurfaceFit:
    """Samples of the model's skin, and rounds of correspondences and Gauss-Newton steps."""

    def __init__(self, model: BodyModel) -> None:
        self.model = model
        self.shape = slice(TRANSL.stop, TRANSL.stop + model.num_betas)
        samples = choose_samples(model)
        self.skin = SkinSurface.around_samples(model, samples)
        self.hand = torch.as_tensor(samples.hand)
        self.ids = self.skin.ids[self.skin.sample]
        self.outer = np.unique(self.skin.ids[self.skin.patch])
        self.faces = model.faces.numpy()
        jaw_and_eyes = np.arange(POSE_COLUMNS["jaw_pose"].start, POSE_COLUMNS["reye_pose"].stop)
        free = np.setdiff1d(np.arange(TRANSL.stop), jaw_and_eyes)
        self.columns = torch.from_numpy(free)

    def initialise(self, skins: Sequence[Skin], rotations: Tensor) -> Tensor:
        """Parameters (N, P) with ``rotations``, the mean shape, and coinciding centroids."""
        vectors = self.model.zeros(len(skins)).vector()
        vectors[:, :NUM_POSE] = rotations.reshape(len(skins), NUM_POSE)
        for at in frame_chunks(len(skins)):
            with torch.no_grad():
                posed = self.model.forward(self.model.parameters(vectors[at])).vertices.numpy()
            offset = [
                _centroid(skin.vertices, skin.faces) - _centroid(vertices, self.faces)
                for skin, vertices in zip(skins[at], posed, strict=True)
            ]
            vectors[at, TRANSL] += torch.as_tensor(np.array(offset)).to(vectors)
        return vectors

    def minimise(
        self, skins: Sequence[Skin], vectors: Tensor, expected: Tensor, *, with_shape: bool
    ) -> Tensor:
        """Parameters (N, P) after some rounds from ``vectors`` (N, P).

        In the first half of the rounds fingers keep their ``expected`` pose (N, P): before the
        hands coincide, a finger would be matched with its neighbour 20 mm away.
        """
        targets = [_Target(skin) for skin in skins]
        own, expected_own = vectors[:, self.columns], expected[:, self.columns]
        shared = vectors[0, self.shape] if with_shape else None
        rounds = 6 if with_shape else 4
        for fingers in [False] * rounds + [True] * rounds:
            planes = self._match(targets, vectors, fingers)
            stiffness = self._stiffness(fingers).to(own)
            problem = _Problem(
                self.model, self.ids, self.columns, self.shape, vectors, expected_own, stiffness,
                planes,
            )  # fmt: skip
            solution = minimise(problem, own, shared, max_trials=1)
            own, shared = solution.own, solution.shared if with_shape else None
            vectors = problem.vectors(own, solution.shared, torch.arange(len(own)))
        return vectors

    def measure_distance(self, skins: Sequence[Skin], vectors: Tensor) -> np.ndarray:
        """Mean and 95th percentile (N, 2) of the distances between the surfaces, both ways."""
        with torch.no_grad():
            posed = self.model.forward(self.model.parameters(vectors)).vertices.numpy()
        statistics = []
        for skin, vertices in zip(skins, posed, strict=True):
            to_body = DistanceField(vertices, self.faces).distance(skin.vertices)
            from_body = DistanceField(skin.vertices, skin.faces).distance(vertices[self.outer])
            distance = np.concatenate([to_body, from_body])
            statistics.append((distance.mean(), np.percentile(distance, 95)))
        return np.array(statistics)

    def _stiffness(self, fingers: bool) -> Tensor:
        """Precision (n,) of the pose about the expected one, 1/rad^2. ``fingers``: they are free.

        Rest poses and joints of two body models differ by some degrees. Measured on the studio:
        from rotations 8 degrees off, joints end 3 mm from the true ones in the mean.
        """
        stiffness = torch.full((len(self.columns),), 0.25**-2)  # standard deviation 0.25 rad
        stiffness[:3] = 0.0  # turn of the pelvis
        hands = POSE_COLUMNS["left_hand_pose"].start
        stiffness[self.columns >= hands] = (0.08 if fingers else 0.01) ** -2
        stiffness[self.columns >= TRANSL.start] = 0.0  # translation
        return stiffness

    def _match(self, targets: Sequence[_Target], vectors: Tensor, fingers: bool) -> _Planes:
        """Find correspondences of N frames. ``fingers``: the fingers are free."""
        far = torch.full((len(self.ids), 1), FAR_M)
        if fingers:
            far[self.hand] = 0.008  # a point farther away may be on the next finger
        parts = []
        with torch.no_grad():
            for at in frame_chunks(len(targets)):
                vertices, normals = self.skin.posed(self.model.parameters(vectors[at]))
                parts += [
                    self._match_frame(*frame, far)
                    for frame in zip(targets[at], vertices, normals, strict=True)
                ]
        return _Planes(*(torch.stack(part) for part in zip(*parts, strict=True)))

    def _match_frame(
        self, target: _Target, vertices: Tensor, normals: Tensor, far: Tensor
    ) -> _Planes:
        """Two planes for each sample of the body in one frame, toward the other surface.

        The first touches the other surface at its point that is closest to the sample. The second
        is perpendicular to the sample's own normal, at the mean height of the other surface's
        vertices that have matched the sample. At the distance ``far`` (S, 1) a plane counts 1/4.
        """
        reach = 0.20  # metres, of the farthest correspondence: arms start that far away; tuned
        samples, along = vertices[self.skin.sample], normals[self.skin.sample]
        closest = target.field.closest(samples.numpy())
        nearest, facing = (
            torch.as_tensor(values, dtype=samples.dtype)
            for values in (closest.points, closest.normals)
        )
        distance = (samples - nearest).norm(dim=1)
        agrees = ((facing * along).sum(1) > MATCH_COSINE) & (distance < reach)
        matches = match_points(target.points, target.normals, vertices, normals, self.skin, reach)
        ones = torch.ones(len(target.points), dtype=samples.dtype)
        zeros = torch.zeros(len(samples), dtype=samples.dtype)
        mean, count = average(matches, ones, zeros, huber=FAR_M)
        both = torch.stack([facing, along], 1)
        # height of the sample above either plane, metres
        height = torch.stack([(facing * (samples - nearest)).sum(1), -mean], 1)
        valid = torch.stack([agrees, count > 0.5], 1)
        size = torch.stack([distance, mean.abs()], 1)
        trust = geman_mcclure_weight(size * size, far)
        offset = (both * samples[:, None]).sum(2) - height
        return _Planes(both, offset, valid * trust / SURFACE_SIGMA_M**2)


class _Target:
    """The other surface in one frame: its vertices, their normals, and its distance field."""

    def __init__(self, skin: Skin) -> None:
        self.points = torch.as_tensor(skin.vertices)
        self.normals = torch.as_tensor(vertex_normals(skin.vertices.astype(np.float64), skin.faces))
        self.field = DistanceField(skin.vertices, skin.faces)


class _Planes(NamedTuple):
    """Planes to which S samples of N frames are drawn, two for each; see :meth:`_match_frame`."""

    normal: Tensor  # (N, S, 2, 3)
    offset: Tensor  # (N, S, 2) normal . v of the vertices v on the plane, metres.
    weight: Tensor  # (N, S, 2) 1/m^2


@dataclass(frozen=True)
class _Problem:
    """Sum of weight (normal . v - offset)^2 / 2 over planes, with Gaussians of pose and shape.

    See :class:`intercap_core.geometry.solve.levenberg_marquardt.Problem`.
    """

    model: BodyModel
    ids: np.ndarray  # (S,) vertices of the samples
    columns: Tensor  # (n,) columns of a frame's own parameters
    shape: slice  # Columns of the shape
    base: Tensor  # (N, P) values of the parameters that are not fitted
    expected: Tensor  # (N, n) mean of the pose's Gaussian
    stiffness: Tensor  # (n,) its precision, 1/rad^2
    planes: _Planes

    def vectors(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        """Parameters (b, P) of the frames ``index``."""
        vectors = self.base[index].clone()
        vectors[:, self.columns] = own
        if len(shared):
            vectors[:, self.shape] = shared
        return vectors

    def cost(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        """Cost (b,) of the frames ``index``."""
        vectors, off = self.vectors(own, shared, index), own - self.expected[index]
        result = 0.5 * (off * off * self.stiffness).sum(1)
        for at in frame_chunks(len(own)):
            with torch.no_grad():
                params = self.model.parameters(vectors[at])
                points = self.model.forward(params, vertex_ids=self.ids).vertices
            planes = _Planes(*(part[index[at]] for part in self.planes))
            height = (planes.normal * points[:, :, None]).sum(3) - planes.offset
            result[at] += 0.5 * (planes.weight * height * height).sum((1, 2))
        return result + 0.5 * (shared * shared).sum() / len(self.base)

    def linearise(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
        """Normal equations by own and shared parameters, own first."""
        vectors, off = self.vectors(own, shared, index), own - self.expected[index]
        n, m = own.shape[1], len(shared)
        shape = torch.arange(self.shape.start, self.shape.start + m)
        columns = torch.cat([self.columns, shape])
        cost = self.cost(own, shared, index)
        gradient = own.new_zeros(len(own), n + m)
        hessian = own.new_zeros(len(own), n + m, n + m)
        for at in frame_chunks(len(own)):
            planes = _Planes(*(part[index[at]] for part in self.planes))
            linear = self.model.linearise(self.model.parameters(vectors[at]), vertex_ids=self.ids)
            height = (planes.normal * linear.vertices[:, :, None]).sum(3) - planes.offset
            full, by_all = linear.normal_equations(planes.normal, planes.weight, height)
            gradient[at] = by_all[:, columns]
            hessian[at] = full[:, columns][:, :, columns]
        gradient[:, :n] += self.stiffness * off
        hessian[:, :n, :n].diagonal(dim1=1, dim2=2).add_(self.stiffness)
        gradient[:, n:] += shared / len(self.base)
        hessian[:, n:, n:].diagonal(dim1=1, dim2=2).add_(1 / len(self.base))
        return NormalEquations(cost, gradient, hessian)


def _centroid(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Centroid (3,) of a surface, weighted by area and so independent of its mesh."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return (area[:, None] * (a + b + c)).sum(0) / (3 * area.sum())
