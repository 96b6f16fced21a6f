"""The terms of the body's energy E_B (equation 2 with 3 to 5) by compiled kernels, on the CPU.

A frame's skeleton is posed once for all terms. Frames are divided among as many threads as torch
uses; each term adds itself to its own frame's normal equations, so that the result does not depend
on the number of threads. Pose blend shapes, which licensed body files have, move the points of the
rest pose before the terms see them. Gradients know this in full, Gauss-Newton matrices in part: see
:mod:`intercap_core.body.correctives_kernel`. :mod:`.torch_terms` states every term readably.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.correctives_kernel import (
    NUM_FEATURES,
    Correctives,
    add_gradient,
    features,
    gather,
    move,
    rotation_derivatives,
)
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.selection import Selection
from intercap_core.body.skeleton_kernel import RestJoints, pose, rest_points
from intercap_core.body_fit import body_cloud_kernel, body_keypoints_kernel, body_self
from intercap_core.body_fit.body_constants import SELF_REACH_M, SELF_TOLERANCE_M, SELF_WEIGHT
from intercap_core.body_fit.body_keypoints import KeypointSet
from intercap_core.body_fit.body_keypoints_kernel import Pieces
from intercap_core.body_fit.body_priors_kernel import Priors, add_priors
from intercap_core.body_fit.body_samples import Samples
from intercap_core.body_fit.body_surface_kernel import (
    SelfPairs,
    add_plane_cost,
    add_self_cost,
    add_self_equations,
)
from intercap_core.body_fit.constants import KEYPOINT_SCALE
from intercap_core.body_fit.sightings_kernel import KeypointObservations
from intercap_core.body_fit.terms import Bodies, Columns, Observations, Targets, Views
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations
from intercap_core.geometry.solve.thread_pool import ThreadPool

_SHAPE = TRANSL.stop


class _RestPoints(NamedTuple):
    """Points (b,N,3) of one term in the rest pose, metres; pose blend shapes move them in place.

    correctives: None without pose blend shapes. gradient (b,N,3): of the energy by these points,
    filled in by the kernels; of no body where it is not needed.
    """

    points: np.ndarray
    correctives: Correctives | None
    gradient: np.ndarray

    @classmethod
    def of(
        cls, points: np.ndarray, correctives: Correctives | None, derivatives: bool
    ) -> _RestPoints:
        needed = derivatives and correctives is not None
        gradient = np.zeros(points.shape if needed else (0, 0, 3), points.dtype)
        return cls(points, correctives, gradient)

    @property
    def tables(self) -> np.ndarray:
        """(N,3,486), or of no point."""
        empty = np.empty((0, 3, NUM_FEATURES), self.points.dtype)
        return empty if self.correctives is None else self.correctives.tables

    def move(self, feature: np.ndarray, at: slice, used: np.ndarray) -> None:
        """Move the points of the bodies ``at`` that are used, (B,N) bool, by feature (B,486)."""
        points = self.points[at]
        move(self.correctives, feature, used, points)


class _CloudInputs(NamedTuple):
    """E_D's rows: normal (T,N,3), weight (T,N), target (T,N), and the samples at rest."""

    normal: np.ndarray
    weight: np.ndarray
    target: np.ndarray
    samples: _RestPoints


class _SelfInputs(NamedTuple):
    """E_P_self's pairs, the points that they are made of, and these at rest."""

    pairs: SelfPairs
    selection: Selection
    points: _RestPoints


class _Inputs(NamedTuple):
    """What the kernels take, for the frames of one evaluation; cloud and touching None if off.

    keypoints: the keypoints' pieces at rest. thickness (G,) of the coverings, metres.
    """

    pieces: Pieces
    keypoints: _RestPoints
    observed: KeypointObservations
    priors: Priors
    cloud: _CloudInputs | None
    touching: _SelfInputs | None
    thickness: np.ndarray

    @property
    def has_correctives(self) -> bool:
        return self.keypoints.correctives is not None

    def move(self, vectors: np.ndarray, frames: np.ndarray, at: slice) -> None:
        """Move the points of the bodies ``at``, of parameters (B,P), by the pose blend shapes."""
        if not self.has_correctives:
            return
        feature = features(vectors)
        every_piece = np.ones((len(frames), self.keypoints.points.shape[1]), bool)
        self.keypoints.move(feature, at, every_piece)
        if self.cloud is not None:
            self.cloud.samples.move(feature, at, self.cloud.weight[frames] > 0)
        if self.touching is not None:
            points = self.touching.points
            used = self.touching.pairs.used_points(frames, points.points.shape[1])
            points.move(feature, at, used)

    def add_correctives_gradient(
        self,
        at: slice,
        by_pose: np.ndarray,
        place: np.ndarray,
        gradient: np.ndarray,
    ) -> None:
        """Add to gradient (B,n) the terms' gradients by points of the rest pose, chained through
        the blend shapes to the pose; by_pose of
        :func:`.correctives_kernel.rotation_derivatives`."""
        if not self.has_correctives:
            return
        by_feature = np.zeros((len(by_pose), NUM_FEATURES), by_pose.dtype)
        terms = [self.keypoints]
        if self.cloud is not None:
            terms.append(self.cloud.samples)
        if self.touching is not None:
            terms.append(self.touching.points)
        for rest in terms:
            gather(rest.correctives, rest.gradient[at], by_feature)
        add_gradient(by_pose, by_feature, place, gradient)


