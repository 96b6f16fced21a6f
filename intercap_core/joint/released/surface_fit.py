"""A body in SMPL-X's format laid on surfaces of another body, of another mesh and other shapes.

Parameters of SMPL-H mean another template and other shape directions, so none but its rotations
carry over, and these as a start. What is fitted is the surface: point to plane, both ways (from
samples of our skin to their surface, and from their vertices, gathered on these samples, along our
normals), by Levenberg-Marquardt with the skin's exact Jacobian (:mod:`intercap_core.body.jacobian`)
between searches of correspondences. First some frames settle the one shape, then each frame its
pose. What no surface tells, the turn of a limb about its own axis, is held by a Gaussian about the
other body's rotation. Jaw, eyes and expression stay at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import NUM_POSE, TRANSL
from intercap_core.body_fit.matching import MATCH_COSINE, average, match_points
from intercap_core.body_fit.surface import SkinSurface, choose_samples
from intercap_core.formats.released import Skin
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.surfaces import vertex_normals
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations, minimise
from intercap_core.geometry.solve.robust import geman_mcclure_weight

# Frames, spread evenly, that settle the one shape: on a studio's person the skin is then within
# 0.1 mm of what 48 frames give.
SHAPE_FRAMES = 16
FRAMES_TOGETHER = 32  # fitted at once once the shape is known: memory
# Rounds of finding correspondences, each with one step of Gauss-Newton: in the first fingers keep
# the pose that was found for the other body, until hands lie on hands; else a finger goes to its
# neighbour, which is 20 mm beside it.
HELD_ROUNDS, FREE_ROUNDS = 6, 6  # with the shape
POSE_HELD_ROUNDS, POSE_FREE_ROUNDS = 4, 4  # once the shape is known
# What two body models differ by where pose and shape agree: the studio's people on another mesh
# end 1.4 to 2.7 mm beside the open body in the mean, 4 to 8 in the 95th percentile.
SURFACE_SIGMA_M = 0.004
REACH_M = 0.20  # the farthest correspondence; arms start that far beside
# A correspondence as far as this counts a quarter (Geman and McClure): of the body, and of hands
# whose fingers are free, where what is farther may be the next finger.
FAR_M, HAND_FAR_M = 0.03, 0.008
# rad, about the rotations that were found for the other body: rest poses and joints of the two
# differ by some degrees. They decide what the surface does not: turns about a limb's own axis, and
# fingers in a fist. From rotations 8 degrees off, joints end 3 mm beside the true ones in the mean.
POSE_SIGMA, FINGER_SIGMA, HELD_SIGMA = 0.25, 0.08, 0.01

_REST = slice(66, 75)  # jaw and eyes, which stay
_ROOT, _FINGERS = slice(0, 3), slice(75, 165)  # the pelvis' turn, and the hands' joints


@dataclass(frozen=True, eq=False)
class Fitted:
    """vectors (N, P): parameters of each frame, one shape. distance (N, 2): mean and 95th
    percentile of the distance between the surfaces, both ways, metres."""

    vectors: Tensor
    distance: np.ndarray


def fit_surfaces(model: BodyModel, skins: Sequence[Skin], rotations: np.ndarray) -> Fitted:
    """Lay ``model`` on N ``skins``, starting from rotation vectors (N, 55, 3) in SMPL-X's order."""
    surfaces = _Surfaces(model)
    expected = surfaces.start(skins, torch.as_tensor(rotations, dtype=model.dtype))
    vectors = expected.clone()
    count = len(skins)
    some = np.unique(np.linspace(0, count - 1, SHAPE_FRAMES).round().astype(int))
    settled = surfaces.settle(
        [skins[i] for i in some], vectors[some], expected[some], with_shape=True
    )
    vectors[:, surfaces.shape] = settled[0, surfaces.shape]
    vectors[some] = settled
    distance = np.zeros((count, 2))
    for first in range(0, count, FRAMES_TOGETHER):
        at = slice(first, first + FRAMES_TOGETHER)
        vectors[at] = surfaces.settle(skins[at], vectors[at], expected[at], with_shape=False)
        distance[at] = surfaces.distance(skins[at], vectors[at])
    return Fitted(vectors, distance)


