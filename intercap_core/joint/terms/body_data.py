"""Body data: E_B of equation 6, which is equation 2 with the constants of the body fit.

Shape, thickness of clothing and keypoint offsets are those of the body fit. The terms of E_B and
their weights are those of :mod:`intercap_core.body_fit.problem`, except for E_theta_h, the prior of
the hands' pose. A hand keeps its pose for about half a second, so that the prior counts once in
this time and not in every frame. With full weight in every frame, fingers stay tens of millimetres
short of the pose on which several views agree.

E_J and E_D (equations 3 and 4) also depend on the cameras. Let a camera turn by w about its centre
s and shift by v, and let its depth bias grow by b. A point p that it measures is then displaced by
w x (p - s) + v - b r, with r the ray to p per metre of depth. A reprojected keypoint moves as if
the body had been displaced by the opposite.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.vposer import VPoser
from intercap_core.body_fit import cloud_term, keypoint_term
from intercap_core.body_fit.clouds import read_clouds
from intercap_core.body_fit.evidence import Evidence
from intercap_core.body_fit.observations import Observations
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.body_fit.schedule import Fitter, Settled
from intercap_core.config import BodyFitSettings
from intercap_core.geometry.camera import projection
from intercap_core.geometry.solve.robust import OUTLIER_SIGMAS, geman_mcclure_weight
from intercap_core.joint.cameras import BIAS, FREEDOMS, SHIFT, TURN, CameraEvidence, Cameras
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.state import BODY, State, frame_chunks
from intercap_core.joint.terms.term import Equation, JointTerm
from intercap_core.schemas import BODY_FIT
from intercap_core.sequence_inputs import SequencePaths

# Datasets of body_fit.h5 with the fields of ``Settled``, in their order.
_SETTLED = ("keypoint_offsets", "covering", "keypoint_sigma", "covering_noise", "keypoint_doubt")


# A frame without a fit stays near its interpolated pose: inverse variances of 0.3 rad, 0.1 m
# (tuned).
_FILLED_PRECISION = np.full(BODY.stop, 0.3**-2)
_FILLED_PRECISION[TRANSL] = 0.1**-2


@dataclass(frozen=True)
class BodyResiduals:
    """Distances of the body to the images; NaN without an observation."""

    keypoint_px: np.ndarray  # (T, C) median reprojection error, pixels
    cloud_m: np.ndarray  # (T,) median distance of the clouds beyond the clothing, metres


class BodyData(JointTerm):
    """E_B: keypoints, clouds and priors of the body."""

    name = "body_data"
    equation = Equation(
        symbol="E_B",
        source="6",
        formula="equation 2; shape, thickness of clothing and keypoint offsets stay as fitted; "
        "E_theta_h counts 1/n in each frame, n the frames of the half second that a hand's pose "
        "lasts",
    )

    def __init__(self, fitter: Fitter, problem: BodyProblem, trusted: np.ndarray) -> None:
        self._fitter, self._problem = fitter, problem
        self._trusted = trusted[fitter.frames]
        self._interpolated: np.ndarray | None = None  # bodies at the first refresh
        self._every = 1  # trusted frames that an observed one stands for

    @classmethod
    def load(
        cls,
        paths: SequencePaths,
        observations: Observations,
        *,
        model: BodyModel,
        state: State,
        frames: slice,
        settings: BodyFitSettings,
        fps: float,
        pose_prior: VPoser | None = None,
    ) -> BodyData:
        """Read the clouds of some frames, and the constants of the body fit.

        Args:
            observations: those of the whole recording.
            state: bodies in ``frames``.
            frames: the frames of the recording that count.
        """
        with artefacts.read(paths.body_fit, BODY_FIT) as body_fit:
            settled = Settled(*(torch.from_numpy(body_fit[name]) for name in _SETTLED))
            failed = body_fit["failed"][frames]
        clouds = read_clouds(paths.body_fit, paths.frames, observations.image_of, frames)
        fitter = Fitter(model, observations, clouds, settings, pose_prior, window=frames)
        problem = fitter.resume(state.parameters(model).vector()[fitter.frames], settled)
        problem.columns = torch.arange(BODY.stop)
        # a hand's pose lasts 0.5 s (tuned on the studio: 0.3 to 1 are alike)
        lasting = min(fps * 0.5, len(fitter.frames))
        problem.hand_share = 1 / max(lasting, 1.0)
        return cls(fitter, problem, ~failed)

    def refresh(self, state: State, every: int = 1) -> None:
        """Find correspondences and visibility at ``state``.

        ``every`` observes every n-th trusted frame only, for a correction of the cameras.
        """
        self._place(state)
        self._every, places = every, np.flatnonzero(self._trusted)[::every]
        self._fitter.observe(self._problem, None if every == 1 else places)
        if self._interpolated is None:
            self._interpolated = state.body.copy()

    def compare(self, state: State, camera: np.ndarray | None = None) -> None:
        """Compare ``state`` with the images, without equations.

        Afterwards :meth:`residuals` refers to ``state``. With ``camera`` (T,), the index of one
        view for each frame, only this view is compared, and :meth:`person_by_view` refers to it.
        Call :meth:`refresh` before further equations.
        """
        self._place(state)
        self._fitter.observe_only(
            self._problem, None if camera is None else camera[self._fitter.frames]
        )

    def add(self, state: State, equations: BandedEquations) -> None:
        """Add E_B at ``state`` with the correspondences of the last :meth:`refresh`."""
        if equations.energies_only:
            equations.add_energy(self.name, self._energy(state))
        else:
            equations.add_blocks(self.name, BODY, *self._equations(state))

    def linearise_views(
        self, used: np.ndarray, state: State
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E_B's matrix (T, 168, 168), gradient (T, 168), energy (T,) at ``state`` by some images.

        Only keypoints and depth images in the mask ``used`` (T, C, 2) count. Correspondences are
        those of the last :meth:`refresh`.
        """
        problem, evidence = self._problem, self._fitter.evidence
        keypoints, depth = torch.as_tensor(used[self._fitter.frames])[..., None, :].unbind(-1)
        views, rows = problem.views, problem.rows
        assert views is not None, "refresh comes first"
        problem.views = replace(views, confidence=views.confidence * keypoints)
        if evidence.by_view is not None:
            problem.rows = evidence.rows(evidence.by_view, evidence.by_view.points * depth)
        try:
            return self._equations(state)
        finally:
            problem.views, problem.rows = views, rows

    def _equations(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E_B's matrix (T, 168, 168), gradient (T, 168) and energy (T,)."""
        hessian = np.zeros((len(state), BODY.stop, BODY.stop))
        gradient = np.zeros((len(state), BODY.stop))
        energy = np.zeros(len(state))
        trusted = np.flatnonzero(self._trusted)
        frames = self._fitter.frames[trusted]
        hessian[frames], gradient[frames], energy[frames] = self._linearise(state, trusted)
        filled, offset = self._filled(state)
        hessian[filled] = np.diag(_FILLED_PRECISION)
        gradient[filled] = _FILLED_PRECISION * offset
        energy[filled] = 0.5 * (_FILLED_PRECISION * offset**2).sum(axis=1)
        return hessian, gradient, energy

    def _energy(self, state: State) -> np.ndarray:
        """E_B's energy (T,)."""
        energy, trusted = np.zeros(len(state)), np.flatnonzero(self._trusted)
        places = torch.from_numpy(trusted)
        pose = self._poses(state)
        cost = self._problem.cost(pose[places], pose.new_zeros(0), places)
        energy[self._fitter.frames[trusted]] = cost.double().numpy()
        filled, offset = self._filled(state)
        energy[filled] = 0.5 * (_FILLED_PRECISION * offset**2).sum(axis=1)
        return energy

    def _filled(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Frames (N,) without a fit, and the offset (N, 168) from their interpolated poses."""
        assert self._interpolated is not None, "refresh comes first"
        fitted = self._fitter.frames[self._trusted]
        filled = np.setdiff1d(np.arange(len(state)), fitted)
        return filled, state.body[filled] - self._interpolated[filled]

    def _poses(self, state: State) -> torch.Tensor:
        """Poses and translations (N, 168) of the problem's frames."""
        return torch.as_tensor(state.body[self._fitter.frames]).to(self._problem.base)

    def _linearise(
        self, state: State, places: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Matrix (N, 168, 168), gradient (N, 168) and energy (N,) in the frames ``places``."""
        pose = self._poses(state)
        shared = pose.new_zeros(0)  # no parameters are shared by all frames
        hessian = np.empty((len(places), BODY.stop, BODY.stop))
        gradient, energy = np.empty((len(places), BODY.stop)), np.empty(len(places))
        for start in range(0, len(places), 64):  # to bound the memory
            chunk = slice(start, start + 64)
            part = torch.from_numpy(places[chunk])
            normal = self._problem.linearise(pose[part], shared, part)
            hessian[chunk], gradient[chunk] = normal.hessian.numpy(), normal.gradient.numpy()
            energy[chunk] = normal.cost.double().numpy()
        return hessian, gradient, energy

    def take_cameras(self, cameras: Cameras) -> None:
        """Use these cameras from the next :meth:`refresh` on."""
        self._fitter.evidence.take_cameras(cameras.rig, cameras.depth_bias)

    def camera_evidence(self, state: State, share: float) -> CameraEvidence:
        """Gauss-Newton form of E_B by body and cameras, of the frames of the last :meth:`refresh`.

        Args:
            state: body of all frames.
            share: weight of a frame.
        """
        self._place(state)
        count = FREEDOMS * self.num_cameras
        places = np.flatnonzero(self._trusted)[:: self._every]
        hessian, gradient, _ = self._linearise(state, places)
        seen = CameraEvidence(
            BODY,
            self._fitter.frames[places],
            hessian,
            gradient,
            np.zeros((len(places), BODY.stop, count)),
            np.zeros((count, count)),
            np.zeros(count),
            self._every * share,
        )
        add_by_cameras(self._fitter.evidence, self._problem, places, seen)
        return seen

    def residuals(self) -> BodyResiduals:
        """Distances of the body to the images at the last :meth:`refresh`."""
        pixels, metres = self._fitter.residuals(self._problem)
        total = len(self._fitter.evidence.observations.times)
        keypoint = np.full((total, pixels.shape[1]), np.nan)
        cloud = np.full(total, np.nan)
        keypoint[self._fitter.frames] = pixels.numpy()
        cloud[self._fitter.frames] = metres.numpy()
        return BodyResiduals(keypoint, cloud)

    def person_by_view(self) -> np.ndarray:
        """Median distance (T, C) of the person's points beyond the clothing, metres, or NaN."""
        seen = self._fitter.evidence.observations
        person = np.full((len(seen.times), len(seen.rig)), np.nan)
        clouds = self._fitter.evidence.by_view
        if clouds is not None:
            distance = (clouds.distance - self._problem.thickness()).abs()
            distance = torch.where(clouds.points > 0, distance, torch.nan)
            person[self._fitter.frames] = distance.nanmedian(2).values.numpy()
        return person

    @property
    def num_cameras(self) -> int:
        """Number C of cameras."""
        return len(self._fitter.evidence.observations.rig)

    def _place(self, state: State) -> None:
        vector = state.parameters(self._fitter.model).vector()
        self._problem.base = vector[self._fitter.frames].to(self._problem.base)


def add_by_cameras(
    evidence: Evidence, problem: BodyProblem, places: np.ndarray, seen: CameraEvidence
) -> None:
    """Add the derivatives of E_J and E_D by the cameras to ``seen``, at the problem's bodies.

    ``places`` (N,) are the frames of the problem that ``seen`` refers to. Symbols as in
    :mod:`intercap_core.joint.cameras`.
    """
    for at in frame_chunks(len(places)):
        _add_keypoints(evidence, problem, places[at], seen, seen.cross[at])
        _add_clouds(evidence, problem, places[at], seen, seen.cross[at])


def _add_keypoints(
    evidence: Evidence,
    problem: BodyProblem,
    part: np.ndarray,
    seen: CameraEvidence,
    cross_of_part: np.ndarray,
) -> None:
    """Add H_dd, g_d and (to ``cross_of_part``) H_xd of E_J in the problem's frames ``part``."""
    views = problem.views
    if views is None:
        return
    model_points = keypoint_term.evaluate(
        problem.model,
        problem.model.parameters(problem.base[part]),
        problem.keypoints,
        problem.all_offsets(),
        derivatives=True,
        columns=torch.arange(BODY.stop),
    )
    assert model_points.derivatives is not None
    points = model_points.points[:, None]
    if views.shift is not None:
        points = points + views.shift[part]
    rotation = views.colour_from_master[:, :3, :3]
    in_camera = points @ rotation.transpose(1, 2) + views.colour_from_master[:, None, :3, 3]
    pixels, by_camera = projection.project_with_jacobian(in_camera, views.lenses[:, None])
    sigma = views.sigma[part][..., None]
    known = (views.confidence[part] > 0)[..., None]
    residual = torch.where(known, (pixels - views.observed[part]) / sigma, 0)
    weight = views.confidence[part] * geman_mcclure_weight((residual**2).sum(-1), OUTLIER_SIGMAS)
    by_point = by_camera @ rotation[:, None] / sigma[..., None]  # (b, C, K, 2, 3)
    by_point = torch.where(known[..., None], by_point, 0)
    centre = _poses(evidence).to(points)[:, :3, 3]
    arm = (points - centre[:, None])[..., None, :].expand(by_point.shape)
    nothing = by_point.new_zeros(*by_point.shape[:-1], 1)
    rows = -torch.cat([torch.linalg.cross(arm, by_point), by_point, nothing], -1)
    weighted = rows * weight[..., None, None]
    # b frames, c cameras, k keypoints, a pixel axes, f and g unknowns of a camera, n of the body,
    # x coordinates of a point
    hessian = torch.einsum("bckaf,bckag->cfg", weighted, rows)
    gradient = torch.einsum("bckaf,bcka->cf", weighted, residual)
    by_keypoint = torch.einsum("bckaf,bckax->bkxcf", weighted, by_point)
    cross = torch.einsum("bkxn,bkxcf->bncf", model_points.derivatives, by_keypoint)
    for camera, block in enumerate(_array(hessian)):
        own = slice(FREEDOMS * camera, FREEDOMS * (camera + 1))
        seen.hessian[own, own] += block
    seen.pull[:] += _array(gradient).ravel()
    cross_of_part += _array(cross).reshape(cross_of_part.shape)


def _add_clouds(
    evidence: Evidence,
    problem: BodyProblem,
    part: np.ndarray,
    seen: CameraEvidence,
    cross_of_part: np.ndarray,
) -> None:
    """As :func:`_add_keypoints`, of E_D."""
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
    # a sample's distance is the mean over the points of all cameras: each moves it by its share
    share = number / number.sum(1, keepdim=True).clamp_min(1e-6)
    flat = (by_camera * share[..., None]).transpose(1, 2).flatten(2)  # (b, S, D)
    weighted = flat * own.weight[..., None]
    seen.hessian[:] += _array(torch.einsum("bsd,bse->de", weighted, flat))
    seen.pull[:] += _array(torch.einsum("bsd,bs->d", weighted, residual))
    cross_of_part += _array(by_body.transpose(1, 2) @ weighted)


def _poses(evidence: Evidence) -> torch.Tensor:
    """Poses (C, 4, 4) of the cameras; zeros for a camera without a pose, which has no evidence."""
    return torch.as_tensor(np.nan_to_num(evidence.observations.rig.master_from_colour))


def _array(values: torch.Tensor) -> np.ndarray:
    return values.double().numpy()
