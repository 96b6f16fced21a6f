"""The terms of the body's energy E_B (equation 2 with 3 to 5), summed.

| term | equation | file | class |
| --- | --- | --- | --- |
| E_J | 3 | keypoint_term.py | CompiledKeypoints |
| E_D | 4 | cloud_term.py | CompiledCloud |
| E_P_self | 5 | self_term.py | CompiledSelfPenetration |
| priors | 2 | prior_term.py | CompiledPriors |

The terms are compiled for the CPU. The readable form is `bench/body_energy.py`, with which tests
compare them: it states the residuals of each term in PyTorch.

The bodies of licensed files have pose blend shapes. Costs and gradients include these in full. The
Gauss-Newton matrices include their derivatives only in part, since all of them would make every
block of the normal equations dense: E_J and E_D have those by the joints of a point's own limb,
E_P_self has none. See :mod:`intercap_core.body.correctives_kernel`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from torch import Tensor

from intercap_core.body.correctives_kernel import (
    NUM_FEATURES,
    add_gradient,
    features,
    gather,
    rotation_derivatives,
)
from intercap_core.body.model import BodyModel
from intercap_core.body.skeleton_kernel import RestJoints, pose
from intercap_core.body_fit.cloud_term import CompiledCloud
from intercap_core.body_fit.keypoint_term import CompiledKeypoints
from intercap_core.body_fit.prior_term import CompiledPriors
from intercap_core.body_fit.self_term import CompiledSelfPenetration
from intercap_core.body_fit.surface import Samples
from intercap_core.body_fit.term_inputs import (
    Batch,
    BatchEquations,
    Bodies,
    Columns,
    CompiledTerm,
    TermInputs,
)
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations
from intercap_core.geometry.solve.thread_pool import ThreadPool, threads_of_job


class CompiledTerms:
    """The sum of all terms by compiled kernels.

    The skeleton of a frame is posed once for all terms. Frames are divided among as many threads as
    torch uses. Each frame has its own normal equations, so the result does not depend on the number
    of threads. Pose blend shapes move the points at rest before the terms use them.
    """

    def __init__(self, model: BodyModel, samples: Samples) -> None:
        self._rest_joints = RestJoints.of(model)
        self._terms: tuple[Callable[[TermInputs, Bodies, bool], CompiledTerm | None], ...] = (
            CompiledPriors(model).prepare,
            CompiledKeypoints(model).prepare,
            CompiledCloud(model, samples).prepare,
            CompiledSelfPenetration(model).prepare,
        )

    def cost(self, inputs: TermInputs, bodies: Bodies) -> Tensor:
        """Return the cost (b,) of each body."""
        terms = self._prepare(inputs, bodies, False)
        total = bodies.vectors.new_zeros(len(bodies.frames))

        def add_frames(at: slice) -> None:
            batch = self._batch(terms, bodies, at, derivatives=False)
            for term in terms:
                term.add_cost(batch, total.numpy()[at])

        _divide_frames(add_frames, len(total))
        return total

    def add(
        self, inputs: TermInputs, bodies: Bodies, columns: Columns, equations: NormalEquations
    ) -> None:
        """Add cost (b,), gradient (b, n) and Gauss-Newton matrix (b, n, n) in place."""
        terms = self._prepare(inputs, bodies, True)
        moved = [term.rest for term in terms if term.rest and term.rest.correctives]
        place = columns.of_parameters(bodies.vectors.shape[1])
        place_u = columns.of_coverings(len(bodies.thickness))
        whole = [part.numpy() for part in equations]

        def add_frames(at: slice) -> None:
            batch = self._batch(terms, bodies, at, derivatives=True)
            by_pose = rotation_derivatives(batch.vectors if moved else batch.vectors[:0])
            cost, gradient, hessian = (part[at] for part in whole)
            own = BatchEquations(
                place, place_u, columns.offsets_at.start, columns.offsets, cost, gradient, hessian,
                by_pose,
            )  # fmt: skip
            for term in terms:
                term.add(batch, own)
            if moved:
                # gradients by the points at rest, through the blend shapes to the pose
                by_feature = np.zeros((len(by_pose), NUM_FEATURES), by_pose.dtype)
                for rest in moved:
                    gather(rest.correctives, rest.gradient[at], by_feature)
                add_gradient(by_pose, by_feature, place, gradient)

        _divide_frames(add_frames, len(bodies.frames))

    def _prepare(self, inputs: TermInputs, bodies: Bodies, derivatives: bool) -> list[CompiledTerm]:
        terms = [prepare(inputs, bodies, derivatives) for prepare in self._terms]
        return [term for term in terms if term is not None]

    def _batch(
        self, terms: list[CompiledTerm], bodies: Bodies, at: slice, *, derivatives: bool
    ) -> Batch:
        """Pose the skeletons of the bodies ``at``, and move their points by the blend shapes."""
        vectors = bodies.vectors.numpy()[at]
        frames = np.ascontiguousarray(bodies.frames.numpy()[at])  # kernels compile for each layout
        feature = None
        for term in terms:
            if term.rest is not None and term.rest.correctives is not None:
                feature = features(vectors) if feature is None else feature
                term.rest.move(feature, at, term.used(frames))
        skeleton = pose(self._rest_joints, vectors, derivatives=derivatives)
        return Batch(at, vectors, frames, skeleton)


@cache
def _thread_pool(threads: int) -> ThreadPool:
    return ThreadPool(threads)


def _divide_frames(add_frames: Callable[[slice], None], count: int) -> None:
    """Call ``add_frames`` on ``count`` frames, in equal parts for each thread."""
    threads = threads_of_job()
    step = max(1, -(-count // threads))
    _thread_pool(threads).map(add_frames, [slice(i, i + step) for i in range(0, count, step)])