class CompiledTerms:
    """See :class:`.terms.Terms`. What depends on the chosen points alone is kept between calls."""

    def __init__(self, model: BodyModel, samples: Samples) -> None:
        self._model = model
        self._rest_joints = RestJoints.of(model)
        self._samples = _selection(model, samples.vertex)
        self._group = samples.group
        self._correctives = _correctives(self._samples)
        self._pieces: tuple[KeypointSet, Pieces, Correctives | None] | None = None
        self._touching: tuple[body_self.Pairs, Selection, Correctives | None] | None = None
        self._priors: dict[tuple[bool, bool], Priors] = {}

    def cost(self, observed: Observations, bodies: Bodies) -> Tensor:
        """See :meth:`.terms.Terms.cost`."""
        inputs = self._inputs(observed, bodies, derivatives=False)
        vectors, index = bodies.vectors.numpy(), bodies.frames.numpy()
        total = bodies.vectors.new_zeros(len(index))
        none = np.zeros((1, 0, 0), vectors.dtype)
        fixed = np.full(vectors.shape[1], -1)

        def add_frames(at: slice) -> None:
            x, frames, cost = vectors[at], index[at], total.numpy()[at]
            skeleton = pose(self._rest_joints, x, derivatives=False)
            inputs.move(x, frames, at)
            add_priors(inputs.priors, x, frames, fixed, False, cost, none[0], none)
            body_keypoints_kernel.add_cost(
                skeleton,
                inputs.pieces,
                inputs.keypoints.points[at],
                inputs.observed,
                frames,
                cost,
            )
            if inputs.cloud is not None:
                normal, weight, target, samples = inputs.cloud
                chain = skeleton.chain(self._samples, samples.points[at])
                add_plane_cost(
                    chain, normal, weight, target, inputs.thickness, self._group, frames, cost
                )
            if inputs.touching is not None:
                pairs, selection, points = inputs.touching
                add_self_cost(skeleton.chain(selection, points.points[at]), pairs, frames, cost)

        _divide_frames(add_frames, len(index))
        return total

    def add_equations(
        self,
        observed: Observations,
        bodies: Bodies,
        columns: Columns,
        equations: NormalEquations,
    ) -> None:
        """See :meth:`.terms.Terms.add_equations`."""
        inputs = self._inputs(observed, bodies, derivatives=True)
        vectors, index = bodies.vectors.numpy(), bodies.frames.numpy()
        place = columns.of_parameters(vectors.shape[1])
        covering_place = columns.of_coverings(len(bodies.thickness))
        costs, gradients, hessians = (part.numpy() for part in equations)

        def add_frames(at: slice) -> None:
            x, frames = vectors[at], index[at]
            cost, gradient, hessian = costs[at], gradients[at], hessians[at]
            skeleton = pose(self._rest_joints, x, derivatives=True)
            by_pose = rotation_derivatives(x if inputs.has_correctives else x[:0])
            inputs.move(x, frames, at)
            add_priors(inputs.priors, x, frames, place, True, cost, gradient, hessian)
            body_keypoints_kernel.add_equations(
                skeleton,
                inputs.pieces,
                inputs.keypoints.points[at],
                inputs.observed,
                frames,
                place,
                columns.offsets_at.start,
                columns.offsets,
                cost,
                gradient,
                hessian,
                inputs.keypoints.gradient[at],
                by_pose,
            )
            if inputs.cloud is not None:
                normal, weight, target, samples = inputs.cloud
                body_cloud_kernel.add_equations(
                    skeleton.chain(self._samples, samples.points[at]),
                    self._samples.limbs,
                    normal,
                    weight,
                    target,
                    inputs.thickness,
                    self._group,
                    frames,
                    place,
                    covering_place,
                    cost,
                    gradient,
                    hessian,
                    samples.gradient[at],
                    samples.tables,
                    by_pose,
                )
            if inputs.touching is not None:
                pairs, selection, points = inputs.touching
                add_self_equations(
                    skeleton.chain(selection, points.points[at]),
                    pairs,
                    frames,
                    place,
                    cost,
                    gradient,
                    hessian,
                    points.gradient[at],
                )
            inputs.add_correctives_gradient(at, by_pose, place, gradient)

        _divide_frames(add_frames, len(index))

    def _inputs(self, observed: Observations, bodies: Bodies, *, derivatives: bool) -> _Inputs:
        shape = _array(bodies.vectors[:, _SHAPE:])
        pieces, correctives = self._pieces_of(observed.keypoints)
        at_rest = pieces.at_rest(shape, bodies.offsets.numpy())
        return _Inputs(
            pieces=pieces,
            keypoints=_RestPoints.of(at_rest, correctives, derivatives),
            observed=_keypoint_observations(observed, bodies.vectors),
            priors=self._priors_of(observed),
            cloud=self._cloud(observed, shape, derivatives),
            touching=self._self(observed, bodies.frames, shape, derivatives),
            thickness=_array(bodies.thickness),
        )

    def _pieces_of(self, keypoints: KeypointSet) -> tuple[Pieces, Correctives | None]:
        if self._pieces is None or self._pieces[0] is not keypoints:
            pieces = Pieces.of(self._model, keypoints)
            tables = pieces.posedirs
            correctives = Correctives.of(tables) if tables.shape[2] else None
            self._pieces = keypoints, pieces, correctives
        return self._pieces[1:]

    def _priors_of(self, observed: Observations) -> Priors:
        which = observed.shape_prior, observed.pose is not None
        if which not in self._priors:
            self._priors[which] = Priors.of(self._model, shape=which[0], body_pose=not which[1])
        priors = self._priors[which]
        priors = priors._replace(hands=priors.hands * priors.hands.dtype.type(observed.hand_share))
        if observed.pose is None:
            return priors
        mean, precision = _array(observed.pose.mean), _array(observed.pose.precision)
        return priors._replace(pose=mean, pose_precision=precision)

    def _cloud(
        self, observed: Observations, shape: np.ndarray, derivatives: bool
    ) -> _CloudInputs | None:
        rows = observed.rows
        if rows is None:
            return None
        at_rest = _at_rest(self._samples, shape)
        samples = _RestPoints.of(at_rest, self._correctives, derivatives)
        return _CloudInputs(_array(rows.normal), _array(rows.weight), _array(rows.target), samples)

    def _self(
        self,
        observed: Observations,
        index: Tensor,
        shape: np.ndarray,
        derivatives: bool,
    ) -> _SelfInputs | None:
        pairs = observed.pairs
        if pairs is None or not len(index):
            return None
        if self._touching is None or self._touching[0] is not pairs:
            selection = _selection(self._model, pairs.vertices.numpy())
            self._touching = pairs, selection, _correctives(selection)
        _, selection, correctives = self._touching
        compiled = SelfPairs(
            starts=np.searchsorted(pairs.frame.numpy(), np.arange(int(index.max()) + 2)),
            inner=_array(pairs.inner),
            outer=_array(pairs.outer),
            normal=_array(pairs.normal),
            tolerance=SELF_TOLERANCE_M,
            reach=SELF_REACH_M,
            weight=float(observed.self_weight * SELF_WEIGHT),
        )
        points = _RestPoints.of(_at_rest(selection, shape), correctives, derivatives)
        return _SelfInputs(compiled, selection, points)