class _Surfaces:
    """The model's samples and columns, and the rounds of its fit."""

    def __init__(self, model: BodyModel) -> None:
        self.model = model
        self.shape = slice(TRANSL.stop, TRANSL.stop + model.num_betas)
        samples = choose_samples(model)
        self.skin = SkinSurface.around_samples(model, samples)
        self.hand = torch.as_tensor(samples.hand)
        self.ids = self.skin.ids[self.skin.sample]
        self.outer = np.unique(self.skin.ids[self.skin.patch])
        self.faces = model.faces.cpu().numpy()
        self.columns = torch.tensor(
            [i for i in range(TRANSL.stop) if not _REST.start <= i < _REST.stop]
        )

    def start(self, skins: Sequence[Skin], rotations: Tensor) -> Tensor:
        """Parameters (N, P): these rotations, the mean shape, areas about one middle."""
        vectors = self.model.zeros(len(skins)).vector()
        vectors[:, :NUM_POSE] = rotations.reshape(len(skins), NUM_POSE)
        for at in _chunks(len(skins)):
            with torch.no_grad():
                ours = self.model.forward(self.model.parameters(vectors[at])).vertices.numpy()
            apart = [
                _middle(skin.vertices, skin.faces) - _middle(own, self.faces)
                for skin, own in zip(skins[at], ours, strict=True)
            ]
            vectors[at, TRANSL] += torch.as_tensor(np.array(apart)).to(vectors)
        return vectors

    def settle(
        self, skins: Sequence[Skin], vectors: Tensor, expected: Tensor, *, with_shape: bool
    ) -> Tensor:
        """Parameters (N, P) after some rounds, from ``vectors``; the shape is one for all, the
        pose is ``expected`` to be (N, P)."""
        targets = [_Target.of(skin) for skin in skins]
        own, about = vectors[:, self.columns], expected[:, self.columns]
        shared = vectors[0, self.shape] if with_shape else None
        held, free = POSE_HELD_ROUNDS, POSE_FREE_ROUNDS
        if with_shape:
            held, free = HELD_ROUNDS, FREE_ROUNDS
        for fingers in [False] * held + [True] * free:
            rows = self._rows(targets, vectors, fingers)
            stiffness = self._stiffness(fingers).to(own)
            problem = _Problem(
                self.model, self.ids, self.columns, self.shape, vectors, about, stiffness, rows
            )
            found = minimise(problem, own, shared, max_trials=1)
            own, shared = found.own, found.shared if with_shape else None
            vectors = problem.vectors(own, found.shared, torch.arange(len(own)))
        return vectors

    def distance(self, skins: Sequence[Skin], vectors: Tensor) -> np.ndarray:
        """(N, 2) mean and 95th percentile of how far the surfaces are apart, both ways."""
        with torch.no_grad():
            posed = self.model.forward(self.model.parameters(vectors)).vertices.numpy()
        found = []
        for skin, ours in zip(skins, posed, strict=True):
            away = np.concatenate(
                [
                    DistanceField(ours, self.faces).distance(skin.vertices),
                    DistanceField(skin.vertices, skin.faces).distance(ours[self.outer]),
                ]
            )
            found.append((away.mean(), np.percentile(away, 95)))
        return np.array(found)

    def _stiffness(self, fingers: bool) -> Tensor:
        """(n,) 1/rad^2 of the pose about where it starts; none of the pelvis' turn and place."""
        found = torch.full((len(self.columns),), POSE_SIGMA**-2)
        found[_ROOT] = 0.0
        found[(self.columns >= _FINGERS.start) & (self.columns < _FINGERS.stop)] = (
            FINGER_SIGMA if fingers else HELD_SIGMA
        ) ** -2
        found[self.columns >= TRANSL.start] = 0.0
        return found

    def _rows(self, targets: Sequence[_Target], vectors: Tensor, fingers: bool) -> _Rows:
        far = torch.full((len(self.ids), 1), FAR_M)
        if fingers:
            far[self.hand] = HAND_FAR_M
        parts = []
        with torch.no_grad():
            for at in _chunks(len(targets)):
                vertices, normals = self.skin.posed(self.model.parameters(vectors[at]))
                parts += [
                    self._rows_of(target, skin, along, far)
                    for target, skin, along in zip(targets[at], vertices, normals, strict=True)
                ]
        return _Rows(*(torch.stack(part) for part in zip(*parts, strict=True)))

    def _rows_of(self, target: _Target, vertices: Tensor, normals: Tensor, far: Tensor) -> _Rows:
        """Of one frame: to the other surface, and from it; ``far`` (S, 1) counts a quarter."""
        samples, along = vertices[self.skin.sample], normals[self.skin.sample]
        closest = target.field.closest(samples.numpy())
        there, facing = (
            torch.as_tensor(values, dtype=samples.dtype)
            for values in (closest.points, closest.normals)
        )
        apart = (samples - there).norm(dim=1)
        agrees = ((facing * along).sum(1) > MATCH_COSINE) & (apart < REACH_M)
        matches = match_points(target.points, target.normals, vertices, normals, self.skin, REACH_M)
        ones = torch.ones(len(target.points), dtype=samples.dtype)
        none = torch.zeros(len(samples), dtype=samples.dtype)
        mean, count = average(matches, ones, none, huber=FAR_M)
        both = torch.stack([facing, along], 1)
        away = torch.stack([(facing * (samples - there)).sum(1), -mean], 1)
        valid = torch.stack([agrees, count > 0.5], 1)
        size = torch.stack([apart, mean.abs()], 1)
        trust = geman_mcclure_weight(size * size, far)
        target_along = (both * samples[:, None]).sum(2) - away
        return _Rows(both, target_along, valid * trust / SURFACE_SIGMA_M**2)


