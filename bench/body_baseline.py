"""The paper's body fit, as a baseline: equation 2 minimised by L-BFGS in stages.

Each frame starts from the frame before it. The stages, their weights, the robust functions and the
solver are those of SMPLify-X and PROX-D, on which the paper builds; derivatives are autograd's,
through this project's body model, and the views are one batch. The pose prior is this project's
open prior, in units of its spread as in VPoser's code, because VPoser's weights are licensed. E_D
is measured to the vertices that each view sees, and back; correspondences are updated in every
evaluation, visibility in every stage. Self-penetration is left out, which makes the baseline
faster.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from intercap_core.body import priors
from intercap_core.body.keypoints import BODY, FACE, LEFT_HAND, NUM_KEYPOINTS, RIGHT_HAND
from intercap_core.body.kinematics import vertex_normals
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import NUM_POSE, TRANSL
from intercap_core.body_fit.clouds import PersonCloud
from intercap_core.body_fit.observations import Observations
from intercap_core.evaluation.proximity import seen_by_cameras
from intercap_core.geometry.camera import projection
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.geometry.solve.robust import geman_mcclure

HAND_COMPONENTS = 12
KEYPOINT_SCALE_PX = 100.0
SCAN_TO_MESH_SCALE_M, MESH_TO_SCAN_SCALE_M = 0.2, 0.5
IGNORED_KEYPOINTS = (1, 9, 12)  # neck and hips, which detectors place elsewhere
BENDING = 3.17  # times the pose prior's weight, not squared
JAW_SIDEWAYS = 10.0  # times the weight of opening
ITERATIONS = 30  # of L-BFGS a round
ROUNDS = 30  # at most in a stage
TOLERANCE = 1e-9  # of the energy, between rounds
HISTORY = 100
_SMALLEST_DEVIATION = 0.03  # of a hand component, as in the fit that is compared
_BODY, _JAW, _EYES = slice(3, 66), slice(66, 69), slice(69, 75)


@dataclass(frozen=True)
class Stage:
    """Weights of one stage; all but ``scan_to_mesh`` are applied squared."""

    pose: float
    shape: float
    jaw: float
    hands: float  # keypoints of the hands; those of the body have weight 1
    face: float  # keypoints of the face
    scan_to_mesh: float  # from the cloud to the mesh; the other direction has weight 1


STAGES = (
    Stage(404, 100, 4040, 0, 0, 1),
    Stage(404, 50, 4040, 0, 0, 1),
    Stage(57.4, 10, 574, 0, 0, 100),
    Stage(4.78, 5, 47.8, 0.1, 0, 500),
    Stage(4.78, 5, 47.8, 2, 2, 500),
)


@dataclass(frozen=True, eq=False)
class FrameFit:
    """All E evaluations of the energy in the fit of one frame."""

    vectors: Tensor  # (E, P) bodies
    energy: np.ndarray  # (E,)
    stage: np.ndarray  # (E,) index of the stage
    seconds: np.ndarray  # (E,) since the start of the frame

    @property
    def end(self) -> Tensor:
        """The body (P,) at the end of the last stage."""
        return self.vectors[self.best[-1]]

    @property
    def best(self) -> np.ndarray:
        """Index (E,) of the stage's best evaluation up to each evaluation.

        The line search may have left it again.
        """
        kept = np.zeros(len(self.energy), int)
        for e in range(1, len(kept)):
            before = kept[e - 1]
            same = self.stage[e] == self.stage[before]
            kept[e] = before if same and self.energy[before] <= self.energy[e] else e
        return kept


def fit_by_lbfgs(
    model: BodyModel,
    seen: Observations,
    t: int,
    cloud: PersonCloud | None,
    start: Tensor,
    stages: tuple[Stage, ...] = STAGES,
) -> FrameFit:
    """Fit frame ``t`` from the body ``start`` (P,) through ``stages``."""
    begin = time.process_time()
    free = Free(model)
    x = free.of(start).requires_grad_(True)
    energy = Energy(model, seen, t, cloud)
    path: list[tuple[Tensor, float, int, float]] = []
    for number, stage in enumerate(stages):
        energy.enter(stage, free.full(x.detach()))
        optimiser = torch.optim.LBFGS(
            [x], max_iter=ITERATIONS, history_size=HISTORY, line_search_fn="strong_wolfe"
        )

        def closure(number: int = number, optimiser: torch.optim.Optimizer = optimiser) -> Tensor:
            optimiser.zero_grad()
            loss = energy(free.full(x))
            loss.backward()
            now = time.process_time() - begin
            path.append((x.detach().clone(), loss.item(), number, now))
            return loss

        before = None
        for _ in range(ROUNDS):
            loss = optimiser.step(closure).item()
            if not np.isfinite(loss):
                raise FloatingPointError(f"the baseline's energy is {loss} in frame {t}")
            if before is not None and abs(before - loss) <= TOLERANCE * max(before, loss, 1.0):
                break
            before = loss
    vectors, losses, numbers, seconds = zip(*path, strict=True)
    bodies = torch.cat([free.full(vector) for vector in vectors])
    return FrameFit(bodies, np.array(losses), np.array(numbers), np.array(seconds))


class Free:
    """Conversion between parameter vectors and the free parameters (66 + 3 + 24 + 3 + S,).

    Free are global orientation and body pose, jaw, normalised coefficients of both hands,
    translation, shape and expression. The eyes are fixed.
    """

    def __init__(self, model: BodyModel) -> None:
        self._mean = model.hand_mean
        deviation = model.hand_deviation[:, :HAND_COMPONENTS].clamp_min(_SMALLEST_DEVIATION)
        self._deviation = deviation
        self._components = model.hand_components[:, :HAND_COMPONENTS] * deviation[..., None]
        self._back = model.hand_components[:, :HAND_COMPONENTS] / deviation[..., None]

    def of(self, vector: Tensor) -> Tensor:
        """From a parameter vector (P,)."""
        hands = vector[75:NUM_POSE].reshape(2, 45) - self._mean
        coefficients = (self._back @ hands[..., None]).reshape(-1)
        return torch.cat([vector[: _JAW.stop], coefficients, vector[TRANSL.start :]]).clone()

    def full(self, x: Tensor) -> Tensor:
        """The parameter vector (1, P)."""
        body, coefficients, rest = x.split([_JAW.stop, 2 * HAND_COMPONENTS, len(x) - 93])
        hands = coefficients.reshape(2, 1, -1) @ self._components + self._mean[:, None]
        eyes = x.new_zeros(_EYES.stop - _EYES.start)
        return torch.cat([body, eyes, hands.reshape(-1), rest])[None]


class _ViewCloud(NamedTuple):
    """Points (M, 3) of one view and their search tree."""

    points: Tensor
    tree: cKDTree


def _of_view(cloud: PersonCloud, view: int) -> _ViewCloud | None:
    points = cloud.points[cloud.view == view]
    return _ViewCloud(points, cKDTree(points.cpu().numpy())) if len(points) else None


class Energy:
    """Equation 2 of one frame as a function of a parameter vector (1, P), in torch."""

    def __init__(
        self, model: BodyModel, seen: Observations, t: int, cloud: PersonCloud | None
    ) -> None:
        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, dtype=model.dtype, device=model.device)

        self._model, self._rig = model, seen.rig
        self._observed, self._confidence = tensor(seen.keypoints[t]), tensor(seen.confidence[t])
        self._lenses = tensor(seen.rig.colour_parameters)[:, None]
        pose = tensor(seen.rig.colour_from_master)
        self._rotation, self._shift = pose[:, :3, :3], pose[:, None, :3, 3]
        views = range(len(seen.rig))
        self._clouds = [None if cloud is None else _of_view(cloud, c) for c in views]
        self._visible: list[Tensor] = []
        self._threads = torch.get_num_threads()
        self._trust = tensor(np.zeros(NUM_KEYPOINTS))

    def enter(self, stage: Stage, vector: Tensor) -> None:
        """Set the stage's weights, and each view's visible vertices at a body (1, P)."""
        self._stage = stage
        self._trust = torch.zeros_like(self._trust)
        self._trust[BODY] = 1
        self._trust[list(IGNORED_KEYPOINTS)] = 0
        self._trust[LEFT_HAND] = self._trust[RIGHT_HAND] = stage.hands
        self._trust[FACE] = stage.face
        with torch.no_grad():
            vertices = self._model.forward(self._model.parameters(vector)).vertices
            normals = vertex_normals(vertices, self._model.faces)[0].double().cpu().numpy()
        points, faces = vertices[0].double().cpu().numpy(), self._model.faces.cpu().numpy()
        surface = SurfaceTree(points, faces).shaped(points)
        self._visible = [
            torch.as_tensor(
                np.flatnonzero(seen_by_cameras(points, normals, [camera], [surface]))
            ).to(vector.device)
            for camera in self._rig
        ]

    def __call__(self, vector: Tensor) -> Tensor:
        """The energy, a scalar, differentiable."""
        output = self._model.forward(self._model.parameters(vector))
        keypoints = self._model.keypoints(output)[0]
        return (
            self._reprojection(keypoints) + self._depth(output.vertices[0]) + self._priors(vector)
        )

    def _reprojection(self, keypoints: Tensor) -> Tensor:
        """E_J: keypoints (135, 3), trust and confidence squared."""
        pixels = projection.project(keypoints @ self._rotation.mT + self._shift, self._lenses)
        weight = (self._trust * self._confidence) ** 2
        apart = torch.where(weight[..., None] > 0, pixels - self._observed, 0)
        return (weight * geman_mcclure((apart**2).sum(-1), KEYPOINT_SCALE_PX).rho).sum()

    def _depth(self, vertices: Tensor) -> Tensor:
        """E_D in both directions, between each view's cloud and its visible vertices of (V, 3)."""
        there = back = vertices.new_zeros(())
        for cloud, visible in zip(self._clouds, self._visible, strict=True):
            if cloud is None or not len(visible):
                continue
            mesh = vertices[visible]
            points = mesh.detach().cpu().numpy()
            tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
            _, to_mesh = tree.query(cloud.points.cpu(), workers=self._threads)
            _, to_cloud = cloud.tree.query(points, workers=self._threads)
            apart = ((mesh[to_mesh] - cloud.points) ** 2).sum(1)
            there = there + geman_mcclure(apart, SCAN_TO_MESH_SCALE_M).rho.sum()
            apart = ((mesh - cloud.points[to_cloud]) ** 2).sum(1)
            back = back + geman_mcclure(apart, MESH_TO_SCAN_SCALE_M).rho.sum()
        return self._stage.scan_to_mesh * there + back

    def _priors(self, vector: Tensor) -> Tensor:
        """E_theta_b, E_theta_h, E_theta_f, E_alpha, E_beta and E_psi."""
        model, stage = self._model, self._stage
        deviation = model.hand_deviation.clamp_min(_SMALLEST_DEVIATION)
        pose = (priors.rest_pose(vector).residuals[:, : _BODY.stop - 3] ** 2).sum()
        pose = pose + (priors.joint_limits(vector).residuals ** 2).sum()
        for side in (0, 1):
            own = (model.hand_mean, model.hand_components, deviation)
            rows = priors.hand_pose(vector, *own, side=side)
            pose = pose + (rows.residuals[:, :HAND_COMPONENTS] ** 2).sum()
        jaw = vector[0, _JAW] * vector.new_tensor([1.0, JAW_SIDEWAYS, JAW_SIDEWAYS])
        return (
            stage.pose**2 * pose
            + BENDING * stage.pose * (priors.bending(vector).residuals ** 2).sum()
            + stage.shape**2 * (vector[0, TRANSL.stop :] ** 2).sum()
            + stage.jaw**2 * (jaw**2).sum()
        )
