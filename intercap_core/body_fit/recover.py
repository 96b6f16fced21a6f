"""Outliers in time: frames whose body departs from its neighbours' motion are found and refitted,
starting from an interpolation of the neighbours.

A fit that starts from a wrong triangulation, or an arm that one view cannot place in depth, ends in
another minimum of the energy, alone among frames that agree.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body_fit.bridge import bridge
from intercap_core.body_fit.constants import (
    JUMP_M,
    JUMP_WINDOW_S,
    RECOVER_TRIALS,
    RECOVERED_COST_FACTOR,
    RECOVERED_COST_SLACK,
)
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.geometry.solve.levenberg_marquardt import minimise

_BODY_JOINTS = slice(0, JOINT_INDEX["right_wrist"] + 1)


def jumps(joints: np.ndarray, times: np.ndarray, least: np.ndarray | float = JUMP_M) -> np.ndarray:
    """Distance (N,J) of joints (N,J,3), metres, from their median over the frames around.

    ``times`` (N,) seconds. Frames count up to 0.2 s away, as many before as after; 0 where there
    are none, and where the distance is no more than ``least`` (N,J), by default what people move.
    """
    result = np.zeros(joints.shape[:2])
    for t, time in enumerate(times):
        near = np.abs(times - time) <= JUMP_WINDOW_S
        half = min(near[:t].sum(), near[t + 1 :].sum())
        if half:
            window = joints[t - half : t + half + 1]
            result[t] = np.linalg.norm(joints[t] - np.median(window, axis=0), axis=1)
    return np.where(result > least, result, 0.0)


def recover(problem: BodyProblem, times: np.ndarray) -> np.ndarray:
    """Fit the frames that jump again from between the others; which were changed, (N,) bool.

    ``problem`` has views; its base is changed in place, ``times`` (N,) seconds are its frames'.
    Shared parameters stay.
    """
    model = problem.model
    changed = np.zeros(len(times), bool)
    params = model.parameters(problem.base)
    joints = model.forward(params, vertex_ids=np.array([0])).joints[:, _BODY_JOINTS]
    jumped = np.asarray((jumps(joints.double().cpu().numpy(), times) > 0).any(1))
    if not jumped.any() or jumped.all():
        return changed
    between = bridge(problem.base.double().cpu().numpy(), ~jumped, times)
    at = torch.as_tensor(np.flatnonzero(jumped), device=problem.base.device)
    base = torch.as_tensor(between[jumped]).to(problem.base)
    again = _of_frames(problem, at, base)
    everyone = torch.arange(len(at), device=base.device)
    nothing = base.new_zeros(0)
    before = again.cost(problem.base[at][:, again.columns], nothing, everyone)
    found = minimise(again, again.own_start(), max_trials=RECOVER_TRIALS, cost_tolerance=1e-3)
    kept = found.cost <= RECOVERED_COST_FACTOR * before + RECOVERED_COST_SLACK
    rows = problem.base[at].clone()
    again.accept(found.own, nothing)
    rows[kept] = again.base[kept]
    problem.base = problem.base.clone()
    problem.base[at] = rows
    changed[np.flatnonzero(jumped)[kept.cpu().numpy()]] = True
    return changed


def _of_frames(problem: BodyProblem, at: torch.Tensor, base: torch.Tensor) -> BodyProblem:
    """E_J and priors alone of the frames ``at`` (n,), at bodies ``base`` (n,P), shape fixed."""
    views, targets = problem.views, problem.targets
    if views is not None:
        views = replace(
            views,
            observed=views.observed[at],
            confidence=views.confidence[at],
            sigma=views.sigma[at],
            shift=None if views.shift is None else views.shift[at],
        )
    if targets is not None:
        targets = replace(targets, points=targets.points[at], confidence=targets.confidence[at])
    shape = torch.arange(base.shape[1], device=base.device)[problem.shape_columns]
    own = problem.columns[~torch.isin(problem.columns, shape)]
    return replace(
        problem,
        base=base,
        columns=own,
        one_shape=False,
        fit_shared=False,
        views=views,
        targets=targets,
        rows=None,
        touching=None,
        pose=None if problem.pose is None else problem.pose.of_frames(at),
    )