class _Target:
    """The other surface in one frame, ready to be searched."""

    def __init__(self, points: Tensor, normals: Tensor, field: DistanceField) -> None:
        self.points, self.normals, self.field = points, normals, field

    @classmethod
    def of(cls, skin: Skin) -> _Target:
        normals = vertex_normals(skin.vertices.astype(np.float64), skin.faces)
        return cls(
            torch.as_tensor(skin.vertices),
            torch.as_tensor(normals),
            DistanceField(skin.vertices, skin.faces),
        )


class _Rows(NamedTuple):
    """Planes that N frames' S samples are drawn to: there and back (2).

    normal (N, S, 2, 3); target (N, S, 2): n . v on the plane, metres; weight (N, S, 2) 1/m^2.
    """

    normal: Tensor
    target: Tensor
    weight: Tensor


@dataclass(frozen=True)
class _Problem:
    """sum over rows of weight (n . v - target)^2 / 2, the Gaussian of the pose and that of the
    shape; see :class:`intercap_core.geometry.solve.levenberg_marquardt.Problem`.

    columns (n,): own parameters. base (N, P): what is not fitted keeps these values. about (N, n):
    where the pose is expected, with ``stiffness`` (n,) 1/rad^2.
    """

    model: BodyModel
    ids: np.ndarray
    columns: Tensor
    shape: slice
    base: Tensor
    about: Tensor
    stiffness: Tensor
    rows: _Rows

    def vectors(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        """Parameters (b, P)."""
        found = self.base[index].clone()
        found[:, self.columns] = own
        if len(shared):
            found[:, self.shape] = shared
        return found

    def cost(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        """(b,)"""
        vectors, off = self.vectors(own, shared, index), self._off(own, index)
        result = 0.5 * (off * off * self.stiffness).sum(1)
        for at in _chunks(len(own)):
            with torch.no_grad():
                params = self.model.parameters(vectors[at])
                points = self.model.forward(params, vertex_ids=self.ids).vertices
            rows = _Rows(*(part[index[at]] for part in self.rows))
            away = (rows.normal * points[:, :, None]).sum(3) - rows.target
            result[at] += 0.5 * (rows.weight * away * away).sum((1, 2))
        return result + 0.5 * (shared * shared).sum() / len(self.base)

    def linearise(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
        """Normal equations by own and shared parameters, own first."""
        vectors, off = self.vectors(own, shared, index), self._off(own, index)
        n, m = own.shape[1], len(shared)
        shape = torch.arange(self.shape.start, self.shape.start + m)
        columns = torch.cat([self.columns, shape])
        cost = self.cost(own, shared, index)
        gradient = own.new_zeros(len(own), n + m)
        hessian = own.new_zeros(len(own), n + m, n + m)
        for at in _chunks(len(own)):
            rows = _Rows(*(part[index[at]] for part in self.rows))
            params = self.model.parameters(vectors[at])
            linear = self.model.linearise(params, vertex_ids=self.ids)
            away = (rows.normal * linear.vertices[:, :, None]).sum(3) - rows.target
            whole, by = linear.normal_equations(rows.normal, rows.weight, away)
            gradient[at] = by[:, columns]
            hessian[at] = whole[:, columns][:, :, columns]
        gradient[:, :n] += self.stiffness * off
        hessian[:, :n, :n].diagonal(dim1=1, dim2=2).add_(self.stiffness)
        gradient[:, n:] += shared / len(self.base)
        hessian[:, n:, n:].diagonal(dim1=1, dim2=2).add_(1 / len(self.base))
        return NormalEquations(cost, gradient, hessian)

    def _off(self, own: Tensor, index: Tensor) -> Tensor:
        return own - self.about[index]


def _middle(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The middle (3,) of a surface, whatever its mesh."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return (area[:, None] * (a + b + c)).sum(0) / (3 * area.sum())


def _chunks(count: int) -> list[slice]:
    step = FRAMES_TOGETHER
    return [slice(i, i + step) for i in range(0, count, step)]
