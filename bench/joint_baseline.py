"""The paper's joint refinement, as a baseline: equation 6 minimised by L-BFGS.

All frames are refined at once from the sequential fits, in one run of L-BFGS with strong Wolfe line
searches; derivatives are autograd's. The paper states neither steps nor solver. Its authors' public
code makes 100 and then 600 L-BFGS steps (its conf.yaml: ``lbfgsls``, step 1), the first with the
shape free. Here the shape stays the mean, as in the paper, for all 700.

Terms, with all frames and views in one batch:

- E_B: our own data terms and priors, in plain torch. The terms of :mod:`bench.body_baseline` model
  neither clothing nor the detector's definition of joints.
- E_O: equation 1 as in :mod:`bench.object_baseline`, in units of the track's covariance.
- Q_t E_C: Chamfer distance of the touching regions' vertices to the object. Q_t is binary: the
  contact that our stage detects at the start, as there are no annotations. Robust as in the public
  code.
- Body in object, E_G, E_G', E_S and E_A are our equations with our weights. E_S is that of joints,
  because LEMO's weights are not free.

Stick, planted feet and drift go beyond the paper and are left out. Correspondences of
the clouds, pixel sigmas and standing vertices are updated every ``ROUND`` steps.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bench.body_energy import BodyEnergy
from bench.clips import JointClip
from bench.object_baseline import Crops, ObjectImages
from intercap_core.body.kinematics import rotation_from_axis_angle
from intercap_core.body_fit.term_inputs import Bodies
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.solve.robust import geman_mcclure
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.proximity import proximity
from intercap_core.joint.skin import SURFACE_SIGMA, VERTICES_PER_MEASUREMENT
from intercap_core.joint.state import BODY, OBJECT_SHIFT, OBJECT_TURN, State
from intercap_core.joint.terms.motion import ACCELERATION_OUTLIER, BODY_ACCELERATION
from intercap_core.joint.terms.penetration import PENETRATION_SIGMA, PENETRATION_TOLERANCE

STEPS = 700  # of L-BFGS: 100 and 600
ROUND = 10  # steps between two looks at the clouds
HISTORY = 100
LINE_SEARCH = 25  # evaluations a step at most: all that a line search may ask for
TOLERANCE = 1e-9  # of the energy, between rounds, as in the public code
CONTACT_SCALE_M = 0.05  # of the robust contact term, as in the public code
# Of equation 1's sums, which count pixels: the energy's curvature is then that of the track's
# covariance. Measured on the studio's suitcase.
OBJECT_WEIGHT = 5e-3


class Energy:
    """Equation 6 as a function of steps x (T, 174) from the state of the sequential fits."""

    def __init__(self, clip: JointClip) -> None:
        self._clip = clip
        self.geometry = RigidAndSkin(clip.geometry, clip.start)
        self._images = object_images(clip)
        self._index = torch.arange(len(clip))
        self._contact = contact_weights(clip.geometry, clip.touching)

    def observe(self, x: Tensor) -> None:
        """Update at x what is fixed during a round of L-BFGS."""
        clip, posed = self._clip, self.geometry.at(x.detach())
        problem = clip.body.problem
        problem.base = problem.base.clone()
        problem.base[:, BODY] = posed.body
        clip.body.fitter.observe(problem)
        self._standing = standing(posed.object_vertices, clip)

    def terms(self, x: Tensor) -> dict[str, Tensor]:
        """The energy of each term, differentiable."""
        clip, posed, settings = self._clip, self.geometry.at(x), self._clip.settings
        problem = clip.body.problem
        bodies = Bodies(
            problem.layout.vectors(problem.base, posed.body, None), problem.all_offsets(),
            problem.thickness_of_group(), self._index,
        )  # fmt: skip
        distance = posed.distance()
        at_patch = torch.as_tensor(clip.geometry.skin.patch)
        found = {
            "body_data": BodyEnergy(problem).cost(bodies).sum(),
            "object_data": OBJECT_WEIGHT * self._images(posed.rotation, posed.translation),
            "contact": settings.contact_weight * contact(distance[:, at_patch], self._contact),
            "penetration": settings.penetration_weight * penetration(distance, clip.geometry),
            "body_motion": settings.body_smoothness * accelerations(posed.joints, clip.fps),
            "object_motion": settings.object_smoothness * accelerations(posed.moments, clip.fps),
        }
        if clip.floor is not None:
            found["ground"] = settings.ground_weight * ground(posed, clip, self._standing)
        return found

    def __call__(self, x: Tensor) -> Tensor:
        """The energy, a scalar, differentiable."""
        return torch.stack(list(self.terms(x).values())).sum()

    def state(self, x: Tensor) -> State:
        """The state that x leads to."""
        return self._clip.start.moved(x.detach().double().numpy())


@dataclass(frozen=True, eq=False)
class Posed:
    """Body and object, metres, master frame."""

    geometry: Geometry
    body: Tensor
    """(T, 168)."""
    skin: Tensor
    """(T, N, 3)."""
    joints: Tensor
    """(T, 55, 3)."""
    rotation: Tensor
    """(T, 3, 3)."""
    translation: Tensor
    """(T, 3)."""

    def distance(self) -> Tensor:
        """Signed distances (T, N) of the skin to the object.

        The closest point and the direction are constants, which leaves value and gradient exact.
        """
        points, rotation, translation = (
            part.detach().double().numpy() for part in (self.skin, self.rotation, self.translation)
        )
        near = proximity(self.geometry.field, points, rotation, translation)
        closest = points - near.distance[..., None] * near.normals
        local = np.einsum("tji,tnj->tni", rotation, closest - translation[:, None])
        apart = self.skin - self.of_object(local)
        return (torch.as_tensor(near.normals).to(self.skin) * apart).sum(-1)

    def of_object(self, points: np.ndarray) -> Tensor:
        """Points (N, 3) or (T, N, 3) of the object in the master frame (T, N, 3)."""
        local = torch.as_tensor(points).to(self.skin)
        return local @ self.rotation.mT + self.translation[:, None]

    @property
    def moments(self) -> Tensor:
        return self.of_object(self.geometry.moments)

    @property
    def object_vertices(self) -> Tensor:
        return self.of_object(self.geometry.mesh.vertices)


class RigidAndSkin:
    """Body and object at steps x (T, 174) from ``start``."""

    def __init__(self, geometry: Geometry, start: State) -> None:
        self._geometry, self._model = geometry, geometry.model
        whole = start.parameters(geometry.model).vector()
        self._start, self._rest = whole[:, BODY], whole[:, BODY.stop :]
        self._rotation, self._translation = (
            torch.as_tensor(part).to(whole) for part in (start.rotation, start.translation)
        )

    def at(self, x: Tensor) -> Posed:
        """Pose the skin's vertices, the joints and the object."""
        body = self._start + x[:, BODY]
        vector = torch.cat([body, self._rest], 1)
        posed = self._model(self._model.parameters(vector), vertex_ids=self._geometry.skin.vertices)
        turn = rotation_from_axis_angle(x[:, OBJECT_TURN])
        return Posed(
            self._geometry, body, posed.vertices, posed.joints, turn @ self._rotation,
            self._translation + x[:, OBJECT_SHIFT],
        )  # fmt: skip


