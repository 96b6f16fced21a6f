"""The terms of :class:`.problem.BodyProblem` by compiled kernels, for bodies that have them.

A frame's skeleton is posed once for all terms; frames are shared out among as many threads as torch
uses, and each term adds itself to its own frame's normal equations, so that nothing depends on who
did what. The plain form of every term stays: for a GPU, and for bodies with pose blend shapes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.selection import Selection
from intercap_core.energy import body_cloud_kernel, body_keypoints_kernel, body_self
from intercap_core.energy.body_cloud import Samples
from intercap_core.energy.body_keypoints import KeypointSet
from intercap_core.energy.body_keypoints_kernel import Pieces, Seen
from intercap_core.energy.body_priors_kernel import Priors, add_priors
from intercap_core.energy.body_surface_kernel import (
    Touching,
    add_plane_cost,
    add_self_cost,
    add_self_equations,
)
from intercap_core.energy.skeleton_kernel import RestJoints, pose, rest_points
from intercap_core.solve.crew import Crew
from intercap_core.solve.levenberg_marquardt import NormalEquations

if TYPE_CHECKING:
    from intercap_core.fitting.problem import BodyProblem

_SHAPE = TRANSL.stop
_NOTHING = np.zeros((0, 0, 3))


@dataclass(frozen=True)
class Columns:
    """Where parameters stand in the normal equations, -1 = fixed: body (P,), covering (G,), and the
    first of the three columns of each of so many keypoints' offsets."""

    body: np.ndarray
    covering: np.ndarray
    first_offset: int
    offsets: int


class _Now(NamedTuple):
    """What a problem compares with at the moment, as arrays; rows and touching None if not.

    places, samples and touched (b,N,3): the keypoints' pieces and the points of the two, at rest.
    """

    pieces: Pieces
    places: np.ndarray
    seen: Seen
    priors: Priors
    rows: tuple[np.ndarray, np.ndarray, np.ndarray] | None
    samples: np.ndarray
    touching: tuple[Touching, Selection] | None
    touched: np.ndarray
    thickness: np.ndarray


