"""Schedule of the body's fit: five stages, each of which starts from the result of the last.

1. The trunk is placed rigidly, then each frame is fitted to triangulated keypoints (:mod:`.start`).
2. E_J of all frames together. If only the depth of a single view locates some keypoints, they are
   targets too, and the sigmas of E_J are wide at first (:meth:`Fitter._lift_by_depth`).
3. E_J + E_D: keypoint offsets and the thickness of clothing become free; frames that jump are
   refitted (:mod:`.recover`).
4. Hands and face, with the rest of the body fixed except the wrists.
5. All terms and parameters.

E_P_self is part of stage 5 only. The priors are part of all stages. With the setting
``shape: shared``, all frames have the same betas from stage 2 on.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import BODY
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.vposer import VPoser
from intercap_core.body_fit.clouds import PersonCloud
from intercap_core.body_fit.definition import Definition
from intercap_core.body_fit.evidence import Evidence
from intercap_core.body_fit.observations import Observations
from intercap_core.body_fit.problem import BodyProblem, columns_of, subject_places
from intercap_core.body_fit.quality import PartEvidence, compare_parts
from intercap_core.body_fit.recover import recover
from intercap_core.body_fit.shared_estimate import SharedEstimate
from intercap_core.body_fit.start import START_SIGMA_M, fit_start
from intercap_core.body_fit.surface import COVERINGS
from intercap_core.body_fit.term_inputs import Targets
from intercap_core.config import BodyFitSettings
from intercap_core.geometry.solve.levenberg_marquardt import Solution, minimise
from intercap_core.progress import Progress

log = logging.getLogger(__name__)

# Largest valid distance of correspondences, metres: in the first and second round of stage 3, then
# in stage 5. Tuned on the studio.
_CLOUD_REACH_M = (0.10, 0.06, 0.05)
# Factors of the keypoints' sigma in successive minimisations, while limbs may be far off. Tuned on
# the studio.
_WIDENED = (5.0, 2.0)
_WRISTS = ("left_wrist", "right_wrist")


@dataclass(frozen=True)
class Settled:
    """Estimated quantities that all frames share, in addition to the shape."""

    offsets: Tensor
    """(25, 3) offsets of the body keypoints in the frames of their bones, metres."""
    covering: Tensor
    """(G,) logarithm of each covering's thickness over the usual one."""
    keypoint_sigma: Tensor
    """(135,) standard deviation of a keypoint of median confidence, metres."""
    cloud_noise: Tensor
    """(G,) standard deviation of a sample's mean distance, by covering, metres."""
    keypoint_doubt: Tensor
    """(135,) exponent a: sigma is proportional to confidence^-a."""


@dataclass(frozen=True)
class Hessians:
    """Gauss-Newton matrices at the solution of a problem, which are computed when they are read."""

    problem: BodyProblem
    """The problem."""
    solution: Solution
    """Its own and shared parameters."""

    def __getitem__(self, frames: slice) -> Tensor:
        """Return the matrices (b, n + m, n + m) of some frames."""
        index = torch.arange(len(self.solution.own))[frames]
        own, shared = self.solution.own[frames], self.solution.shared
        return self.problem.linearise(own, shared, index).hessian


@dataclass(frozen=True)
class BodyFit:
    """The fit of N of the sequence's T frames."""

    frames: np.ndarray
    """(N,) indices of the fitted frames."""
    vectors: Tensor
    """(N, P) parameters."""
    columns: Tensor
    """(n,) columns of a frame's own parameters in ``vectors``."""
    hessian: Tensor | Hessians
    """(N, n + m, n + m) Gauss-Newton matrix of each frame's energy by n own and m shared
    parameters; see :mod:`.problem` for their order."""
    one_shape: bool
    """The betas are shared."""
    shared_counts: Tensor
    """(m,) how many times the prior of each shared parameter counts in a frame."""
    pixel_residual: Tensor
    """(N, C) median error of the body keypoints, px, NaN = none detected."""
    cloud_residual: Tensor
    """(N,) median distance of the depth points from the skin, metres, NaN = none."""
    settled: Settled
    """Quantities that all frames share."""
    parts: PartEvidence
    """Support of each part of the body by the observations."""
    refitted: np.ndarray
    """(N,) bool: the energy of the frame has several minima (:func:`.recover.recover`)."""

    def shared_estimate(self, sequence: str, covariance: Tensor) -> SharedEstimate:
        """Return shape and coverings; ``covariance`` (m, m) of :mod:`.uncertainty`."""
        offsets, u = self.settled.offsets, self.settled.covering
        num_betas = len(covariance) - offsets.numel() - len(u)  # 0 if each frame has its own
        betas = self.vectors[0, TRANSL.stop : TRANSL.stop + num_betas]
        places = subject_places(len(covariance), num_betas)
        parts = (part.double().numpy() for part in (betas, u, covariance[places][:, places]))
        return SharedEstimate(sequence, *parts)


