"""Body data: E_B of equation 6, which is equation 2 as the body fit left it.

Shape, thickness of clothing and keypoint offsets stay as the body fit found them. E_B's own terms
and weights are those of :mod:`intercap_core.body_fit.problem`; no setting of the joint fit weighs
them. E_theta_h alone counts less: a hand's pose lasts, so that over many frames its prior is seen
again and again where keypoints bring something new; with full weight in every frame fingers stay
tens of millimetres short of what several views agree on. A frame without a fit stays near the pose
interpolated there.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from intercap_core.artefacts import Artefact
from intercap_core.body.model import BodyModel
from intercap_core.body.vposer import VPoser
from intercap_core.body_fit.observations import person_clouds, read_observations
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.body_fit.schedule import Fitter, Settled
from intercap_core.config import BodyFitSettings
from intercap_core.joint.cameras import FREEDOMS, Cameras, Sights
from intercap_core.joint.constants import (
    BRIDGED_BODY_SHIFT,
    BRIDGED_BODY_TURN,
    HAND_LASTING_S,
    OFFSET_UNCHANGED_S,
)
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.sightings import cloud_sightings, keypoint_sightings
from intercap_core.joint.state import BODY, BODY_SHIFT, State
from intercap_core.joint.terms.body_cameras import add_by_cameras
from intercap_core.joint.terms.term import Term
from intercap_core.joint.time_offsets import OffsetPrior, TimeOffsets, estimate_offsets

log = logging.getLogger(__name__)

_FRAMES_TOGETHER = 64  # frames whose equations are held in single precision at a time


@dataclass(frozen=True)
class Residuals:
    """``keypoint_px`` (T, C) median reprojection error and ``cloud_m`` (T,) median distance of the
    cloud beyond the coverings; NaN = nothing seen."""

    keypoint_px: np.ndarray
    cloud_m: np.ndarray


class BodyData(Term):
    """E_B of the frames whose fit is ``trusted`` (T,): keypoints, clouds and priors."""

    name = "body_data"

    def __init__(self, fitter: Fitter, problem: BodyProblem, trusted: np.ndarray) -> None:
        self._fitter, self._problem = fitter, problem
        self._trusted = trusted[fitter.frames]
        self._index = torch.arange(len(fitter.frames), device=fitter.model.device)
        self._bridged: np.ndarray | None = None

    @classmethod
    def load(
        cls,
        *,
        frames: Path,
        scene: Path,
        person: Path,
        body_fit: Artefact,
        model: BodyModel,
        state: State,
        settings: BodyFitSettings,
        fps: float,
        pose_prior: VPoser | None = None,
    ) -> BodyData:
        """Read the observations and what the body fit found to be constant."""
        observations = read_observations(scene, person)
        clouds = person_clouds(frames, observations, settings.points_per_frame, model.device)
        fitter = Fitter(model, observations, clouds, settings, pose_prior)
        settled = Settled(
            *(
                torch.from_numpy(body_fit[name])
                for name in (
                    "keypoint_offsets",
                    "covering",
                    "keypoint_sigma",
                    "covering_noise",
                    "keypoint_doubt",
                )
            )
        )
        problem = fitter.resume(state.parameters(model).vector()[fitter.frames], settled)
        problem.columns = torch.arange(BODY.stop, device=model.device)
        lasting = min(fps * HAND_LASTING_S, len(fitter.frames))
        problem.hand_share = 1 / max(lasting, 1.0)
        return cls(fitter, problem, ~body_fit["failed"])

    def refresh(self, state: State) -> None:
        """Take correspondences and visibility anew at ``state``."""
        self._place(state)
        self._fitter.observe(self._problem)
        if self._bridged is None:
            self._bridged = state.body.copy()

    def compare(self, state: State, camera: np.ndarray) -> None:
        """Have :meth:`residuals` and :meth:`person_by_view` tell of ``state``, of the one
        ``camera`` (T,) of each frame alone: others show nothing of the person's points. Before
        equations are made again, :meth:`refresh`."""
        self._place(state)
        self._fitter.observe_only(self._problem, camera[self._fitter.frames])

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add E_B at ``state`` with the correspondences of the last :meth:`refresh`."""
        equations.add_blocks(self.name, BODY, *self._equations(state))

    def of_views(self, used: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E_B's matrix (T, 168, 168), gradient (T, 168) and energy (T,) at ``state``, of the last
        :meth:`refresh`, by the cameras ``used`` (T, C) alone."""
        problem, evidence = self._problem, self._fitter.evidence
        counted = torch.as_tensor(used[self._fitter.frames], device=problem.base.device)[..., None]
        views, rows = problem.views, problem.rows
        assert views is not None, "refresh comes first"
        problem.views = replace(views, confidence=views.confidence * counted)
        if evidence.by_view is not None:
            problem.rows = evidence.rows(evidence.by_view.points * counted)
        try:
            return self._equations(state)
        finally:
            problem.views, problem.rows = views, rows

    def _equations(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E_B's matrix (T, 168, 168), gradient (T, 168) and energy (T,)."""
        assert self._bridged is not None, "refresh comes first"
        pose = torch.as_tensor(state.body[self._fitter.frames]).to(self._problem.base)
        shared = pose.new_zeros(0)  # nothing that all frames share is free here
        hessian = np.zeros((len(state), BODY.stop, BODY.stop))
        gradient = np.zeros((len(state), BODY.stop))
        energy = np.zeros(len(state))
        for some in self._index.split(_FRAMES_TOGETHER):
            normal = self._problem.linearise(pose[some], shared, some)
            places = some.cpu().numpy()  # a tensor of one place would be taken for a number
            trusted = self._trusted[places]
            at = self._fitter.frames[places][trusted]
            hessian[at] = normal.hessian.cpu().numpy()[trusted]
            gradient[at] = normal.gradient.cpu().numpy()[trusted]
            energy[at] = normal.cost.double().cpu().numpy()[trusted]
        frames = self._fitter.frames[self._trusted]
        bridged = np.setdiff1d(np.arange(len(state)), frames)
        precision = np.full(BODY.stop, BRIDGED_BODY_TURN**-2)
        precision[BODY_SHIFT] = BRIDGED_BODY_SHIFT**-2
        offset = state.body[bridged] - self._bridged[bridged]
        hessian[bridged] = np.diag(precision)
        gradient[bridged] = precision * offset
        energy[bridged] = 0.5 * (precision * offset**2).sum(axis=1)
        return hessian, gradient, energy

    def take_cameras(self, cameras: Cameras, time_offset: np.ndarray | None = None) -> None:
        """See through these cameras, that expose so late (C,), seconds, from the next
        :meth:`refresh` on; None leaves the offsets as they are."""
        evidence = self._fitter.evidence
        evidence.take_cameras(cameras.rig, cameras.depth_bias)
        if time_offset is not None:
            evidence.seen = replace(evidence.seen, time_offset=time_offset)

    def sights(self, state: State, share: float) -> Sights:
        """What keypoints and clouds of the trusted frames say of poses and cameras, at
        ``state``."""
        self._place(state)
        count = FREEDOMS * len(self._fitter.evidence.seen.rig)
        hessian, gradient, _ = self._equations(state)
        cross = np.zeros((len(state), BODY.stop, count))
        seen = Sights(
            BODY, hessian, gradient, cross, np.zeros((count, count)), np.zeros(count), share
        )
        add_by_cameras(self._fitter.evidence, self._problem, self._trusted, seen)
        return seen

    def residuals(self) -> Residuals:
        """How far the images are from the state of the last :meth:`refresh`."""
        pixels, metres = self._fitter.residuals(self._problem)
        total = len(self._fitter.evidence.seen.times)
        keypoint = np.full((total, pixels.shape[1]), np.nan)
        cloud = np.full(total, np.nan)
        keypoint[self._fitter.frames] = pixels.cpu().numpy()
        cloud[self._fitter.frames] = metres.cpu().numpy()
        return Residuals(keypoint, cloud)

    def person_by_view(self) -> np.ndarray:
        """Median distance (T, C) of the person's points from the skin beyond the coverings, metres,
        in every camera, at the last :meth:`refresh`; NaN = nothing seen."""
        seen = self._fitter.evidence.seen
        person = np.full((len(seen.times), len(seen.rig)), np.nan)
        found = self._fitter.evidence.by_view
        if found is not None:
            apart = (found.distance - self._problem.thickness()).abs()
            apart = torch.where(found.points > 0, apart, torch.nan)
            person[self._fitter.frames] = apart.nanmedian(2).values.cpu().numpy()
        return person

    @property
    def time_offset(self) -> np.ndarray:
        """(C,) seconds by which each camera is predicted to expose late."""
        return self._fitter.evidence.seen.time_offset

    def estimate_offsets(self, prior: OffsetPrior) -> TimeOffsets:
        """Estimate the cameras' time offsets at the state of the last :meth:`refresh`."""
        evidence, problem = self._fitter.evidence, self._problem
        sightings = [
            replace(found, weight=found.weight * self._trusted[:, None, None])
            for found in (keypoint_sightings(evidence, problem), cloud_sightings(evidence, problem))
            if found is not None
        ]
        times = evidence.seen.times[evidence.frames]
        offsets = estimate_offsets(sightings, times, self.time_offset, prior)
        log.info("time offsets, ms: %s", np.round(1e3 * offsets.offset, 2))
        return offsets

    def take_offsets(self, offset: np.ndarray) -> float:
        """Predict with offsets (C,) from now on; returns the largest change, seconds."""
        evidence = self._fitter.evidence
        change = float(np.abs(offset - self.time_offset).max())
        if change > OFFSET_UNCHANGED_S:
            evidence.seen = replace(evidence.seen, time_offset=offset)
            self._fitter.observe(self._problem)
        return change

    def _place(self, state: State) -> None:
        vector = state.parameters(self._fitter.model).vector()
        self._problem.base = vector[self._fitter.frames].to(self._problem.base)
