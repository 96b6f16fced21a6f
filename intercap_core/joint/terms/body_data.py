"""Body data: E_B of equation 6, which is equation 2 as the body fit left it.

Shape, thickness of clothing and keypoint offsets stay as the body fit found them. E_B's own terms
and weights are those of :mod:`intercap_core.body_fit.problem`; no setting of the joint fit weighs
them. E_theta_h alone counts less: a hand's pose lasts, so that over many frames its prior is seen
again and again where keypoints bring something new; with full weight in every frame fingers stay
tens of millimetres short of what several views agree on. A frame without a fit stays near the pose
interpolated there.

How E_J and E_D (equations 3 and 4) change with small corrections of the cameras.

A camera that is turned by w about its centre s, shifted by v and whose depth bias grows by b moves
what it measured at p by w x (p - s) + v - b r, r the ray to p for a metre of depth. To keypoints it
is as if the body had moved the other way. The weights are those that E_B has at the last look.
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
from intercap_core.body_fit import cloud_term, keypoint_term
from intercap_core.body_fit.evidence import Evidence
from intercap_core.body_fit.keypoint_term import KEYPOINT_SCALE
from intercap_core.body_fit.observations import person_clouds, read_observations
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.body_fit.schedule import Fitter, Settled
from intercap_core.config import BodyFitSettings
from intercap_core.geometry.camera import projection
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.joint.cameras import BIAS, FREEDOMS, SHIFT, TURN, Cameras, Sights
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.state import BODY, BODY_SHIFT, State
from intercap_core.joint.terms.term import Term
from intercap_core.joint.time_offsets import (
    OffsetPrior,
    TimeOffsets,
    cloud_sightings,
    estimate_offsets,
    keypoint_sightings,
)

# A hand's pose lasts about so long, seconds: what the prior of poses says in the frames of that
# time is one observation, where the body fit's frames stand alone. A grasp lasts longer, fingers
# on their way shorter. Tuned on the studio: 0.3 to 1 are alike.
HAND_LASTING_S = 0.5
BRIDGED_BODY_TURN = 0.3  # rad, of each joint; tuned on the studio
BRIDGED_BODY_SHIFT = 0.1  # metres; tuned on the studio
# Changes of offsets below this are not followed, seconds: a hand at 3 m/s moves a millimetre
# meanwhile.
OFFSET_UNCHANGED_S = 0.0003

log = logging.getLogger(__name__)
_FRAMES_TOGETHER = 64  # frames whose equations are held in single precision at a time
_CHUNK = 32  # frames whose derivatives are held at once


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


def add_by_cameras(
    evidence: Evidence, problem: BodyProblem, trusted: np.ndarray, seen: Sights
) -> None:
    """Add the ``trusted`` (N,) of the evidence's N frames at the problem's bodies."""
    frames = np.flatnonzero(trusted)
    for part in np.array_split(frames, max(1, -(-len(frames) // _CHUNK))):
        if len(part):
            _add_keypoints(evidence, problem, part, seen)
            _add_clouds(evidence, problem, part, seen)


def _add_keypoints(
    evidence: Evidence, problem: BodyProblem, part: np.ndarray, seen: Sights
) -> None:
    views = problem.views
    if views is None:
        return
    found = keypoint_term.evaluate(
        problem.model,
        problem.model.parameters(problem.base[part]),
        problem.keypoints,
        problem.all_offsets(),
        derivatives=True,
        columns=torch.arange(BODY.stop, device=problem.base.device),
    )
    assert found.derivatives is not None
    points = found.points[:, None]
    if views.shift is not None:
        points = points + views.shift[part]
    rotation = views.colour_from_master[:, :3, :3]
    in_camera = points @ rotation.transpose(1, 2) + views.colour_from_master[:, None, :3, 3]
    pixels, by_camera = projection.project_with_jacobian(in_camera, views.lenses[:, None])
    sigma = views.sigma[part][..., None]
    known = (views.confidence[part] > 0)[..., None]
    residual = torch.where(known, (pixels - views.observed[part]) / sigma, 0)
    weight = views.confidence[part] * geman_mcclure_weight((residual**2).sum(-1), KEYPOINT_SCALE)
    by_point = by_camera @ rotation[:, None] / sigma[..., None]  # (b, C, K, 2, 3)
    by_point = torch.where(known[..., None], by_point, 0)
    centre = _poses(evidence).to(points)[:, :3, 3]
    arm = (points - centre[:, None])[..., None, :].expand(by_point.shape)
    nothing = by_point.new_zeros(*by_point.shape[:-1], 1)
    rows = -torch.cat([torch.linalg.cross(arm, by_point), by_point, nothing], -1)
    weighted = rows * weight[..., None, None]
    hessian = torch.einsum("bckaf,bckag->cfg", weighted, rows)
    gradient = torch.einsum("bckaf,bcka->cf", weighted, residual)
    by_keypoint = torch.einsum("bckaf,bckax->bkxcf", weighted, by_point)
    cross = torch.einsum("bkxn,bkxcf->bncf", found.derivatives, by_keypoint)
    for camera, block in enumerate(_array(hessian)):
        own = slice(FREEDOMS * camera, FREEDOMS * (camera + 1))
        seen.hessian[own, own] += block
    seen.pull[:] += _array(gradient).ravel()
    seen.cross[evidence.frames[part], BODY] += _array(cross).reshape(*cross.shape[:2], -1)


def _add_clouds(evidence: Evidence, problem: BodyProblem, part: np.ndarray, seen: Sights) -> None:
    rows, by_view = problem.rows, evidence.by_view
    if rows is None or by_view is None:
        return
    model = problem.model
    linear = model.linearise(model.parameters(problem.base[part]), vertex_ids=evidence.sample_ids)
    normal, points = rows.normal[part], linear.vertices
    by_body = -linear.along(normal[:, :, None])[:, :, 0][..., BODY]
    own = rows.frames(part)
    residual = cloud_term.residuals(points, own, problem.thickness_of_group(), evidence.group)
    poses = _poses(evidence).to(points)
    arm = points[:, None] - poses[:, None, :3, 3]  # (b, C, S, 3)
    ray = arm / (arm @ poses[:, :3, 2, None]).clamp_min(0.1)
    facing = normal[:, None].expand(arm.shape)
    by_camera = points.new_zeros(*arm.shape[:3], FREEDOMS)
    by_camera[..., TURN], by_camera[..., SHIFT] = torch.linalg.cross(arm, facing), facing
    by_camera[..., BIAS] = -(facing * ray).sum(-1)
    number = by_view.points[part]
    share = number / number.sum(1, keepdim=True).clamp_min(1e-6)
    flat = (by_camera * share[..., None]).transpose(1, 2).flatten(2)  # (b, S, D)
    weighted = flat * own.weight[..., None]
    seen.hessian[:] += _array(torch.einsum("bsd,bse->de", weighted, flat))
    seen.pull[:] += _array(torch.einsum("bsd,bs->d", weighted, residual))
    seen.cross[evidence.frames[part], BODY] += _array(by_body.transpose(1, 2) @ weighted)


def _poses(evidence: Evidence) -> torch.Tensor:
    """(C, 4, 4) of the cameras; zeros for one without, which shows nothing."""
    return torch.as_tensor(np.nan_to_num(evidence.seen.rig.master_from_colour))


def _array(values: torch.Tensor) -> np.ndarray:
    return values.double().cpu().numpy()