def object_images(clip: JointClip) -> ObjectImages:
    """E_O with the crops that are chosen at the sequential fits."""
    poses = rigid(clip.start.rotation, clip.start.translation)
    crops = {
        t: Crops.cut(clip.tracked, views, pose, clip.object_settings.min_overlap, clip.labels)
        for t, (views, pose) in enumerate(zip(clip.views, poses, strict=True))
    }
    seen = {t: crop for t, crop in crops.items() if crop is not None}
    return ObjectImages(clip.tracked, seen)


def contact_weights(geometry: Geometry, touching: np.ndarray) -> Tensor:
    """Weights (T, M) of the patches' vertices in E_C; those of a touching region sum to 1."""
    region = geometry.patches.region
    share = 1 / np.bincount(region, minlength=touching.shape[1])[region]
    return torch.as_tensor((touching[:, region] * share).astype(np.float32))


def contact(distance: Tensor, weights: Tensor) -> Tensor:
    """Q_t E_C of distances (T, M), metres, of the likely-contact vertices."""
    return (
        0.5 * (weights * geman_mcclure(distance**2, CONTACT_SCALE_M).rho).sum() / SURFACE_SIGMA**2
    )


def penetration(distance: Tensor, geometry: Geometry) -> Tensor:
    """Body in object of distances (T, N), metres, of the skin's vertices."""
    depth = (distance + PENETRATION_TOLERANCE).clamp(max=0) / PENETRATION_SIGMA
    share = torch.as_tensor(geometry.skin.share).to(distance)
    return 0.5 * (share * depth**2).sum() / VERTICES_PER_MEASUREMENT