class Fitter:
    """Fits all usable frames of one sequence.

    Args:
        model: the body.
        observations: of the sequence.
        clouds: points of each frame.
        settings: settings of the stage.
        pose_prior: learned prior of the body pose; None = the open prior.
        definition: prior of the keypoint offsets; None = unknown.
        window: slice or indices of the frames to use; None = all. ``clouds`` are those of the
            window.
        earlier: shape and coverings of the subject in another sequence: their start and, in place
            of the usual one, their prior; None = none.
    """

    def __init__(
        self,
        model: BodyModel,
        observations: Observations,
        clouds: Sequence[PersonCloud | None],
        settings: BodyFitSettings,
        pose_prior: VPoser | None = None,
        definition: Definition | None = None,
        window: slice | np.ndarray | None = None,
        earlier: SharedEstimate | None = None,
    ) -> None:
        self.model, self.settings, self.pose_prior = model, settings, pose_prior
        self.earlier = earlier
        self.definition = definition or Definition.unknown()
        self._progress = Progress(log, "body: minimised", None, "rounds")
        self.evidence = Evidence(model, observations, clouds, settings.cloud_weight, window)
        self.frames = self.evidence.frames
        self.one_shape = settings.shape == "shared"

    def run(self) -> BodyFit:
        """Fit all frames by the stages of the module."""
        evidence, hands, face = self.evidence, self.settings.hands, self.settings.face
        base = self.model.zeros(len(self.frames)).vector()
        u = self.earlier.covering if self.earlier else np.zeros(len(COVERINGS))
        problem = self._problem(
            base=base,
            columns=columns_of(self.model, hands=False, face=False, betas=not self.one_shape),
            one_shape=self.one_shape,
            offsets=torch.as_tensor(self.definition.offsets).to(base),
            u=torch.as_tensor(u).to(base),
            definition=self.definition,
            earlier=self.earlier,
        )
        problem.base = fit_start(evidence, problem)
        if self.one_shape:
            shape = problem.layout.shape
            problem.base[:, shape] = (
                torch.as_tensor(self.earlier.betas).to(base)
                if self.earlier
                else problem.base[:, shape].median(0).values
            )
        problem.targets = self._lift_by_depth()
        # stage 2
        for widened in _WIDENED if problem.targets else (1.0, 1.0):
            evidence.observe_keypoints(problem, widened=widened)
            self._minimise(problem, 6)
            evidence.refine_sigma(problem)
        problem.fit_shared = True  # stage 3
        for reach in _CLOUD_REACH_M[:2] if evidence.has_cloud else ():
            evidence.observe_skin(problem, reach, keep_views=False, pairs=False)
            evidence.observe_keypoints(problem)
            self._minimise(problem, 3)
            evidence.refine_sigma(problem)
            evidence.refine_cloud_noise(problem)
            problem.targets = None
        refitted = recover(problem, evidence.observations.times[self.frames])
        if hands or face:
            self._fit_extremities(problem)
        # Shared parameters stay free. The hands, which are fitted now, determine the lengths of
        # forearms and hands. They also determine the twist of the forearm, and with it the offset
        # of the detector's wrist, which is fixed in the frame of the forearm.
        problem.columns = columns_of(self.model, hands=hands, face=face, betas=not self.one_shape)
        for _ in range(2):
            evidence.observe_skin(problem, _CLOUD_REACH_M[-1], keep_views=False)
            evidence.refine_sigma(problem)
            evidence.observe_keypoints(problem, hands=hands, face=face)
            solution = self._minimise(problem, 4)
        return self._report(problem, Hessians(problem, solution), refitted)

    def resume(self, base: Tensor, settled: Settled) -> BodyProblem:
        """Return the problem of stage 5 at other bodies ``base`` (N, P), without observations.

        Shape and the quantities of ``settled`` are fixed.
        """
        self.evidence.keypoint_sigma = settled.keypoint_sigma.to(base)
        self.evidence.cloud_noise = settled.cloud_noise.to(base)
        self.evidence.keypoint_doubt = settled.keypoint_doubt.to(base)
        hands, face = self.settings.hands, self.settings.face
        return self._problem(
            base=base,
            columns=columns_of(self.model, hands=hands, face=face, betas=False),
            one_shape=False,
            offsets=settled.offsets.to(base),
            u=settled.covering.to(base),
        )

    def observe(self, problem: BodyProblem, places: np.ndarray | None = None) -> None:
        """Update correspondences, contacts, the pose prior and sigmas at the problem's bodies.

        places (n,): indices of the frames whose correspondences and contacts are used; None = all.
        """
        self.evidence.observe_skin(problem, _CLOUD_REACH_M[-1], places=places)
        self._linearise_pose_prior(problem)
        self.evidence.observe_keypoints(problem, hands=self.settings.hands, face=self.settings.face)

    def observe_only(self, problem: BodyProblem, view: np.ndarray | None) -> None:
        """Update correspondences and body keypoints only.

        view (N,): index of the camera whose measurements are used in each frame; None = the depth
        points of all cameras. Keypoints are those of all cameras.
        """
        self.evidence.observe_skin(
            problem,
            _CLOUD_REACH_M[-1],
            only=view,
            keep_views=view is not None,
            pairs=False,
            depth_points_only=view is None,
        )
        self.evidence.observe_keypoints(problem)

    def residuals(self, problem: BodyProblem) -> tuple[Tensor, Tensor]:
        """Return the median errors of the body keypoints and of the cloud; NaN = none.

        Returns:
            (N, C) median error of the body keypoints, px.
            (N,) median distance of the depth points from the skin, metres.
        """
        pixels = self._body_errors(problem, self.evidence.pixel_residuals(problem))
        return pixels.nanmedian(2).values, self.evidence.cloud_residual

    def _problem(self, **changes: Any) -> BodyProblem:
        """Return a problem with the settings and samples of this fit."""
        return BodyProblem(
            model=self.model,
            keypoints=self.evidence.keypoints(),
            samples=self.evidence.samples,
            self_weight=self.settings.self_penetration_weight,
            **changes,
        )

    def _body_errors(self, problem: BodyProblem, residuals: Tensor) -> Tensor:
        """Return errors (N, C, 25) of the body keypoints, px, NaN = not detected.

        residuals (N, C, K, 2): px.
        """
        assert problem.views is not None
        pixels = residuals[:, :, BODY].norm(dim=-1)
        return torch.where(problem.views.confidence[:, :, BODY] > 0, pixels, torch.nan)

    def _report(self, problem: BodyProblem, hessian: Hessians, refitted: np.ndarray) -> BodyFit:
        """Return the solution with its residuals."""
        assert problem.views is not None
        evidence, views, index = self.evidence, problem.views, problem.keypoints.index
        residuals = evidence.pixel_residuals(problem)
        pixels = self._body_errors(problem, residuals)
        return BodyFit(
            frames=self.frames,
            vectors=problem.base,
            columns=problem.columns,
            hessian=hessian,
            one_shape=problem.one_shape,
            shared_counts=problem.layout.prior(problem.base)[2],
            pixel_residual=pixels.nanmedian(2).values,
            cloud_residual=evidence.cloud_residual,
            settled=Settled(
                problem.offsets,
                problem.u,
                evidence.keypoint_sigma,
                evidence.cloud_noise,
                evidence.keypoint_doubt,
            ),
            parts=compare_parts(
                residuals.norm(dim=-1) / views.sigma,
                views.confidence,
                index,
                evidence.keypoint_sigma[index],
                None if problem.rows is None else (evidence.sample_joints, evidence.measured),
            ),
            refitted=refitted,
        )

    def _minimise(self, problem: BodyProblem, trials: int) -> Solution:
        """Minimise by at most ``trials`` steps, and set the problem's parameters to the result."""
        self._linearise_pose_prior(problem)
        shared = problem.shared_start()
        solution = minimise(
            problem,
            problem.own_start(),
            shared if len(shared) else None,
            max_trials=trials,
            cost_tolerance=1e-3,
        )
        problem.accept(solution.own, solution.shared)
        self._progress.step()
        return solution

    def _linearise_pose_prior(self, problem: BodyProblem) -> None:
        """Linearise the learned pose prior, if there is one, about the problem's poses."""
        if self.pose_prior is not None:
            problem.pose = self.pose_prior.linearise(problem.base[:, 3:66])  # body_pose

    def _lift_by_depth(self) -> Targets | None:
        """Return the body keypoints that only the depth of one view locates; None = no keypoints.

        They constrain the body until its cloud does. The depth at an occluded keypoint is that of
        the occluder. E_J corrects this error by the keypoints' pixels; as the body may be far off
        until then, the sigmas of E_J are wide at first.
        """
        observations = self.evidence.observations
        joints = observations.joints[self.frames][:, BODY]
        lifted = (observations.joint_views[self.frames][:, BODY] == 1) & np.isfinite(joints).all(2)
        if not lifted.any():
            return None
        points, confidence = (
            torch.as_tensor(values, dtype=self.model.dtype)
            for values in (np.nan_to_num(joints), lifted)
        )
        return Targets(points, confidence, START_SIGMA_M)

    def _fit_extremities(self, problem: BodyProblem) -> None:
        """Fit wrists, fingers, jaw and expression without the cloud; the rest of the body is fixed.

        No keypoint of earlier stages depends on the wrists, so hands may be far off: sigmas are
        wide at first.
        """
        hands, face = self.settings.hands, self.settings.face
        columns = columns_of(self.model, hands=hands, face=face, betas=False)
        fixed = columns_of(self.model, hands=False, face=False, betas=False)
        wrists = [3 * JOINT_INDEX[joint] + axis for joint in _WRISTS for axis in range(3)]
        fixed = fixed[~torch.isin(fixed, torch.tensor(wrists))]
        kept = (problem.columns, problem.rows, problem.one_shape, problem.fit_shared)
        problem.columns = columns[~torch.isin(columns, fixed)]
        problem.rows, problem.one_shape, problem.fit_shared = None, False, False
        for widened in _WIDENED:
            self.evidence.observe_keypoints(problem, hands=hands, face=face, widened=widened)
            self._minimise(problem, 6)
        self.evidence.observe_keypoints(problem, hands=hands, face=face)
        problem.columns, problem.rows, problem.one_shape, problem.fit_shared = kept
