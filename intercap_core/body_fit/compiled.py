"""The terms of :class:`.problem.BodyProblem` by compiled kernels, on the CPU.

A frame's skeleton is posed once for all terms; frames are shared out among as many threads as torch
uses, and each term adds itself to its own frame's normal equations, so that nothing depends on who
did what. Pose blend shapes move the points at rest before the terms see them, and the gradient
knows it; Gauss-Newton's matrices do in part: see :mod:`.correctives_kernel`. The plain form of
every term stays for a GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.correctives_kernel import (
    NUM_FEATURES,
    Correctives,
    add_gradient,
    changes,
    features,
    gather,
    move,
)
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.selection import Selection
from intercap_core.body.skeleton_kernel import RestJoints, pose, rest_points
from intercap_core.energy import body_cloud_kernel, body_keypoints_kernel, body_self
from intercap_core.energy.body_keypoints import KeypointSet
from intercap_core.energy.body_keypoints_kernel import Pieces
from intercap_core.energy.body_priors_kernel import Priors, add_priors
from intercap_core.energy.body_samples import Samples
from intercap_core.energy.body_surface_kernel import (
    Touching,
    add_plane_cost,
    add_self_cost,
    add_self_equations,
)
from intercap_core.energy.sightings_kernel import Seen
from intercap_core.solve.crew import Crew
from intercap_core.solve.levenberg_marquardt import NormalEquations

if TYPE_CHECKING:
    from intercap_core.body_fit.problem import BodyProblem

_SHAPE = TRANSL.stop


@dataclass(frozen=True)
class Columns:
    """Where parameters stand in the normal equations, -1 = fixed: body (P,), covering (G,), and the
    first of the three columns of each of so many keypoints' offsets."""

    body: np.ndarray
    covering: np.ndarray
    first_offset: int
    offsets: int


class _Rest(NamedTuple):
    """Points (b,N,3) of a term at rest, which pose blend shapes, where there are any, are to move;
    the gradient by them, (b,N,3), or of no body where it is not wanted."""

    points: np.ndarray
    correctives: Correctives | None
    pull: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, correctives: Correctives | None, derivatives: bool) -> _Rest:
        wanted = derivatives and correctives is not None
        pull = np.zeros(points.shape if wanted else (0, 0, 3), points.dtype)
        return cls(points, correctives, pull)

    @property
    def tables(self) -> np.ndarray:
        """(N,3,486), or of no point."""
        nothing = np.empty((0, 3, NUM_FEATURES), self.points.dtype)
        return nothing if self.correctives is None else self.correctives.tables

    def move(self, feature: np.ndarray, at: slice, asked: np.ndarray) -> None:
        """Move the points of the bodies ``at`` that are asked for, (B,N), by feature (B,486)."""
        points = self.points[at]
        move(self.correctives, feature, asked, points)


class _Now(NamedTuple):
    """What a problem compares with at the moment, as arrays; rows and touching None if not.

    places, and the last of rows and of touching: the points of each.
    """

    pieces: Pieces
    places: _Rest
    seen: Seen
    priors: Priors
    rows: tuple[np.ndarray, np.ndarray, np.ndarray, _Rest] | None
    touching: tuple[Touching, Selection, _Rest] | None
    thickness: np.ndarray

    def move(self, vectors: np.ndarray, frames: np.ndarray, at: slice) -> None:
        """Move the points of the bodies ``at``, of parameters (B,P), by the pose blend shapes."""
        if self.places.correctives is None:
            return
        feature = features(vectors)
        self.places.move(feature, at, np.ones((len(frames), self.places.points.shape[1]), bool))
        if self.rows is not None:
            _, weight, _, samples = self.rows
            samples.move(feature, at, weight[frames] > 0)
        if self.touching is not None:
            touching, _, touched = self.touching
            touched.move(feature, at, touching.asked(frames, touched.points.shape[1]))

    def add_pull(
        self, at: slice, change: np.ndarray, place: np.ndarray, gradient: np.ndarray
    ) -> None:
        """Add the pull on those points to their bodies' gradient (B,n); change: of `changes`."""
        if self.places.correctives is None:
            return
        by_feature = np.zeros((len(change), NUM_FEATURES), change.dtype)
        gather(self.places.correctives, self.places.pull[at], by_feature)
        for term in (self.rows, self.touching):
            if term is not None:
                gather(term[-1].correctives, term[-1].pull[at], by_feature)
        add_gradient(change, by_feature, place, gradient)


