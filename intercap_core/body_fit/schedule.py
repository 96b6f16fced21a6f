"""The order in which the body is fitted: trunk, 3D keypoints, E_J, E_J + E_D, hands and face."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import BODY
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.vposer import VPoser
from intercap_core.body_fit.body_samples import COVERINGS
from intercap_core.body_fit.constants import (
    CLOUD_REACH_M,
    KEYPOINT_SCALE,
    START_SIGMA_M,
    TURN_WORSE,
    WIDENED,
)
from intercap_core.body_fit.definition import Definition
from intercap_core.body_fit.evidence import Evidence
from intercap_core.body_fit.observations import Observations, PersonCloud
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.body_fit.quality import PartEvidence, compare
from intercap_core.body_fit.recover import recover
from intercap_core.body_fit.start import between, place_trunk, turned_around
from intercap_core.body_fit.terms import Targets, Terms
from intercap_core.config import BodyFitSettings
from intercap_core.geometry.solve.levenberg_marquardt import Solution, minimise
from intercap_core.progress import Progress

log = logging.getLogger(__name__)

_WRISTS = ("left_wrist", "right_wrist")


@dataclass(frozen=True)
class Settled:
    """Quantities estimated once for all frames, beside the shape.

    offsets (25,3) m of the body keypoints in the frames of their bones; covering (G,) logarithm of
    each covering's thickness over the usual one; keypoint_sigma (K,) m; cloud_noise (G,) m;
    keypoint_doubt (K,): the power with which sigma grows as confidence falls.
    """

    offsets: Tensor
    covering: Tensor
    keypoint_sigma: Tensor
    cloud_noise: Tensor
    keypoint_doubt: Tensor


@dataclass(frozen=True)
class Fit:
    """The fitted frames (N,), ids among the sequence's T.

    vectors (N,P) parameters; hessian (N,n+m,n+m) of the energy by the parameters ``columns`` (n,)
    and by the m that all frames share, betas first where there is ``one_shape``; shared_counts (m,)
    how often the prior of each of those counts in a frame. excess (N,) >= 1: mean square of the
    keypoints' residuals over their variance.
    pixel_residual (N,C) px, cloud_residual (N,) m: medians, NaN = nothing seen. settled: what all
    frames share beside the shape. parts: how the observations bear out each part of the body.
    """

    frames: np.ndarray
    vectors: Tensor
    columns: Tensor
    hessian: Tensor
    one_shape: bool
    shared_counts: Tensor
    excess: Tensor
    pixel_residual: Tensor
    cloud_residual: Tensor
    settled: Settled
    parts: PartEvidence


def columns_of(model: BodyModel, *, hands: bool, face: bool, betas: bool) -> Tensor:
    """Own parameter columns: trunk and limbs, then hands, jaw and expression where requested."""
    pose = list(range(0, 66))
    if face:
        jaw = 3 * JOINT_INDEX["jaw"]
        pose += list(range(jaw, jaw + 3))
    if hands:
        pose += list(range(75, 165))
    pose += list(range(TRANSL.start, TRANSL.stop))
    if betas:
        pose += list(range(TRANSL.stop, TRANSL.stop + model.num_betas))
    if face:
        pose += list(range(TRANSL.stop + model.num_betas, model.num_parameters))
    return torch.tensor(pose, device=model.device)


class Fitter:
    """Fits all usable frames of one sequence; create, then :meth:`run`.

    ``terms``: of the body's energy, by default the quickest form on the model's device;
    ``definition``: where the detector's points are expected.
    """

    def __init__(
        self,
        model: BodyModel,
        seen: Observations,
        clouds: list[PersonCloud | None],
        settings: BodyFitSettings,
        pose_prior: VPoser | None = None,
        terms: Terms | None = None,
        definition: Definition | None = None,
    ) -> None:
        self.model, self.settings, self.pose_prior = model, settings, pose_prior
        self.definition = definition or Definition.unknown()
        self._terms = terms
        self._progress = Progress(log, "body: minimised", None, "rounds")
        self.evidence = Evidence(model, seen, clouds, settings.cloud_weight)
        self.frames = self.evidence.frames
        self.one_shape = settings.shape == "shared"

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=self.model.dtype, device=self.model.device)

    def run(self) -> Fit:
        """All rounds; see the module's text."""
        evidence, base = self.evidence, self._start()
        problem = BodyProblem(
            self.model, self.evidence.keypoints(), self.evidence.samples, base,
            columns_of(self.model, hands=False, face=False, betas=not self.one_shape),
            self.one_shape,
            offsets=torch.as_tensor(self.definition.offsets).to(base),
            u=base.new_zeros(len(COVERINGS)),
            self_weight=self.settings.self_penetration_weight,
            definition=self.definition, terms=self._terms,
        )  # fmt: skip
        problem.targets = self._lifted()
        for widened in WIDENED if problem.targets else (1.0, 1.0):
            evidence.observe_keypoints(problem, widened=widened)
            self._minimise(problem, 6)
            evidence.refine_sigma(problem)
        problem.fit_shared = True
        for reach in CLOUD_REACH_M[:2] if evidence.has_cloud else ():
            problem.rows = evidence.match(problem, reach)
            evidence.observe_keypoints(problem)
            self._minimise(problem, 3)
            evidence.refine_sigma(problem)
            evidence.refine_cloud_noise(problem)
            problem.targets = None
        recover(problem, evidence.seen.times[self.frames])
        hands, face = self.settings.hands, self.settings.face
        if hands or face:
            self._extremities(problem, hands=hands, face=face)
        # What is shared stays free: only hands that are fitted tell how long forearms and hands
        # are, and where the detector's wrist lies on a forearm whose twist they give.
        problem.columns = columns_of(self.model, hands=hands, face=face, betas=not self.one_shape)
        for last in (False, True):
            if evidence.has_cloud:
                problem.rows = evidence.match(problem, CLOUD_REACH_M[-1])
            problem.touching = evidence.touch(problem)
            evidence.refine_sigma(problem)
            evidence.observe_keypoints(problem, hands=hands, face=face)
            solution = self._minimise(problem, 4, keep_normal=last)
        assert solution.normal is not None
        return self._report(problem, solution.normal.hessian)

    def resume(self, base: Tensor, settled: Settled) -> BodyProblem:
        """The last round's problem at other bodies (N,P), with what a fit found to be constant."""
        self.evidence.keypoint_sigma = settled.keypoint_sigma.to(base)
        self.evidence.cloud_noise = settled.cloud_noise.to(base)
        self.evidence.keypoint_doubt = settled.keypoint_doubt.to(base)
        return BodyProblem(
            self.model, self.evidence.keypoints(), self.evidence.samples, base,
            columns_of(
                self.model, hands=self.settings.hands, face=self.settings.face, betas=False
            ),
            False,
            offsets=settled.offsets.to(base), u=settled.covering.to(base),
            self_weight=self.settings.self_penetration_weight,
            terms=self._terms,
        )  # fmt: skip

    def observe(self, problem: BodyProblem) -> None:
        """Update correspondences, visibility and pixel sigmas at the problem's bodies."""
        if self.evidence.has_cloud:
            problem.rows = self.evidence.match(problem, CLOUD_REACH_M[-1])
        problem.touching = self.evidence.touch(problem)
        self._expect_pose(problem)
        self.evidence.observe_keypoints(problem, hands=self.settings.hands, face=self.settings.face)

    def observe_only(self, problem: BodyProblem, view: np.ndarray) -> None:
        """Compare the problem's bodies with one camera of each frame, ``view`` (N,): its points and
        masks, and the body's keypoints. What :meth:`observe` took is spent."""
        if self.evidence.has_cloud:
            problem.rows = self.evidence.match(problem, CLOUD_REACH_M[-1], view)
        self.evidence.observe_keypoints(problem)

    def residuals(self, problem: BodyProblem) -> tuple[Tensor, Tensor]:
        """Median pixel error (N,C) and cloud distance (N,), metres; NaN = nothing seen."""
        found = self._of_body(problem, self.evidence.pixel_residuals(problem))
        return found.nanmedian(2).values, self.evidence.cloud_residual

    def _of_body(self, problem: BodyProblem, residuals: Tensor) -> Tensor:
        """Errors (N,C,25) of the body's keypoints, px, NaN = not seen, from ``residuals``
        (N,C,K,2)."""
        assert problem.views is not None
        pixels = residuals[:, :, BODY].norm(dim=-1)
        return torch.where(problem.views.confidence[:, :, BODY] > 0, pixels, torch.nan)

    def _report(self, problem: BodyProblem, hessian: Tensor) -> Fit:
        """Residuals of the solution."""
        assert problem.views is not None
        evidence, views, index = self.evidence, problem.views, problem.keypoints.index
        residuals = evidence.pixel_residuals(problem)
        pixels = self._of_body(problem, residuals)
        every = residuals.norm(dim=-1) / views.sigma
        whitened = pixels / views.sigma[:, :, BODY]
        return Fit(
            frames=self.frames,
            vectors=problem.base,
            columns=problem.columns,
            hessian=hessian,
            one_shape=problem.one_shape,
            shared_counts=problem.shared_counts(),
            # the median of a chi-squared variable with two degrees of freedom is 2 ln 2
            excess=((whitened**2 / 2).flatten(1).nanmedian(1).values / np.log(2)).clamp_min(1.0),
            pixel_residual=pixels.nanmedian(2).values,
            cloud_residual=evidence.cloud_residual,
            settled=Settled(
                problem.offsets,
                problem.u,
                evidence.keypoint_sigma,
                evidence.cloud_noise,
                evidence.keypoint_doubt,
            ),
            parts=compare(
                every,
                views.confidence,
                index,
                evidence.keypoint_sigma[index],
                KEYPOINT_SCALE,
                None if problem.rows is None else (evidence.sample_joints, evidence.measured),
            ),
        )

    def _minimise(self, problem: BodyProblem, trials: int, keep_normal: bool = False) -> Solution:
        self._expect_pose(problem)
        shared = problem.shared_start()
        solution = minimise(
            problem,
            problem.own_start(),
            shared if len(shared) else None,
            max_trials=trials,
            cost_tolerance=1e-3,
            keep_normal=keep_normal,
        )
        problem.accept(solution.own, solution.shared)
        self._progress.step()
        return solution

    def _expect_pose(self, problem: BodyProblem) -> None:
        """Linearise the learned pose prior, where there is one, about the problem's poses."""
        if self.pose_prior is not None:
            problem.pose = self.pose_prior.around(problem.base[:, 3:66])

    # --- rounds ------------------------------------------------------------------------------

    def _start(self) -> Tensor:
        """Parameters (N,P) fitted to the triangulated body keypoints, mean shape and hands."""
        rest = self.model.zeros()
        keypoints = self.model.keypoints_of(rest)[0].double().cpu().numpy()
        pelvis = (
            self.model.forward(rest, vertex_ids=np.array([0])).joints[0, 0].double().cpu().numpy()
        )
        joints = self.evidence.seen.joints[self.frames]
        placed = between(
            place_trunk(keypoints, joints, pelvis), self.evidence.seen.times[self.frames]
        )
        straight = self._fit_triangulated(placed, joints)
        poor = np.flatnonzero((straight.cost > TURN_WORSE * straight.cost.median()).cpu().numpy())
        if len(poor):
            turned = self._fit_triangulated(turned_around(placed[poor]), joints[poor])
            better = turned.cost < straight.cost[poor]
            straight.own[poor[better.cpu().numpy()]] = turned.own[better]
        base = straight.own
        if self.one_shape:
            shape = slice(TRANSL.stop, TRANSL.stop + self.model.num_betas)
            base[:, shape] = base[:, shape].median(0).values
        return base

    def _lifted(self) -> Targets | None:
        """The body's keypoints that depth alone places, which one view's pixels cannot.

        They constrain the body until its cloud does. Occluded ones are far off: their pixels, with
        a wide sigma at first, bring the limbs to the right place.
        """
        seen = self.evidence.seen
        joints = seen.joints[self.frames][:, BODY]
        lifted = (seen.joint_views[self.frames][:, BODY] == 1) & np.isfinite(joints).all(2)
        if not lifted.any():
            return None
        return Targets(self._tensor(np.nan_to_num(joints)), self._tensor(lifted), START_SIGMA_M)

    def _fit_triangulated(self, placed: np.ndarray, joints: np.ndarray) -> Solution:
        base = self.model.zeros(len(placed)).vector().clone()
        base[:, 75:120], base[:, 120:165] = self.model.hand_mean[0], self.model.hand_mean[1]
        base[:, 0:3], base[:, TRANSL] = self._tensor(placed[:, :3]), self._tensor(placed[:, 3:])
        for name, sign in (("left_shoulder", -1.0), ("right_shoulder", 1.0)):
            base[:, 3 * JOINT_INDEX[name] + 2] = sign * 0.8  # arms hang rather than stretch
        joints = joints[:, BODY]
        known = np.isfinite(joints).all(2)
        problem = BodyProblem(
            self.model, self.evidence.keypoints(), self.evidence.samples, base,
            columns_of(self.model, hands=False, face=False, betas=True), False,
            offsets=torch.as_tensor(self.definition.offsets).to(base),
            u=base.new_zeros(len(COVERINGS)),
            targets=Targets(
                self._tensor(np.nan_to_num(joints)), self._tensor(known), START_SIGMA_M
            ),
            terms=self._terms,
        )  # fmt: skip
        solution = minimise(problem, problem.own_start(), max_trials=15, cost_tolerance=1e-2)
        problem.accept(solution.own, solution.shared)
        solution.own = problem.base
        return solution

    def _extremities(self, problem: BodyProblem, *, hands: bool, face: bool) -> None:
        """Wrists, fingers, jaw and expression; the rest of the body is fixed.

        No cloud yet. Hands start far off, as no wrist has been rotated yet: at first no keypoint
        counts as an outlier.
        """
        columns = columns_of(self.model, hands=hands, face=face, betas=False)
        fixed = columns_of(self.model, hands=False, face=False, betas=False)
        wrists = [3 * JOINT_INDEX[joint] + axis for joint in _WRISTS for axis in range(3)]
        fixed = fixed[~torch.isin(fixed, torch.tensor(wrists, device=fixed.device))]
        kept = (problem.columns, problem.rows, problem.one_shape, problem.fit_shared)
        problem.columns = columns[~torch.isin(columns, fixed)]
        problem.rows, problem.one_shape, problem.fit_shared = None, False, False
        for widened in WIDENED:
            self.evidence.observe_keypoints(problem, hands=hands, face=face, widened=widened)
            self._minimise(problem, 6)
        self.evidence.observe_keypoints(problem, hands=hands, face=face)
        problem.columns, problem.rows, problem.one_shape, problem.fit_shared = kept