def _keypoint_observations(observed: Observations, like: Tensor) -> KeypointObservations:
    """E_J's observations in the floating type of ``like``; views or targets of no frame if off."""
    if observed.views is None and observed.targets is None:
        raise ValueError("the problem has neither views nor targets")

    def absent(axes: int) -> Tensor:
        return like.new_zeros((0,) * axes)

    def array(values: Tensor) -> np.ndarray:
        return _array(values.to(like))

    views = observed.views or Views(absent(4), absent(3), absent(3), absent(2), absent(3))
    targets = observed.targets or Targets(absent(3), absent(2), sigma=1.0)
    return KeypointObservations(
        observed=array(views.observed),
        confidence=array(views.confidence),
        sigma=array(views.sigma),
        lenses=array(views.lenses),
        colour_from_master=array(views.colour_from_master),
        shift=array(absent(4) if views.shift is None else views.shift),
        targets=array(targets.points),
        targets_confidence=array(targets.confidence),
        targets_sigma=float(targets.sigma),
        scale=KEYPOINT_SCALE,
    )


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
def _thread_pool(threads: int) -> ThreadPool:
    return ThreadPool(threads)


def _divide_frames(add_frames: Callable[[slice], None], count: int) -> None:
    """Call ``add_frames`` on all of so many frames, in equal parts for each thread."""
    threads = torch.get_num_threads()
    step = max(1, -(-count // threads))
    _thread_pool(threads).map(add_frames, [slice(i, i + step) for i in range(0, count, step)])