class Terms:
    """E_B's terms on one body model, but for the prior of what all frames share."""

    def __init__(self, model: BodyModel, samples: Samples) -> None:
        self._model = model
        self._rest = RestJoints.of(model)
        self._samples = _selection(model, samples.vertex)
        self._group = samples.group
        self._correctives = _correctives(self._samples)
        self._pieces: tuple[KeypointSet, Pieces, Correctives | None] | None = None
        self._touching: tuple[body_self.Pairs, Selection, Correctives | None] | None = None
        self._priors: dict[tuple[bool, bool], Priors] = {}

    def cost(
        self, problem: BodyProblem, vectors: Tensor, offsets: Tensor, thickness: Tensor,
        index: Tensor,
    ) -> Tensor:  # fmt: skip
        """(b,) of the frames ``index`` (b,) at vectors (b,P); offsets (K,3) of the keypoints and
        thickness (G,) of the coverings, metres."""
        now = self._now(problem, vectors, offsets, thickness, derivatives=False)
        x, frames, total = vectors.numpy(), index.numpy(), vectors.new_zeros(len(index))
        nothing = np.zeros((1, 0, 0), x.dtype)
        fixed = np.full(x.shape[1], -1)

        def some(at: slice) -> None:
            own, ids, cost = x[at], frames[at], total.numpy()[at]
            skeleton = pose(self._rest, own, derivatives=False)
            now.move(own, ids, at)
            add_priors(now.priors, own, ids, fixed, False, cost, nothing[0], nothing)
            body_keypoints_kernel.add_cost(
                skeleton, now.pieces, now.places.points[at], now.seen, ids, cost
            )
            if now.rows is not None:
                normal, weight, target, samples = now.rows
                chain = skeleton.chain(self._samples, samples.points[at])
                add_plane_cost(chain, normal, weight, target, now.thickness, self._group, ids, cost)
            if now.touching is not None:
                touching, selection, touched = now.touching
                chain = skeleton.chain(selection, touched.points[at])
                add_self_cost(chain, touching, ids, cost)

        _share_out(some, len(index))
        return total

    def add_equations(
        self, problem: BodyProblem, vectors: Tensor, offsets: Tensor, thickness: Tensor,
        index: Tensor, columns: Columns, equations: NormalEquations,
    ) -> None:  # fmt: skip
        """Add the terms to the normal equations of the same frames, in place."""
        now = self._now(problem, vectors, offsets, thickness, derivatives=True)
        x, frames, place = vectors.numpy(), index.numpy(), columns.body
        costs, gradients, hessians = (part.numpy() for part in equations)

        def some(at: slice) -> None:
            own, ids = x[at], frames[at]
            cost, gradient, hessian = costs[at], gradients[at], hessians[at]
            skeleton = pose(self._rest, own, derivatives=True)
            change = changes(own if now.places.correctives else own[:0])
            now.move(own, ids, at)
            add_priors(now.priors, own, ids, place, True, cost, gradient, hessian)
            body_keypoints_kernel.add_equations(
                skeleton, now.pieces, now.places.points[at], now.seen, ids,
                place, columns.first_offset, columns.offsets,
                cost, gradient, hessian, now.places.pull[at], change,
            )  # fmt: skip
            if now.rows is not None:
                normal, weight, target, samples = now.rows
                body_cloud_kernel.add_equations(
                    skeleton.chain(self._samples, samples.points[at]), self._samples.limbs,
                    normal, weight, target, now.thickness, self._group, ids, place,
                    columns.covering, cost, gradient, hessian, samples.pull[at],
                    samples.tables, change,
                )  # fmt: skip
            if now.touching is not None:
                touching, selection, touched = now.touching
                chain = skeleton.chain(selection, touched.points[at])
                pull = touched.pull[at]
                add_self_equations(chain, touching, ids, place, cost, gradient, hessian, pull)
            now.add_pull(at, change, place, gradient)

        _share_out(some, len(index))

    def _now(
        self, problem: BodyProblem, vectors: Tensor, offsets: Tensor, thickness: Tensor,
        *, derivatives: bool,
    ) -> _Now:  # fmt: skip
        model, rows, pairs = self._model, problem.rows, problem.touching
        shape = _array(vectors[:, _SHAPE:])
        if self._pieces is None or self._pieces[0] is not problem.keypoints:
            pieces = Pieces.of(model, problem.keypoints)
            tables = pieces.posedirs
            moved = Correctives.of(tables) if tables.shape[2] else None
            self._pieces = problem.keypoints, pieces, moved
        compared, touching = None, None
        if rows is not None:
            samples = _Rest.of(_at_rest(self._samples, shape), self._correctives, derivatives)
            compared = _array(rows.normal), _array(rows.weight), _array(rows.target), samples
        if pairs is not None:
            if self._touching is None or self._touching[0] is not pairs:
                selection = _selection(model, pairs.vertices.numpy())
                self._touching = pairs, selection, _correctives(selection)
            _, selection, moved = self._touching
            starts = np.searchsorted(pairs.frame.numpy(), np.arange(len(problem.base) + 1))
            touching = (
                Touching(
                    starts, _array(pairs.inner), _array(pairs.outer), _array(pairs.normal),
                    body_self.TOLERANCE, body_self.REACH,
                    float(problem.self_weight * body_self.WEIGHT),
                ),
                selection,
                _Rest.of(_at_rest(selection, shape), moved, derivatives),
            )  # fmt: skip
        which = not problem.one_shape, problem.pose is not None
        if which not in self._priors:
            self._priors[which] = Priors.of(model, shape=which[0], body_pose=not which[1])
        priors = self._priors[which]
        if problem.pose is not None:
            mean, precision = _array(problem.pose.mean), _array(problem.pose.precision)
            priors = priors._replace(pose=mean, pose_precision=precision)
        _, pieces, moved = self._pieces
        return _Now(
            pieces,
            _Rest.of(pieces.at_rest(shape, offsets.numpy()), moved, derivatives),
            _seen(problem),
            priors,
            compared,
            touching,
            _array(thickness),
        )


def _seen(problem: BodyProblem) -> Seen:
    from intercap_core.body_fit.problem import KEYPOINT_SCALE

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


def _correctives(selection: Selection) -> Correctives | None:
    posedirs = selection.posedirs
    return None if posedirs is None else Correctives.of(posedirs.numpy())


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