class Terms:
    """E_B's terms on one body model, but for the prior of what all frames share."""

    def __init__(self, model: BodyModel, samples: Samples) -> None:
        self._model = model
        self._rest = RestJoints.of(model)
        self._samples = _selection(model, samples.vertex)
        self._group = samples.group
        self._pieces: tuple[KeypointSet, Pieces] | None = None
        self._touching: tuple[body_self.Pairs, Selection] | None = None
        self._priors: dict[tuple[bool, bool], Priors] = {}

    def cost(
        self, problem: BodyProblem, vectors: Tensor, offsets: Tensor, thickness: Tensor,
        index: Tensor,
    ) -> Tensor:  # fmt: skip
        """(b,) of the frames ``index`` (b,) at vectors (b,P); offsets (K,3) of the keypoints and
        thickness (G,) of the coverings, metres."""
        now = self._now(problem, vectors, offsets, thickness)
        x, frames, total = vectors.numpy(), index.numpy(), vectors.new_zeros(len(index))
        nothing = np.zeros((1, 0, 0), x.dtype)
        fixed = np.full(x.shape[1], -1)

        def some(at: slice) -> None:
            own, ids, cost = x[at], frames[at], total.numpy()[at]
            skeleton = pose(self._rest, own, derivatives=False)
            add_priors(now.priors, own, ids, fixed, False, cost, nothing[0], nothing)
            body_keypoints_kernel.add_cost(
                skeleton, now.pieces, now.places[at], now.seen, ids, cost
            )
            if now.rows is not None:
                chain = skeleton.chain(self._samples, now.samples[at])
                normal, weight, target = now.rows
                add_plane_cost(chain, normal, weight, target, now.thickness, self._group, ids, cost)
            if now.touching is not None:
                touching, selection = now.touching
                add_self_cost(skeleton.chain(selection, now.touched[at]), touching, ids, cost)

        _share_out(some, len(index))
        return total

    def add_equations(
        self, problem: BodyProblem, vectors: Tensor, offsets: Tensor, thickness: Tensor,
        index: Tensor, columns: Columns, equations: NormalEquations,
    ) -> None:  # fmt: skip
        """Add the terms to the normal equations of the same frames, in place."""
        now = self._now(problem, vectors, offsets, thickness)
        x, frames, place = vectors.numpy(), index.numpy(), columns.body
        costs, gradients, hessians = (part.numpy() for part in equations)

        def some(at: slice) -> None:
            own, ids = x[at], frames[at]
            out: tuple[Any, ...] = costs[at], gradients[at], hessians[at]
            skeleton = pose(self._rest, own, derivatives=True)
            add_priors(now.priors, own, ids, place, True, *out)
            body_keypoints_kernel.add_equations(
                skeleton, now.pieces, now.places[at], now.seen, ids,
                place, columns.first_offset, columns.offsets, *out,
            )  # fmt: skip
            if now.rows is not None:
                normal, weight, target = now.rows
                body_cloud_kernel.add_equations(
                    skeleton.chain(self._samples, now.samples[at]), self._samples.limbs,
                    normal, weight, target, now.thickness, self._group, ids, place,
                    columns.covering, *out,
                )  # fmt: skip
            if now.touching is not None:
                touching, selection = now.touching
                add_self_equations(
                    skeleton.chain(selection, now.touched[at]), touching, ids, place, *out
                )

        _share_out(some, len(index))

    def _now(
        self, problem: BodyProblem, vectors: Tensor, offsets: Tensor, thickness: Tensor
    ) -> _Now:
        model, rows, pairs = self._model, problem.rows, problem.touching
        shape = _array(vectors[:, _SHAPE:])
        if self._pieces is None or self._pieces[0] is not problem.keypoints:
            self._pieces = problem.keypoints, Pieces.of(model, problem.keypoints)
        touching, touched, samples = None, _NOTHING, _NOTHING
        if rows is not None:
            samples = _at_rest(self._samples, shape)
        if pairs is not None:
            if self._touching is None or self._touching[0] is not pairs:
                self._touching = pairs, _selection(model, pairs.vertices.numpy())
            starts = np.searchsorted(pairs.frame.numpy(), np.arange(len(problem.base) + 1))
            touching = (
                Touching(
                    starts, _array(pairs.inner), _array(pairs.outer), _array(pairs.normal),
                    body_self.TOLERANCE, body_self.REACH,
                    float(problem.self_weight * body_self.WEIGHT),
                ),
                self._touching[1],
            )  # fmt: skip
            touched = _at_rest(self._touching[1], shape)
        which = not problem.one_shape, problem.pose is not None
        if which not in self._priors:
            self._priors[which] = Priors.of(model, shape=which[0], body_pose=not which[1])
        priors = self._priors[which]
        if problem.pose is not None:
            mean, precision = _array(problem.pose.mean), _array(problem.pose.precision)
            priors = priors._replace(pose=mean, pose_precision=precision)
        pieces = self._pieces[1]
        return _Now(
            pieces,
            pieces.at_rest(shape, offsets.numpy()),
            _seen(problem),
            priors,
            rows and (_array(rows.normal), _array(rows.weight), _array(rows.target)),
            samples,
            touching,
            touched,
            _array(thickness),
        )


def _seen(problem: BodyProblem) -> Seen:
    from intercap_core.fitting.problem import KEYPOINT_SCALE

    views, targets, base = problem.views, problem.targets, problem.base
    if views is None and targets is None:
        raise ValueError("the problem has neither views nor targets")
    none = [base.new_zeros((0,) * axes) for axes in (4, 3, 3, 2, 3, 4, 3, 2)]
    parts = list(none)
    if views is not None:
        parts[:5] = [
            views.observed, views.confidence, views.sigma, views.lenses, views.colour_from_master,
        ]  # fmt: skip
        parts[5] = none[5] if views.shift is None else views.shift
    if targets is not None:
        parts[6:] = [targets.points, targets.confidence]
    sigma = 1.0 if targets is None else float(targets.sigma)
    given: list[Any] = [*(_array(part.to(base)) for part in parts), sigma, KEYPOINT_SCALE]
    return Seen(*given)


def _array(values: Tensor) -> np.ndarray:
    return values.contiguous().numpy()


def _selection(model: BodyModel, vertices: np.ndarray) -> Selection:
    return model.linearise(model.zeros(), vertex_ids=vertices).selection


def _at_rest(selection: Selection, shape: np.ndarray) -> np.ndarray:
    """Points (b,N,3)."""
    return rest_points(selection.template.numpy(), selection.directions.numpy(), shape)


@cache
def _crew(threads: int) -> Crew:
    return Crew(threads)


def _share_out(some: Callable[[slice], None], count: int) -> None:
    """Do so many frames, equal shares for each thread."""
    threads = torch.get_num_threads()
    step = max(1, -(-count // threads))
    _crew(threads).map(some, [slice(i, i + step) for i in range(0, count, step)])