def standing(object_vertices: Tensor, clip: JointClip) -> Tensor:
    """Number (T, 1) of vertices on which the object stands."""
    return (_height(object_vertices, clip) < 0).sum(1, keepdim=True).clamp_min(1)


def ground(posed: Posed, clip: JointClip, stands_on: Tensor) -> Tensor:
    """E_G and E_G'; object vertices are weighted by the number that stand (T, 1)."""
    share = torch.as_tensor(clip.geometry.skin.share).to(posed.skin) / VERTICES_PER_MEASUREMENT
    body = (share * _height(posed.skin, clip) ** 2).sum()
    object_ = (_height(posed.object_vertices, clip) ** 2 / stands_on).sum()
    return 0.5 * (body + object_) / SURFACE_SIGMA**2


def _height(points: Tensor, clip: JointClip) -> Tensor:
    """Heights (T, N) of points (T, N, 3) above the floor, 0 where positive."""
    if clip.floor is None:
        return points.new_zeros(points.shape[:2])
    point, normal = (torch.as_tensor(a).to(points) for a in (clip.floor.point, clip.floor.normal))
    return ((points - point) @ normal).clamp(max=0)


def accelerations(points: Tensor, fps: float) -> Tensor:
    """E_S of joints (T, 55, 3), E_A of points with the object's moments (T, 6, 3)."""
    ahead, now, behind = points[2:], points[1:-1], points[:-2]
    scaled = (behind - 2 * now + ahead) * fps**2 / (BODY_ACCELERATION * ACCELERATION_OUTLIER)
    return ACCELERATION_OUTLIER**2 * ((1 + (scaled**2).sum(-1)).sqrt() - 1).sum()


@dataclass(frozen=True, eq=False)
class Refined:
    """Results after every round, the start first."""

    states: list[State]
    seconds: np.ndarray
    """(R,)."""
    energy: np.ndarray
    """(R,) before the clouds are observed again."""
    steps: np.ndarray
    """(R,) L-BFGS steps so far."""


def refine(energy: Energy, frames: int, steps: int = STEPS) -> Refined:
    """Take at most ``steps`` L-BFGS steps from the sequential fits of ``frames``."""
    begin = time.process_time()
    x = torch.zeros((frames, OBJECT_SHIFT.stop), requires_grad=True)
    optimiser = _lbfgs(x)
    states = [energy.state(x)]
    rows: list[tuple[float, float, int]] = []
    done, before = 0, np.inf
    while done < steps:
        energy.observe(x)
        options = optimiser.param_groups[0]
        options["max_iter"] = min(ROUND, steps - done)
        options["max_eval"] = LINE_SEARCH * options["max_iter"]
        taken = optimiser.state[x].get("n_iter", 0)

        def closure(optimiser: torch.optim.Optimizer = optimiser) -> Tensor:
            optimiser.zero_grad()
            loss = energy(x)
            loss.backward()
            return loss

        first = optimiser.step(closure).item()
        if not rows:
            rows.append((time.process_time() - begin, first, 0))
        taken = optimiser.state[x]["n_iter"] - taken
        with torch.no_grad():
            last = energy(x).item()
        if not np.isfinite(last):
            raise FloatingPointError(f"the baseline's energy is {last} after {done} steps")
        done += max(taken, 1)
        states.append(energy.state(x))
        rows.append((time.process_time() - begin, last, done))
        if abs(first - last) <= TOLERANCE * max(first, last, 1.0):
            if taken >= ROUND or before == 0:
                break
            optimiser, before = _lbfgs(x), 0  # once more without the history
        else:
            before = np.inf
    seconds, energies, numbers = (np.array(column) for column in zip(*rows, strict=True))
    seconds[0] = 0.0
    return Refined(states, seconds, energies, numbers)


def _lbfgs(x: Tensor) -> torch.optim.LBFGS:
    return torch.optim.LBFGS([x], history_size=HISTORY, line_search_fn="strong_wolfe")
