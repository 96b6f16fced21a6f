"""Observations of all frames as inputs of the energy terms, at the current bodies.

These are the detected keypoints (E_J), the correspondences of the clouds (E_D) and the contacts of
body parts (E_P_self). They are updated between the solver's runs, together with the standard
deviation of each kind of observation, which is estimated from residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.keypoints import BODY, CONTOUR, FACE, LEFT_HAND, NUM_KEYPOINTS, RIGHT_HAND
from intercap_core.body.model import BodyModel
from intercap_core.body_fit import cloud_term, keypoint_term
from intercap_core.body_fit.clouds import PersonCloud
from intercap_core.body_fit.matching import Matcher, PosedSkin
from intercap_core.body_fit.observations import Observations
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.body_fit.self_contact import (
    Contacts,
    SelfContact,
    find_contacts,
    join_frames,
    no_contacts,
)
from intercap_core.body_fit.surface import COVERINGS, SkinSurface, choose_samples
from intercap_core.body_fit.term_inputs import CloudRows, KeypointSet, Views, keypoint_set
from intercap_core.body_fit.view_distances import ViewDistances
from intercap_core.disk import DiskList
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.solve.levenberg_marquardt import BLOCK_FRAMES
from intercap_core.geometry.solve.robust import SIGMA_PER_MAD
from intercap_core.geometry.solve.thread_pool import ThreadPool, threads_of_job
from intercap_core.geometry.solve.time_series import limited_velocity
from intercap_core.memory import return_freed_memory

# Initial standard deviation of a keypoint whose constant offset is known, metres. It is refined
# from the residuals. Tuned on the studio.
KEYPOINT_SIGMA_M = (
    (BODY, 0.02),
    (LEFT_HAND, 0.01),
    (RIGHT_HAND, 0.01),
    (slice(FACE.start, CONTOUR.stop), 0.008),
)
# Factor of sigma for errors that persist over frames: the fit absorbs them, so residuals do not
# show them. Tuned on the studio.
PERSISTENCE = 1.5


class Evidence:
    """Observations of the N usable frames, and their standard deviations.

    :mod:`.surface` defines the S samples of the skin and the G coverings.

    Attributes:
        frames: (N,) indices of the usable frames among the observed ones.
        keypoint_sigma: (135,) standard deviation of a keypoint of median confidence, metres.
        keypoint_doubt: (135,) exponent a: sigma is proportional to confidence^-a.
        cloud_noise: (G,) standard deviation of a sample's mean distance, by covering, metres.
        cloud_residual: (N,) median distance of points at the last matching, metres, NaN = none.
        measured: (N, S) bool, samples with depth points at the last matching.
        by_view: measurements of each camera at the last matching; None before the first, and if
            they were not kept.
    """

    def __init__(
        self,
        model: BodyModel,
        observations: Observations,
        clouds: Sequence[PersonCloud | None],
        cloud_weight: float,
        window: slice | np.ndarray | None = None,
    ) -> None:
        """Take the observations of a sequence, of the frames ``window`` only if one is given.

        ``clouds`` are those of the window. Which frames are usable, and the median confidence of
        keypoints, follow from the whole sequence.
        """
        self.model, self.cloud_weight = model, cloud_weight
        usable, median_confidence = observations.usable, observations.median_confidence
        if window is not None:
            observations, usable = observations.window(window), usable[window]
        self.observations = observations
        self.frames = np.flatnonzero(usable)
        self.clouds: Sequence[PersonCloud | None] = (
            clouds.select(self.frames.tolist())
            if isinstance(clouds, DiskList)
            else [clouds[t] for t in self.frames.tolist()]
        )
        self.has_cloud = any(cloud is not None for cloud in self.clouds)
        self.samples = choose_samples(model)
        self.surface = SkinSurface.around_samples(model, self.samples)
        self._self_contact = SelfContact.of(model, self.samples)._replace(
            vertex=self.surface.sample, patch=self.surface.patch
        )
        self._matcher = Matcher.of(self.samples, self.surface)
        self.sample_ids = torch.as_tensor(self.samples.vertex)
        self.group = torch.as_tensor(self.samples.group)
        carrier = model.skinning_weights.argmax(1).numpy()
        self.sample_joints = carrier[self.samples.vertex]
        # compiled code runs frame by frame, which threads can share
        self._threads = ThreadPool(threads_of_job())
        self.cloud_noise = self._tensor(np.array([c.noise for c in COVERINGS]))
        self.cloud_residual = torch.full((len(self.frames),), torch.nan)
        self.measured = torch.zeros(len(self.frames), len(self.samples.vertex), dtype=torch.bool)
        self.by_view: ViewDistances | None = None
        self.keypoint_sigma = self._tensor(np.zeros(NUM_KEYPOINTS))
        self.keypoint_doubt = torch.zeros_like(self.keypoint_sigma)
        self.median_confidence = self._tensor(median_confidence)
        for part, value in KEYPOINT_SIGMA_M:
            self.keypoint_sigma[part] = value

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=self.model.dtype)

    def take_cameras(self, rig: Rig, depth_bias: np.ndarray) -> None:
        """Replace camera poses and depth biases (C,), metres, and move the clouds accordingly."""
        observations = self.observations
        self.clouds = [
            None
            if cloud is None
            else cloud.through(rig, depth_bias, observations.rig, observations.depth_bias)
            for cloud in self.clouds
        ]
        self.observations = replace(observations, rig=rig, depth_bias=depth_bias)

    def observe_keypoints(
        self, problem: BodyProblem, *, hands: bool = False, face: bool = False, widened: float = 1.0
    ) -> None:
        """Set the problem's keypoints and views (:class:`.term_inputs.Views`) at its bodies.

        Sigma in metres becomes pixels by focal length and depth of the current bodies.

        Args:
            problem: the problem, changed in place.
            hands: include the keypoints of the hands.
            face: include the keypoints of the face.
            widened: factor of sigma, and so of the error from which a keypoint is an outlier.
        """
        observations, frames = self.observations, self.frames
        problem.keypoints = self.keypoints(hands=hands, face=face)
        problem.views = None  # those of the last update are not used
        chosen = problem.keypoints.index
        at = np.ix_(frames, np.arange(len(observations.rig)), chosen.numpy())
        points = self.points(problem)
        pose = self._tensor(observations.rig.colour_from_master)
        lenses = self._tensor(observations.rig.colour_parameters)
        z = points[:, None] @ pose[:, 2, :3, None]
        z = z[..., 0] + pose[:, 2, 3][:, None]
        confidence = self._tensor(observations.confidence[at])
        # lenses[:, 0]: focal length, px; depths below 0.3 m count as 0.3 m
        sigma = widened * self.keypoint_sigma[chosen] * lenses[:, None, 0] / z.clamp_min(0.3)
        sigma = sigma * self._sigma_factor(confidence, chosen)
        problem.views = Views(
            self._tensor(observations.keypoints[at]),
            confidence,
            sigma.clamp_min(1.0),
            lenses,
            pose,
            self._shift(points),
        )

    def keypoints(self, *, hands: bool = False, face: bool = False) -> KeypointSet:
        """Return the keypoints of the body, and if requested of hands and face.

        The jaw line is left out: its landmarks slide over the cheek as the view changes.
        """
        index = list(range(BODY.start, BODY.stop))
        if hands:
            index += range(LEFT_HAND.start, RIGHT_HAND.stop)
        if face:
            index += range(FACE.start, FACE.stop)
        return keypoint_set(self.model, index)

    def points(self, problem: BodyProblem) -> Tensor:
        """Return the current positions (N, K, 3) of the problem's keypoints, with offsets."""
        params, offsets = self.model.parameters(problem.base), problem.all_offsets()
        parts = (
            keypoint_term.evaluate(
                self.model, params.frames(at), problem.keypoints, offsets, derivatives=False
            ).points
            for at in _blocks(len(self.frames))
        )
        return torch.cat([problem.base.new_zeros(0, len(problem.keypoints.index), 3), *parts])

    def pixel_residuals(self, problem: BodyProblem) -> Tensor:
        """Return projections minus observations (N, C, K, 2), px, of the problem's keypoints."""
        if problem.views is None:
            raise ValueError("the problem has no views to compare with")
        points, views = self.points(problem), problem.views
        parts = (
            keypoint_term.pixel_residuals(points[at], views.frames(at))
            for at in _blocks(len(points))
        )
        return torch.cat([views.observed[:0], *parts])

    def _shift(self, points: Tensor, frames: slice = slice(None)) -> Tensor | None:
        """Return the displacement (N, C, K, 3) of points (N, K, 3) until each camera exposes.

        It is the velocity of the points times the camera's time offset; None if all offsets are 0.
        """
        offset = self.observations.time_offset
        if not np.any(offset):
            return None
        return self._tensor(offset)[:, None, None] * self.velocity(points, frames)[:, None]

    def velocity(self, points: Tensor, frames: slice = slice(None)) -> Tensor:
        """Return the velocity (N, ..., 3), m/s, of points (N, ..., 3) of the usable ``frames``."""
        velocity = limited_velocity(
            points.double().numpy(),
            self.observations.times[self.frames[frames]],
            max_speed=6.0,  # m/s; hands reach about 5 in everyday tasks; tuned on the studio
        )
        return self._tensor(velocity)

    def _sigma_factor(self, confidence: Tensor, index: Tensor) -> Tensor:
        """Return the factor (N, C, K) of sigma by confidence (N, C, K); index (K,): keypoints.

        It is (confidence / median confidence)^-a, see `keypoint_doubt`.
        """
        share = confidence.clamp_min(keypoint_term.LEAST_CONFIDENCE) / self.median_confidence[index]
        return share ** -self.keypoint_doubt[index]

    def refine_sigma(self, problem: BodyProblem) -> None:
        """Estimate sigma and its dependence on confidence from the residuals.

        Each group of `KEYPOINT_SIGMA_M` has one estimate, from the median absolute residual. Sigma
        is limited to 0.1 to 4 times its initial value; tuned on the studio.
        """
        views = problem.views
        assert views is not None
        index = problem.keypoints.index
        # residuals in metres, at median confidence and without the factor ``widened``
        scaled = self.pixel_residuals(problem).abs_().div_(views.sigma[..., None])
        scaled *= self.keypoint_sigma[index, None]
        scaled *= self._sigma_factor(views.confidence, index)[..., None]
        for part, start in KEYPOINT_SIGMA_M:
            here = (index >= part.start) & (index < part.stop)
            known = views.confidence[:, :, here] > 0
            if bool(known.any()):
                confidence, errors = views.confidence[:, :, here][known], scaled[:, :, here][known]
                doubt = keypoint_term.fit_confidence_exponent(confidence, errors.mean(1))
                self.keypoint_doubt[part] = doubt
                factor = self._sigma_factor(views.confidence, index)[:, :, here][known]
                at_median = errors / factor[:, None]
                estimate = SIGMA_PER_MAD * PERSISTENCE * float(at_median.median())
                self.keypoint_sigma[part] = min(max(estimate, start * 0.1), start * 4.0)

    def refine_cloud_noise(self, problem: BodyProblem) -> None:
        """Estimate the noise of each covering from the median absolute residual of its samples.

        It is limited to 0.1 to 1.5 times its initial value; tuned on the studio.
        """
        rows = problem.rows
        assert rows is not None
        params, thickness = self.model.parameters(problem.base), problem.thickness_of_group()
        parts = []
        for at in _blocks(len(self.frames)):
            points = self.model.forward(params.frames(at), vertex_ids=self.sample_ids).vertices
            parts.append(cloud_term.residuals(points, rows.frames(at), thickness, self.group).abs())
        residual = torch.cat(parts)
        for g, covering in enumerate(COVERINGS):
            part = self.group == g
            known = rows.weight[:, part] > 0
            if bool(known.any()):
                estimate = SIGMA_PER_MAD * float(residual[:, part][known].median())
                start = covering.noise
                self.cloud_noise[g] = min(max(estimate, start * 0.1), start * 1.5)

    def observe_skin(
        self,
        problem: BodyProblem,
        reach: float,
        *,
        places: np.ndarray | None = None,
        only: np.ndarray | None = None,
        keep_views: bool = True,
        pairs: bool = True,
        depth_points_only: bool = False,
    ) -> None:
        """Match the clouds to the problem's bodies, and search their self-contacts.

        Sets the problem's rows of E_D, None without clouds, and its pairs, None if there are none.

        Args:
            problem: the bodies, changed in place.
            reach: largest valid distance, metres.
            places: (n,) indices of the frames to observe; None = all. Others have no rows or pairs.
            only: (N,) index of the only camera used in each frame; None = all cameras.
            keep_views: keep the measurements of each camera in ``by_view``, 110 kB a frame.
            pairs: search self-contacts, if the term is switched on.
            depth_points_only: match neither protruding samples nor rims.
        """
        count, size, zeros = len(self.frames), len(self.samples.vertex), problem.base.new_zeros
        places = np.arange(count) if places is None else places
        pairs = pairs and bool(problem.self_weight)
        problem.rows = problem.pairs = self.by_view = None  # those of the last call are not used
        if not self.has_cloud and not pairs:
            return
        rows = CloudRows(zeros(count, size), zeros(count, size, 3), zeros(count, size))
        views = (count, len(self.observations.rig), size)
        kept = None
        if keep_views:
            place, normal = zeros(count, size, 3), zeros(count, size, 3)
            kept = ViewDistances(zeros(views), zeros(views), place, normal)
        contacts = [no_contacts(problem.base)] * count
        for block in _blocks(len(places)):
            at = places[block]
            found = self._observe_block(
                problem, at, reach, only, contacts if pairs else None, depth_points_only
            )
            for whole, part in zip(rows, self.rows(found, found.points), strict=True):
                whole[at] = part
            if kept is not None:
                for whole, part in zip(kept, found, strict=True):
                    whole[at] = part
            del found, part
            return_freed_memory()  # contacts lie between freed bodies, 0.15 MB a frame
        if self.has_cloud:
            problem.rows, self.by_view = rows, kept
        ids = torch.as_tensor(self.surface.ids)
        problem.pairs = join_frames(
            [(ids[inner], ids[outer], normal) for inner, outer, normal in contacts]
        )

    def _observe_block(
        self,
        problem: BodyProblem,
        at: np.ndarray,
        reach: float,
        only: np.ndarray | None,
        contacts: list[Contacts] | None,
        depth_points_only: bool,
    ) -> ViewDistances:
        """Observe the frames ``at`` (b,); see :meth:`observe_skin`.

        Returns their measurements, and writes their self-contacts to ``contacts``, if given.
        """
        together = 16  # bodies, limited by memory: the surface of one has 250 kB
        size, zeros = len(self.samples.vertex), problem.base.new_zeros
        views = len(self.observations.rig)
        where, shift = self._place_samples(problem, at)
        of_views, points = zeros(len(at), views, size), zeros(len(at), views, size)
        normal = zeros(len(at), size, 3)
        expected = problem.thickness().repeat(views)

        def observe_frame(row: int, vertices: Tensor, normals: Tensor) -> None:
            t = int(at[row])
            cloud = self.clouds[t]
            if contacts is not None:
                contacts[t] = find_contacts(self._self_contact, vertices, normals)
            if cloud is None:
                return
            if only is not None:
                cloud = cloud.of_view(int(only[t]))
            skin = PosedSkin(vertices, normals, where[row], None if shift is None else shift[row])
            matches = self._matcher.match(
                cloud,
                self.observations.rig,
                self.observations.depth_bias,
                skin,
                expected,
                reach,
                depth_points_only,
            )
            of_views[row], points[row] = matches.distance, matches.points
            self.measured[t], self.cloud_residual[t] = matches.measured, matches.residual

        params = self.model.parameters(problem.base[at])
        for start in range(0, len(at), together):
            rows = slice(start, min(start + together, len(at)))
            vertices, normals = self.surface.posed(params.frames(rows))
            normal[rows] = normals[:, self._matcher.sample]
            posed = zip(range(rows.start, rows.stop), vertices, normals, strict=True)
            self._threads.map(lambda frame: observe_frame(*frame), list(posed))
        return ViewDistances(of_views, points, where, normal)

    def _place_samples(self, problem: BodyProblem, at: np.ndarray) -> tuple[Tensor, Tensor | None]:
        """Return the samples (b, S, 3) in the frames ``at`` (b,), metres, and their displacements
        (b, C, S, 3) until each camera exposes; None if all time offsets are 0."""
        # velocities follow from the positions two frames before and after
        around = slice(max(int(at[0]) - 2, 0), min(int(at[-1]) + 3, len(self.frames)))
        params = self.model.parameters(problem.base[around])
        where = self.model.forward(params, vertex_ids=self.sample_ids).vertices
        shift = self._shift(where, around)
        own = at - around.start
        return where[own], None if shift is None else shift[own]

    def rows(self, by_view: ViewDistances, points: Tensor) -> CloudRows:
        """Return the rows of E_D of ``by_view``; points (N, C, S): effective number of points."""
        noise = self.cloud_noise[self.group]
        return by_view.rows(noise, self.cloud_weight, points)


def _blocks(count: int) -> list[slice]:
    """Divide frames into blocks, which bounds memory."""
    starts = range(0, count, BLOCK_FRAMES)
    return [slice(start, min(start + BLOCK_FRAMES, count)) for start in starts]
