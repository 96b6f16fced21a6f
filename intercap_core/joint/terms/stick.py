"""Points of the skin as the object sees them: what is held does not slide, what stands stays.

    q = R^T (x - t)

A point x of the skin that sticks to the object is a constant q of its frame. Beyond the paper,
whose contact pulls along the surface's normal alone.

Stick (beyond the paper): skin that holds the object does not slide over it.

    E = sum over steps t, vertices i of Q_i a_i rho(|q_i(t+1) - q_i(t)|^2) / 2 sigma^2

q is the vertex in the object's frame (:mod:`intercap_core.joint.terms.stick_residual`), Q the
probability that
its region touches in both frames and its patch takes part, a its share of its patch's area. sigma
is that of a random walk: real grips creep. Robust, so that what truly slides, turns in the fingers
or is taken anew does so; and left out where a vertex has come far over the object at the start of
the fit, in a time in which jitter goes nowhere. Weighed by the setting ``stick_weight``.
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.state import ALL, State
from intercap_core.joint.terms.contact import Contact
from intercap_core.joint.terms.term import Term, add_steps
from intercap_core.schemas import CONTACT_REGIONS

# How far a grip and a sole creep: a random walk, metres in one second. Tuned on the studio.
STICK_WALK = 0.003
# Speeds of what truly slides, m/s: beyond the jitter of the fits. Tuned on the studio.
STICK_OUTLIER = 0.15
# What has come so far over the object within so long truly slides, metres and seconds. Tuned on the
# studio.
GLIDE_M, GLIDE_S = 0.02, 0.4
# Probability of a hold below which a patch is left out, and share of the most that a vertex of it
# holds below which others are; vertices of a patch, and of each half of a sole, at most: they move
# nearly as one.
STICK_LEAST, STICK_NEAR = 0.02, 0.1
STICK_VERTICES = 24

# Hands grip and soles stand; what sits or leans glides as it settles.
_GRIPPING = [i for i, name in enumerate(CONTACT_REGIONS) if name.endswith(("_hand", "_foot"))]


def local_points(points: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Points (T, N, 3) of the master frame in an object's, ``rotation`` (T, 3, 3) and
    ``translation`` (T, 3) master_from_object."""
    return (points - translation[:, None]) @ rotation


def local_by_object(
    points: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """Derivative (T, N, 3, 6) of :func:`local_points` by a turn (left) and a shift of the object.

    q' = R^T exp(-w) (x - t - d), so that dq/dw = R^T [x - t]_x and dq/dd = -R^T.
    """
    arm = points - translation[:, None]
    axes = rotation.transpose(0, 2, 1)[:, None]  # rows: the object's axes in the master frame
    # row a of R^T [v]_x is a x v
    by_turn = np.cross(axes, arm[:, :, None])
    return np.concatenate([by_turn, np.broadcast_to(-axes, by_turn.shape)], axis=3)


class Stick(Term):
    """Relative motion of touching skin and object, with the ``contact`` term's probabilities."""

    name = "stick"

    def __init__(self, geometry: Geometry, contact: Contact, fps: float, weight: float) -> None:
        self._geometry, self._contact, self._fps = geometry, contact, fps
        self._scale = weight * fps / STICK_WALK**2
        self._grips = np.isin(geometry.patches.region, _GRIPPING)
        self._holds: np.ndarray | None = None
        self._index = np.zeros(0, int)  # of the skin's vertices
        self._weight = np.zeros((0, 0))

    def refresh(self, state: State) -> None:
        """Take anew which vertices hold the object over each step: of each patch those that do so
        most, with the weight of all of it."""
        holds = self._contact.holding()
        both = np.minimum(holds[1:], holds[:-1])
        patch = self._geometry.patches.patch
        if self._holds is None:
            self._holds = self._still(state)
        both = both * self._holds
        kept, weights = [np.zeros(0, int)], [np.zeros((len(both), 0))]
        for number in np.unique(patch[self._grips]):
            members = np.flatnonzero(patch == number)
            own = both[:, members]
            if own.sum(axis=1).max(initial=0.0) > STICK_LEAST:
                some, weight = _representatives(own)
                kept.append(members[some])
                weights.append(weight)
        self._index = self._geometry.skin.patch[np.concatenate(kept)]
        self._weight = np.concatenate(weights, axis=1) * self._scale

    def _still(self, state: State) -> np.ndarray:
        """Weights (T - 1, M) of the steps of all vertices of patches, by how far each has come over
        the object around a step, at the start: jitter goes nowhere, what glides does."""
        points = self._geometry.at(state).skin[:, self._geometry.skin.patch]
        local = local_points(points, state.rotation, state.translation)
        half = max(1, round(GLIDE_S * self._fps / 2))
        step = np.arange(max(len(state) - 1, 0))
        before, after = np.maximum(step - half + 1, 0), np.minimum(step + half, len(state) - 1)
        way = np.square(local[after] - local[before]).sum(axis=2)
        return geman_mcclure_weight(way, GLIDE_M)

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add the slips at ``state``."""
        frames, count = len(state), len(self._index)
        if frames < 2 or not count:
            return
        posed = self._geometry.at(state)
        points = posed.skin[:, self._index]
        local = local_points(points, state.rotation, state.translation)

        def rows(at: slice, index: np.ndarray) -> np.ndarray:
            rotation, some = state.rotation[at], points[at, index]
            axes = np.broadcast_to(rotation.transpose(0, 2, 1)[:, None], (*some.shape, 3))
            by_body = posed.skin_by_body(at, self._index[index], axes)
            by_object = local_by_object(some, rotation, state.translation[at])
            return np.concatenate([by_body, by_object], axis=3)

        outlier = STICK_OUTLIER / self._fps
        add_steps(self.name, ALL, local, rows, self._weight, outlier, equations)


def _representatives(holds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Some (K,) of a patch's vertices that hold the most, ``holds`` (T - 1, M), and their weights
    (T - 1, K), which are those of the whole patch."""
    most = holds.max(axis=0)
    near = np.flatnonzero(most > STICK_NEAR * most.max())
    some = near[np.linspace(0, len(near) - 1, min(len(near), STICK_VERTICES)).round().astype(int)]
    weight = holds[:, some]
    part = np.maximum(weight.sum(axis=1), STICK_NEAR * holds.sum(axis=1))
    share = np.divide(holds.sum(axis=1), part, out=np.zeros(len(holds)), where=part > 0)
    return some, weight * share[:, None]
