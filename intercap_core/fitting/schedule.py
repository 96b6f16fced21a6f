"""The order in which the body is fitted: trunk, 3D keypoints, E_J, E_J + E_D, hands and face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import BODY, CONTOUR, FACE, LEFT_HAND, NUM_KEYPOINTS, RIGHT_HAND
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.config import BodyFitSettings
from intercap_core.energy import body_cloud, body_keypoints
from intercap_core.energy.body_cloud import COVERINGS, CloudRows
from intercap_core.energy.body_keypoints import KeypointSet
from intercap_core.fitting.observations import Observations, PersonCloud
from intercap_core.fitting.problem import BodyProblem, Targets, Views
from intercap_core.fitting.start import place_trunk, turned_around
from intercap_core.solve.levenberg_marquardt import Solution, minimise

# What is left of a keypoint's error in metres once its fixed part is taken out: the start, refined
# from the residuals themselves.
_KEYPOINT_SIGMA = (
    (BODY, 0.02),
    (LEFT_HAND, 0.01),
    (RIGHT_HAND, 0.01),
    (slice(FACE.start, CONTOUR.stop), 0.008),
)
_START_SIGMA = 0.04
_SMALLEST_SIGMA_PX = 1.0
_PERSISTENCE = 1.5  # errors that last over frames, which the residuals of a fit do not show
_NOISE_RANGE = (0.1, 1.5)
_SIGMA_RANGE = (0.1, 2.0)  # how far the refined sigma may go from the start
# Neighbouring samples stand on the same fold: about four of them make one measurement.
_SAMPLE_SHARE = 0.25
_FULL_SAMPLE = 2.0  # points with which a sample counts half
_HUBER_M = 0.012
_REACH_M = (0.10, 0.06, 0.05)
_TURN_WORSE = 1.5  # frames whose cost exceeds the median by this are tried facing the other way
_VERTEX_CHUNK = 16


@dataclass(frozen=True)
class Settled:
    """What a fit found to be the same in all frames, beside the shape.

    offsets (25,3) m of the body keypoints in the frames of their bones; covering (G,) logarithm of
    each covering's thickness over the usual one; keypoint_sigma (K,) m; cloud_noise (G,) m.
    """

    offsets: Tensor
    covering: Tensor
    keypoint_sigma: Tensor
    cloud_noise: Tensor


@dataclass(frozen=True)
class Fit:
    """The fitted frames (N,), ids among the sequence's T.

    vectors (N,P) parameters; hessian (N,n,n) of the energy by the parameters ``columns`` (n,);
    excess (N,) >= 1: mean square of the keypoints' residuals over their variance.
    keypoint_error (N,): median distance of the body's keypoints, metres. pixel_residual (N,C) px,
    cloud_residual (N,) m: medians, NaN = nothing seen. settled: what all frames share beside the
    shape.
    """

    frames: np.ndarray
    vectors: Tensor
    columns: Tensor
    hessian: Tensor
    excess: Tensor
    keypoint_error: Tensor
    pixel_residual: Tensor
    cloud_residual: Tensor
    settled: Settled


def columns_of(model: BodyModel, *, hands: bool, face: bool, betas: bool) -> Tensor:
    """Own parameter columns: trunk and limbs, then hands, jaw and expression where asked for."""
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
    """Fits all usable frames of one sequence; create, then :meth:`run`."""

    def __init__(
        self,
        model: BodyModel,
        seen: Observations,
        clouds: list[PersonCloud | None],
        settings: BodyFitSettings,
    ) -> None:
        self.model, self.seen, self.settings = model, seen, settings
        self.frames = np.flatnonzero(seen.usable)
        self.clouds = [clouds[t] for t in self.frames]
        self.samples = body_cloud.choose_samples(model)
        self.patch = torch.as_tensor(self.samples.patch, device=model.device)
        self.sample_ids = torch.as_tensor(self.samples.vertex, device=model.device)
        self.cloud_noise = self._tensor(np.array([c.noise for c in COVERINGS]))
        self.cloud_residual = torch.full((len(self.frames),), torch.nan)
        self.one_shape = settings.shape == "shared"
        sigma = torch.zeros(NUM_KEYPOINTS)
        for part, value in _KEYPOINT_SIGMA:
            sigma[part] = value
        self.keypoint_sigma = sigma.to(model.device, model.dtype)

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=self.model.dtype, device=self.model.device)

    def run(self) -> Fit:
        """All rounds; see the module's text."""
        base = self._start()
        problem = BodyProblem(
            self.model, self._keypoints(), self.samples, base,
            columns_of(self.model, hands=False, face=False, betas=not self.one_shape),
            self.one_shape,
            offsets=base.new_zeros(25, 3), u=base.new_zeros(len(COVERINGS)),
        )  # fmt: skip
        for _ in range(2):
            self._body_views(problem, hands=False, face=False)
            self._minimise(problem, 6)
            self._refine_sigma(problem)
        has_cloud = any(cloud is not None for cloud in self.clouds)
        problem.fit_shared = True
        for reach in _REACH_M[:2] if has_cloud else ():
            problem.rows = self._match(problem, reach)
            self._body_views(problem, hands=False, face=False)
            self._minimise(problem, 5)
            self._refine_sigma(problem)
            self._refine_cloud_noise(problem)
        # Faces and hands of a shape outside the model's space would bend the whole body to fit:
        # what is shared is settled by now, and stays.
        problem.fit_shared, problem.one_shape = False, False
        hands, face = self.settings.hands, self.settings.face
        if hands or face:
            self._extremities(problem, hands=hands, face=face)
        problem.columns = columns_of(self.model, hands=hands, face=face, betas=not self.one_shape)
        for last in (False, True):
            if has_cloud:
                problem.rows = self._match(problem, _REACH_M[-1])
            self._refine_sigma(problem)
            self._body_views(problem, hands=hands, face=face)
            solution = self._minimise(problem, 5, keep_normal=last)
        assert solution.normal is not None
        return self._report(problem, solution.normal.hessian)

    def resume(self, base: Tensor, settled: Settled) -> BodyProblem:
        """The last round's problem at other bodies (N,P), with what a fit found to be constant."""
        self.keypoint_sigma = settled.keypoint_sigma.to(base)
        self.cloud_noise = settled.cloud_noise.to(base)
        return BodyProblem(
            self.model, self._keypoints(), self.samples, base,
            columns_of(
                self.model, hands=self.settings.hands, face=self.settings.face, betas=False
            ),
            False,
            offsets=settled.offsets.to(base), u=settled.covering.to(base),
        )  # fmt: skip

    def observe(self, problem: BodyProblem) -> None:
        """Take correspondences, visibility and pixel sigmas anew at the problem's bodies."""
        if any(cloud is not None for cloud in self.clouds):
            problem.rows = self._match(problem, _REACH_M[-1])
        self._body_views(problem, hands=self.settings.hands, face=self.settings.face)

    def residuals(self, problem: BodyProblem) -> tuple[Tensor, Tensor]:
        """Median pixel error (N,C) and cloud distance (N,), metres; NaN = nothing seen."""
        views = problem.views
        assert views is not None
        pixels = body_keypoints.pixel_residuals(
            self.points(problem), views.observed, views.lenses, views.colour_from_master,
            shift=views.shift,
        )[:, :, BODY].norm(dim=-1)  # fmt: skip
        known = views.confidence[:, :, BODY] > 0
        return torch.where(known, pixels, torch.nan).nanmedian(2).values, self.cloud_residual

    def _report(self, problem: BodyProblem, hessian: Tensor) -> Fit:
        """Residuals of the solution."""
        views = problem.views
        assert views is not None
        pixels = body_keypoints.pixel_residuals(
            self.points(problem), views.observed, views.lenses, views.colour_from_master,
            shift=views.shift,
        )[:, :, BODY].norm(dim=-1)  # fmt: skip
        sigma, known = views.sigma[:, :, BODY], views.confidence[:, :, BODY] > 0
        pixels = torch.where(known, pixels, torch.nan)
        squared = (pixels / sigma) ** 2 / 2
        metres = pixels / sigma * self.keypoint_sigma[BODY]
        return Fit(
            frames=self.frames,
            vectors=problem.base,
            columns=problem.columns,
            hessian=hessian,
            # the median of a chi-squared variable with two degrees of freedom is 2 ln 2
            excess=(squared.flatten(1).nanmedian(1).values / np.log(2)).clamp_min(1.0),
            keypoint_error=metres.flatten(1).nanmedian(1).values,
            pixel_residual=pixels.nanmedian(2).values,
            cloud_residual=self.cloud_residual,
            settled=Settled(problem.offsets, problem.u, self.keypoint_sigma, self.cloud_noise),
        )

    def _minimise(self, problem: BodyProblem, trials: int, keep_normal: bool = False) -> Solution:
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
        return solution

    # --- rounds ------------------------------------------------------------------------------

    def _start(self) -> Tensor:
        """Parameters (N,P) fitted to the triangulated body keypoints, mean shape and hands."""
        rest = self.model.zeros()
        keypoints = self.model.keypoints_of(rest)[0].double().cpu().numpy()
        pelvis = (
            self.model.forward(rest, vertex_ids=np.array([0])).joints[0, 0].double().cpu().numpy()
        )
        joints = self.seen.joints[self.frames]
        placed = place_trunk(keypoints, joints, pelvis)
        straight = self._fit_triangulated(placed, joints)
        poor = np.flatnonzero((straight.cost > _TURN_WORSE * straight.cost.median()).cpu().numpy())
        if len(poor):
            turned = self._fit_triangulated(turned_around(placed[poor]), joints[poor])
            better = turned.cost < straight.cost[poor]
            straight.own[poor[better.cpu().numpy()]] = turned.own[better]
        base = straight.own
        if self.one_shape:
            shape = slice(TRANSL.stop, TRANSL.stop + self.model.num_betas)
            base[:, shape] = base[:, shape].median(0).values
        return base

    def _fit_triangulated(self, placed: np.ndarray, joints: np.ndarray) -> Solution:
        base = self.model.zeros(len(placed)).vector().clone()
        base[:, 75:120], base[:, 120:165] = self.model.hand_mean[0], self.model.hand_mean[1]
        base[:, 0:3], base[:, TRANSL] = self._tensor(placed[:, :3]), self._tensor(placed[:, 3:])
        for name, sign in (("left_shoulder", -1.0), ("right_shoulder", 1.0)):
            base[:, 3 * JOINT_INDEX[name] + 2] = sign * 0.8  # arms hang rather than stretch
        joints = joints[:, BODY]
        known = np.isfinite(joints).all(2)
        problem = BodyProblem(
            self.model, self._keypoints(), self.samples, base,
            columns_of(self.model, hands=False, face=False, betas=True), False,
            offsets=base.new_zeros(25, 3), u=base.new_zeros(len(COVERINGS)),
            targets=Targets(
                self._tensor(np.nan_to_num(joints)), self._tensor(known), _START_SIGMA
            ),
        )  # fmt: skip
        solution = minimise(problem, problem.own_start(), max_trials=15, cost_tolerance=1e-2)
        problem.accept(solution.own, solution.shared)
        solution.own = problem.base
        return solution

    def _extremities(self, problem: BodyProblem, *, hands: bool, face: bool) -> None:
        """Fingers, jaw and expression alone, on a body that stays; the cloud waits."""
        columns = columns_of(self.model, hands=hands, face=face, betas=False)
        fixed = columns_of(self.model, hands=False, face=False, betas=False)
        kept = (problem.columns, problem.rows, problem.one_shape, problem.fit_shared)
        problem.columns = columns[~torch.isin(columns, fixed)]
        problem.rows, problem.one_shape, problem.fit_shared = None, False, False
        self._body_views(problem, hands=hands, face=face)
        self._minimise(problem, 8)
        problem.columns, problem.rows, problem.one_shape, problem.fit_shared = kept

    def _body_views(self, problem: BodyProblem, *, hands: bool, face: bool) -> None:
        """Set E_J up at the current solution: which keypoints, their sigma in pixels, shifts."""
        seen, frames = self.seen, self.frames
        problem.keypoints = self._keypoints(hands=hands, face=face)
        chosen = problem.keypoints.index
        at = np.ix_(frames, np.arange(len(seen.rig)), chosen.cpu().numpy())
        points = self.points(problem)
        pose = self._tensor(seen.rig.colour_from_master)
        lenses = self._tensor(seen.rig.colour_parameters)
        z = points[:, None] @ pose[:, 2, :3, None]
        z = z[..., 0] + pose[:, 2, 3][:, None]
        sigma = self.keypoint_sigma[chosen] * lenses[:, None, 0] / z.clamp_min(0.3)
        problem.views = Views(
            self._tensor(seen.keypoints[at]),
            self._tensor(seen.confidence[at]),
            sigma.clamp_min(_SMALLEST_SIGMA_PX),
            lenses,
            pose,
            self._shift(points),
        )

    def _keypoints(self, *, hands: bool = False, face: bool = False) -> KeypointSet:
        """Those of the body, and of hands and face where asked for.

        The jaw line is left out: its landmarks slide over the cheek with the view.
        """
        index = list(range(BODY.start, BODY.stop))
        if hands:
            index += range(LEFT_HAND.start, RIGHT_HAND.stop)
        if face:
            index += range(FACE.start, FACE.stop)
        return body_keypoints.keypoint_set(self.model, index)

    def points(self, problem: BodyProblem) -> Tensor:
        """Current positions (N,K,3) of the problem's keypoints, with offsets."""
        offsets = torch.zeros(len(problem.keypoints.index), 3).to(problem.base)
        offsets[: BODY.stop] = problem.offsets
        return body_keypoints.evaluate(
            self.model,
            self.model.parameters(problem.base),
            problem.keypoints,
            offsets,
            derivatives=False,
        ).points

    def _shift(self, points: Tensor) -> Tensor | None:
        """How far points (N,...,3) move until each camera exposes: (N,C,...,3), or None."""
        delay = self.seen.delay[self.frames]
        if not np.any(delay) or len(self.frames) < 2:
            return None
        velocity = np.gradient(points.double().cpu().numpy(), self.seen.times[self.frames], axis=0)
        return self._tensor(delay)[:, :, None, None] * self._tensor(velocity)[:, None]

    def _refine_sigma(self, problem: BodyProblem) -> None:
        """Noise of each group of keypoints from its residuals: 1.48 median absolute deviation."""
        views = problem.views
        assert views is not None
        residual = body_keypoints.pixel_residuals(
            self.points(problem), views.observed, views.lenses, views.colour_from_master,
            shift=views.shift,
        )  # fmt: skip
        scaled = residual.abs() / views.sigma[..., None]
        scaled = scaled * self.keypoint_sigma[problem.keypoints.index, None]
        for part, start in _KEYPOINT_SIGMA:
            index = problem.keypoints.index
            here = (index >= part.start) & (index < part.stop)
            known = views.confidence[:, :, here] > 0
            if bool(known.any()):
                found = 1.4826 * _PERSISTENCE * float(scaled[:, :, here][known].median())
                low, high = (start * factor for factor in _SIGMA_RANGE)
                self.keypoint_sigma[part] = min(max(found, low), high)

    def _refine_cloud_noise(self, problem: BodyProblem) -> None:
        """The same for each covering's samples, from what is left of their distances."""
        rows = problem.rows
        assert rows is not None
        points = self.model.forward(
            self.model.parameters(problem.base), vertex_ids=self.sample_ids
        ).vertices
        group = torch.as_tensor(self.samples.group, device=points.device)
        away = body_cloud.residuals(points, rows, problem.thickness_of_group(), group).abs()
        for g, covering in enumerate(COVERINGS):
            part = group == g
            known = rows.weight[:, part] > 0
            if bool(known.any()):
                found = 1.4826 * float(away[:, part][known].median())
                low, high = (covering.noise * factor for factor in _NOISE_RANGE)
                self.cloud_noise[g] = min(max(found, low), high)

    # --- the cloud ---------------------------------------------------------------------------

    def _match(self, problem: BodyProblem, reach: float) -> CloudRows:
        """Correspondences of all frames at the current solution."""
        count, size = len(self.frames), len(self.samples.vertex)
        expected = problem.thickness()
        params = self.model.parameters(problem.base)
        faces = self.model.faces
        where = self.model.forward(params, vertex_ids=self.sample_ids).vertices
        shift = self._shift(where)
        mean = where.new_zeros(count, size)
        total = where.new_zeros(count, size)
        normal = where.new_zeros(count, size, 3)
        for start in range(0, count, _VERTEX_CHUNK):
            at = slice(start, start + _VERTEX_CHUNK)
            vertices = self.model.forward(params.frames(at)).vertices
            normals = vertex_normals(vertices, faces)
            normal[at] = normals[:, self.sample_ids]
            for row in range(len(vertices)):
                t = start + row
                cloud = self.clouds[t]
                if cloud is None:
                    continue
                found = body_cloud.match(
                    cloud.points, cloud.normals, vertices[row], normals[row],
                    self.sample_ids, self.patch, reach,
                )  # fmt: skip
                if shift is not None:
                    late = shift[t, cloud.view, found.sample]
                    moved = (late * normal[t, found.sample]).sum(1)
                    found = found._replace(distance=found.distance - moved)
                self.cloud_residual[t] = found.distance[found.valid].abs().nanmedian()
                mean[t], total[t] = body_cloud.gather(
                    found, cloud.trust, expected, size, huber=_HUBER_M
                )
        noise = self.cloud_noise[torch.as_tensor(self.samples.group, device=mean.device)]
        share = self.settings.cloud_weight * _SAMPLE_SHARE
        weight = share * total / (total + _FULL_SAMPLE) / noise**2
        target = mean + (normal * where).sum(2)
        return CloudRows(target, normal, weight, mean)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Area-weighted unit normals (B,V,3) of (B,V,3), (F,3)."""
    a, b, c = (vertices[:, faces[:, i]] for i in range(3))
    cross = torch.linalg.cross(b - a, c - a)
    normals = torch.zeros_like(vertices)
    for i in range(3):
        normals.index_add_(1, faces[:, i], cross)
    return torch.nn.functional.normalize(normals, dim=2)
