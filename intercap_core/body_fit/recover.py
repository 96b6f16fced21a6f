"""Find frames whose body departs from the motion of its neighbours, and refit them.

A fit that starts from a wrong triangulation, or an arm whose depth one view cannot determine, may
end in another minimum of the energy. The refit starts from an interpolation of the neighbours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from intercap_core.body.joints import BODY_JOINTS
from intercap_core.body_fit.bridge import bridge
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.geometry.solve.levenberg_marquardt import minimise

# Half of the window around a frame, seconds: six frames at 30 Hz. Tuned on the studio.
JUMP_WINDOW_S = 0.21
FIT_SCATTER_M = 0.1  # fits of a still body scatter by less, metres; measured on the studio
# Distance from the median of the window beyond which a joint jumps, metres. Hands accelerate by up
# to 30 m/s^2 (anatomy): within 0.1 s they leave a straight path by 30 / 2 * 0.1^2 = 0.15 m.
JUMP_M = FIT_SCATTER_M + 0.15


def measure_jumps(
    joints: np.ndarray, times: np.ndarray, least: np.ndarray | float = JUMP_M
) -> np.ndarray:
    """Return the distance (N, J) of joints from their median over the surrounding frames, metres.

    The window has as many frames before as after. Distances up to ``least`` are returned as 0, also
    those of frames without a frame before or after within the window.

    Args:
        joints: (N, J, 3) metres.
        times: (N,) seconds.
        least: threshold, metres: (N, J), or one value for all.
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
    """Refit the frames that leave their neighbours, starting from an interpolation of the others.

    These are frames with a joint farther than :data:`FIT_SCATTER_M` from the median of its window.
    A fast motion may be among them: its refit ends where the fit was.

    Args:
        problem: a problem with views, whose ``base`` is changed in place. Shared parameters do not
            change.
        times: (N,) seconds.

    Returns:
        (N,) bool, frames whose refit costs clearly less: their energy has several minima.
    """
    model = problem.model
    improved = np.zeros(len(times), bool)
    params = model.parameters(problem.base)
    joints = model.forward(params, vertex_ids=np.array([0])).joints[:, BODY_JOINTS]
    jumps = measure_jumps(joints.double().numpy(), times, FIT_SCATTER_M)
    jumped = np.asarray((jumps > 0).any(1))
    if not jumped.any() or jumped.all():
        return improved
    between = bridge(problem.base.double().numpy(), ~jumped, times)
    at = torch.as_tensor(np.flatnonzero(jumped))
    base = torch.as_tensor(between[jumped]).to(problem.base)
    again = _of_frames(problem, at, base)
    everyone = torch.arange(len(at))
    nothing = base.new_zeros(0)
    before = again.cost(problem.base[at][:, again.columns], nothing, everyone)
    solution = minimise(again, again.own_start(), max_trials=10, cost_tolerance=1e-3)
    # keep the refit unless it costs clearly more; tuned on the studio
    kept = solution.cost <= 1.2 * before + 5.0
    rows = problem.base[at].clone()
    again.accept(solution.own, nothing)
    rows[kept] = again.base[kept]
    problem.base = problem.base.clone()
    problem.base[at] = rows
    improved[jumped] = (before > 1.2 * solution.cost + 5.0).numpy()
    return improved


def _of_frames(problem: BodyProblem, at: torch.Tensor, base: torch.Tensor) -> BodyProblem:
    """Return a problem of the frames ``at`` (n,) with E_J and the priors, without E_D and E_P_self.

    base (n, P): bodies, whose shape is fixed.
    """
    shape = torch.arange(base.shape[1])[problem.layout.shape]
    return replace(
        problem,
        base=base,
        columns=problem.columns[~torch.isin(problem.columns, shape)],
        one_shape=False,
        fit_shared=False,
        views=None if problem.views is None else problem.views.frames(at),
        targets=None if problem.targets is None else problem.targets.frames(at),
        rows=None,
        pairs=None,
        pose=None if problem.pose is None else problem.pose.of_frames(at),
    )
