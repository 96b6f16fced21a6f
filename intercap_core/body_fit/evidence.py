"""Observations for bodies at their current pose: E_J's pixels and E_D's correspondences.

Set up anew between rounds of the solver, together with how far each kind of observation is trusted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.keypoints import BODY, FACE, LEFT_HAND, NUM_KEYPOINTS, RIGHT_HAND
from intercap_core.body.model import BodyModel
from intercap_core.body_fit import body_cloud, body_keypoints, body_samples, body_self
from intercap_core.body_fit.body_cloud import CloudRows
from intercap_core.body_fit.body_keypoints import KeypointSet
from intercap_core.body_fit.body_samples import COVERINGS
from intercap_core.body_fit.body_self import SelfContact
from intercap_core.body_fit.body_surface import Surface
from intercap_core.body_fit.constants import (
    CONFIDENCE_BINS,
    FEWEST_IN_BIN,
    FRAMES_KEPT,
    FRAMES_POSED,
    HALF_WEIGHT_POINTS,
    KEYPOINT_SIGMA_M,
    LARGEST_CONFIDENCE_EXPONENT,
    LEAST_CONFIDENCE,
    MAX_SPEED,
    NOISE_RANGE,
    PERSISTENCE,
    SAMPLE_SHARE,
    SIGMA_RANGE,
    SMALLEST_SIGMA_PX,
)
from intercap_core.body_fit.matching import Matcher, Skin
from intercap_core.body_fit.observations import Observations, PersonCloud
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.body_fit.terms import Views
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.solve.robust import SIGMA_PER_MAD
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.geometry.solve.time_series import limited_velocity


def measured_doubt(confidence: Tensor, error: Tensor) -> float:
    """The power a >= 0 with which errors (M,) grow as confidence (M,) falls: confidence^-a."""
    bins = torch.tensor_split(confidence.argsort(), CONFIDENCE_BINS)
    if len(bins[0]) < FEWEST_IN_BIN:
        return 0.0
    x = torch.stack([confidence[at].median() for at in bins]).clamp_min(LEAST_CONFIDENCE).log()
    y = torch.stack([error[at].median() for at in bins]).clamp_min(1e-6).log()
    x, y = x - x.mean(), y - y.mean()
    slope = -float((x * y).sum() / (x * x).sum().clamp_min(1e-6))
    return min(max(slope, 0.0), LARGEST_CONFIDENCE_EXPONENT)


class ViewDistances(NamedTuple):
    """Each camera's points by sample of the skin: their mean distance (N,C,S), metres, and
    effective number (N,C,S), 0 = none; where the samples were (N,S,3), and their normals."""

    distance: Tensor
    points: Tensor
    where: Tensor
    normal: Tensor


class Evidence:
    """Observations of the N usable frames.

    frames (N,) their ids. keypoint_sigma (135,) m and cloud_noise (G,) m start from what is usual
    and are refined from residuals; the first is of keypoints of usual confidence, others have
    (confidence / usual)^-keypoint_doubt of it. cloud_residual (N,): median distance of points at
    the last matching, metres, NaN = none; measured (N,S): which samples had some. by_view: what
    each camera's points and masks said then, or None.
    """

    def __init__(
        self,
        model: BodyModel,
        seen: Observations,
        clouds: list[PersonCloud | None],
        cloud_weight: float,
    ) -> None:
        self.model, self.seen, self.cloud_weight = model, seen, cloud_weight
        self.frames = np.flatnonzero(seen.usable)
        self.clouds = [clouds[t] for t in self.frames]
        self.has_cloud = any(cloud is not None for cloud in self.clouds)
        self.samples = body_samples.choose_samples(model)
        self.surface = Surface.around_samples(model, self.samples)
        sample, patch = (
            torch.as_tensor(places, device=model.device)
            for places in (self.surface.sample, self.surface.patch)
        )
        contact = SelfContact.of(model, self.samples)
        self.self_contact = replace(contact, vertex=sample, patch=patch)  # places in the surface
        self._matcher = Matcher.of(self.samples, self.surface, model.device)
        self.sample_ids = torch.as_tensor(self.samples.vertex, device=model.device)
        self.group = torch.as_tensor(self.samples.group, device=model.device)
        carrier = model.skinning_weights.argmax(1).cpu().numpy()
        self.sample_joints = carrier[self.samples.vertex]
        self._posed: tuple[Tensor, list[tuple[int, Tensor, Tensor]]] | None = None
        # frame by frame in compiled code, which threads can share
        self._threads = ThreadPool(torch.get_num_threads() if model.device.type == "cpu" else 1)
        self.cloud_noise = self._tensor(np.array([c.noise for c in COVERINGS]))
        self.cloud_residual = torch.full((len(self.frames),), torch.nan, device=model.device)
        self.measured = torch.zeros(
            len(self.frames), len(self.samples.vertex), dtype=torch.bool, device=model.device
        )
        self.by_view: ViewDistances | None = None
        self.keypoint_sigma = self._tensor(np.zeros(NUM_KEYPOINTS))
        self.keypoint_doubt = torch.zeros_like(self.keypoint_sigma)
        self.usual_confidence = torch.ones_like(self.keypoint_sigma)
        for part, value in KEYPOINT_SIGMA_M:
            self.keypoint_sigma[part] = value
            seen_at = seen.confidence[self.frames, :, part]
            usual = np.median(seen_at[seen_at > 0]) if (seen_at > 0).any() else 1.0
            self.usual_confidence[part] = float(usual)

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=self.model.dtype, device=self.model.device)

    def take_cameras(self, rig: Rig, depth_bias: np.ndarray) -> None:
        """See through other poses of the cameras and depth biases (C,), metres, from now on."""
        seen = self.seen
        self.clouds = [
            None if cloud is None else cloud.through(rig, depth_bias, seen.rig, seen.depth_bias)
            for cloud in self.clouds
        ]
        self.seen = replace(seen, rig=rig, depth_bias=depth_bias)

    def observe_keypoints(
        self,
        problem: BodyProblem,
        *,
        hands: bool = False,
        face: bool = False,
        widened: float = 1.0,
    ) -> None:
        """Set E_J up at the problem's bodies: which keypoints, their sigma in pixels, shifts.

        ``widened`` multiplies sigma, and with it the error from which a keypoint is an outlier.
        """
        seen, frames = self.seen, self.frames
        problem.keypoints = self.keypoints(hands=hands, face=face)
        chosen = problem.keypoints.index
        at = np.ix_(frames, np.arange(len(seen.rig)), chosen.cpu().numpy())
        points = self.points(problem)
        pose = self._tensor(seen.rig.colour_from_master)
        lenses = self._tensor(seen.rig.colour_parameters)
        z = points[:, None] @ pose[:, 2, :3, None]
        z = z[..., 0] + pose[:, 2, 3][:, None]
        confidence = self._tensor(seen.confidence[at])
        sigma = widened * self.keypoint_sigma[chosen] * lenses[:, None, 0] / z.clamp_min(0.3)
        sigma = sigma * self._doubted(confidence, chosen)
        problem.views = Views(
            self._tensor(seen.keypoints[at]),
            confidence,
            sigma.clamp_min(SMALLEST_SIGMA_PX),
            lenses,
            pose,
            self._shift(points),
        )

    def keypoints(self, *, hands: bool = False, face: bool = False) -> KeypointSet:
        """Those of the body, and of hands and face where requested.

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

    def pixel_residuals(self, problem: BodyProblem) -> Tensor:
        """Projections minus observations (N,C,K,2), px, of the problem's keypoints."""
        views = problem.views
        if views is None:
            raise ValueError("the problem has no views to compare with")
        return body_keypoints.pixel_residuals(
            self.points(problem),
            views.observed,
            views.lenses,
            views.colour_from_master,
            shift=views.shift,
        )

    def _shift(self, points: Tensor) -> Tensor | None:
        """Shift (N,C,...,3) of points (N,...,3) from the frame's time to each camera's exposure, or
        None."""
        offset = self.seen.time_offset
        if not np.any(offset):
            return None
        return self._tensor(offset)[:, None, None] * self.velocity(points)[:, None]

    def velocity(self, points: Tensor) -> Tensor:
        """(N,...,3) m/s of the usable frames' points (N,...,3)."""
        found = limited_velocity(
            points.double().cpu().numpy(), self.seen.times[self.frames], max_speed=MAX_SPEED
        )
        return self._tensor(found)

    def _doubted(self, confidence: Tensor, index: Tensor) -> Tensor:
        """Factor (N,C,K) of the sigma of keypoints ``index`` (K,) by their confidence (N,C,K)."""
        share = confidence.clamp_min(LEAST_CONFIDENCE) / self.usual_confidence[index]
        return share ** -self.keypoint_doubt[index]

    def refine_sigma(self, problem: BodyProblem) -> None:
        """Noise of each group of keypoints from its residuals: 1.48 median absolute deviation."""
        views = problem.views
        assert views is not None
        index = problem.keypoints.index
        scaled = self.pixel_residuals(problem).abs() / views.sigma[..., None]
        scaled = scaled * self.keypoint_sigma[index, None]
        scaled = scaled * self._doubted(views.confidence, index)[..., None]
        for part, start in KEYPOINT_SIGMA_M:
            here = (index >= part.start) & (index < part.stop)
            known = views.confidence[:, :, here] > 0
            if bool(known.any()):
                sure, off = views.confidence[:, :, here][known], scaled[:, :, here][known]
                self.keypoint_doubt[part] = measured_doubt(sure, off.mean(1))
                usual = off / self._doubted(views.confidence, index)[:, :, here][known][:, None]
                found = SIGMA_PER_MAD * PERSISTENCE * float(usual.median())
                low, high = (start * factor for factor in SIGMA_RANGE)
                self.keypoint_sigma[part] = min(max(found, low), high)

    def refine_cloud_noise(self, problem: BodyProblem) -> None:
        """The same for each covering's samples, from what is left of their distances."""
        rows = problem.rows
        assert rows is not None
        points = self.model.forward(
            self.model.parameters(problem.base), vertex_ids=self.sample_ids
        ).vertices
        residual = body_cloud.residuals(
            points, rows, problem.thickness_of_group(), self.group
        ).abs()
        for g, covering in enumerate(COVERINGS):
            part = self.group == g
            known = rows.weight[:, part] > 0
            if bool(known.any()):
                found = SIGMA_PER_MAD * float(residual[:, part][known].median())
                low, high = (covering.noise * factor for factor in NOISE_RANGE)
                self.cloud_noise[g] = min(max(found, low), high)

    def _bodies(self, base: Tensor) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Some frames of the bodies ``base`` (N,P) at a time: the first one's place, vertices and
        normals (b,R,3) of the surface. Those of short sequences are kept for the next call."""
        if self._posed is not None and torch.equal(self._posed[0], base):
            yield from self._posed[1]
            return
        self._posed, parts = None, []
        params = self.model.parameters(base)
        for start in range(0, len(base), FRAMES_POSED):
            part = (start, *self.surface.posed(params.frames(slice(start, start + FRAMES_POSED))))
            if len(base) <= FRAMES_KEPT:
                parts.append(part)
            yield part
        if parts:
            self._posed = (base.clone(), parts)

    def touch(self, problem: BodyProblem) -> body_self.Pairs | None:
        """Where parts of the problem's bodies are inside each other, or nearly; None = nowhere, or
        switched off."""
        if not problem.self_weight:
            return None
        ids = torch.as_tensor(self.surface.ids, device=self.model.device)
        found = []
        for _, vertices, normals in self._bodies(problem.base):
            found += self._threads.map(
                lambda one: body_self.find(self.self_contact, *one),
                list(zip(vertices, normals, strict=True)),
            )
        return body_self.join([(ids[inner], ids[outer], normal) for inner, outer, normal in found])

    def match(
        self, problem: BodyProblem, reach: float, only: np.ndarray | None = None
    ) -> CloudRows:
        """Correspondences of all frames at the problem's bodies, within ``reach`` metres: of all
        cameras, or of the one of each frame that ``only`` (N,) names."""
        count, size, views = len(self.frames), len(self.samples.vertex), len(self.seen.rig)
        params = self.model.parameters(problem.base)
        where = self.model.forward(params, vertex_ids=self.sample_ids).vertices
        shift = self._shift(where)
        of_views = where.new_zeros(count, views, size)
        points = where.new_zeros(count, views, size)
        expected = problem.thickness().repeat(views)
        normal = where.new_zeros(count, size, 3)
        for start, vertices, normals in self._bodies(problem.base):
            normal[start : start + len(normals)] = normals[:, self.self_contact.vertex]
            seen = [
                (start + row, *posed)
                for row, posed in enumerate(zip(vertices, normals, strict=True))
                if self.clouds[start + row] is not None
            ]

            def matched(one: tuple[int, Tensor, Tensor]) -> None:
                t, vertices, normals = one
                cloud = self.clouds[t]
                assert cloud is not None
                if only is not None:
                    cloud = cloud.of_view(int(only[t]))
                late = None if shift is None else shift[t]
                skin = Skin(vertices, normals, where[t], late)
                found = self._matcher.match(
                    cloud, self.seen.rig, self.seen.depth_bias, skin, expected, reach
                )
                of_views[t], points[t] = found.distance, found.points
                self.measured[t], self.cloud_residual[t] = found.measured, found.residual

            self._threads.map(matched, seen)
        self.by_view = ViewDistances(of_views, points, where, normal)
        return self.rows(points)

    def rows(self, points: Tensor) -> CloudRows:
        """What :meth:`match` found, with these numbers of points (N,C,S), 0 = do not count."""
        found = self.by_view
        assert found is not None, "match comes first"
        total = points.sum(1)
        mean = (found.distance * points).sum(1) / total.clamp_min(1e-6)
        noise = self.cloud_noise[self.group]
        share = self.cloud_weight * SAMPLE_SHARE
        weight = share * total / (total + HALF_WEIGHT_POINTS) / noise**2
        target = mean + (found.normal * found.where).sum(2)
        return CloudRows(target, found.normal, weight, mean)
