"""Stick (beyond the paper): skin that holds the object does not slide over it.

    E = sum over steps t, vertices i of Q_i a_i rho(|q_i(t+1) - q_i(t)|^2) / 2 sigma^2
    q = R^T (x - t)

A step leads from frame t to frame t + 1. q is the vertex x in the frame of the object, whose pose
is R and t; it is constant while the skin sticks to the object. Q is the probability that the
vertex's region touches in both frames, and a the vertex's share of its patch. sigma^2 is the
variance of a random walk over one step, as real grips creep. rho is robust (Geman-McClure), so that
skin may slide or grasp again. Vertices that glide over the object in the sequential fits have
little weight. Weighed by the setting ``stick_weight``.
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.hand_track import CREEP, window_displacement, window_frames
from intercap_core.joint.state import ALL, State
from intercap_core.joint.terms.contact import Contact
from intercap_core.joint.terms.term import SLIP_OUTLIER, Data, Equation, JointTerm, TermContext
from intercap_core.schemas import CONTACT_REGIONS

STICK_VERTICES = 24  # at most for a patch, whose vertices move nearly as one; tuned on the studio

# Hands grip and soles stand; what sits or leans glides as it settles.
_GRIPPING = [i for i, name in enumerate(CONTACT_REGIONS) if name.endswith(("_hand", "_foot"))]


def local_points(points: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Points (T, N, 3) of the master frame in the object's frame.

    ``rotation`` (T, 3, 3) and ``translation`` (T, 3) are master_from_object.
    """
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


class Stick(JointTerm):
    """Relative motion of touching skin and object, with the probabilities of E_C."""

    name = "stick"
    equation = Equation(
        symbol="stick",
        source="beyond",
        formula="Q_t rho(\\|\\|q(t+1) - q(t)\\|\\|^2) / (2 sigma^2), q = R^T (x - t) the place on "
        "the object of a vertex x of a hand or a sole that touches it",
        settings=("stick_weight",),
    )
    needs = frozenset({Data.OBJECT})

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        self._contact, self._fps = context.find(Contact), context.fps
        self._scale = context.settings.stick_weight * context.fps / CREEP**2
        self._grips = np.isin(self.geometry.patches.region, _GRIPPING)
        self._steady: np.ndarray | None = None  # (T - 1, M)
        self._outlier = np.zeros(0)  # (M,) slip that counts a quarter, metres
        self._kept = np.zeros(0, int)  # (K,) of the patch vertices
        self._index = np.zeros(0, int)  # (K,) of the skin samples
        self._weight = np.zeros((0, 0))  # (T - 1, K)

    def refresh(self, state: State) -> None:
        """Choose the vertices that hold the object over each step.

        The vertices that hold it most represent their patch, with the weight of all of it.
        """
        holds = self._contact.holding_probability()
        both = np.minimum(holds[1:], holds[:-1])
        patch = self.geometry.patches.patch
        points = self.geometry.at(state).skin[:, self.geometry.skin.patch]
        local = local_points(points, state.rotation, state.translation)
        jitter = self._jitter(local)
        if self._steady is None:
            # A displacement of 10 mm beyond the jitter of its mean places counts a quarter; tuned.
            way = np.square(window_displacement(local, self._fps))
            noise = 2 * jitter / np.sqrt(window_frames(self._fps))
            self._steady = geman_mcclure_weight(way, np.hypot(0.01, noise))
        both = both * self._steady
        self._outlier = np.hypot(SLIP_OUTLIER / self._fps, 2 * jitter)
        kept, weights = [np.zeros(0, int)], [np.zeros((len(both), 0))]
        for number in np.unique(patch[self._grips]):
            members = np.flatnonzero(patch == number)
            own = both[:, members]
            if own.sum(axis=1).max(initial=0.0) > 0.02:  # probability; tuned on the studio
                some, weight = _representatives(own)
                kept.append(members[some])
                weights.append(weight)
        self._kept = np.concatenate(kept)
        self._index = self.geometry.skin.patch[self._kept]
        self._weight = np.concatenate(weights, axis=1) * self._scale

    def _jitter(self, local: np.ndarray) -> np.ndarray:
        """Median displacement (M,) of each region from frame to frame while it holds the object.

        Args:
            local: (T, M, 3) patch vertices in the object's frame, metres.
        """
        regions = self.geometry.patches.region
        held = self._contact.probability > 0.5
        step = np.linalg.norm(np.diff(local, axis=0), axis=2)
        result = np.zeros(len(regions))
        for region in _GRIPPING:
            members = np.flatnonzero(regions == region)
            both = held[1:, region] & held[:-1, region]
            if len(members) and both.any():
                result[members] = np.median(step[np.ix_(both, members)])
        return result

    def add(self, state: State, equations: BandedEquations) -> None:
        """Add the slip of the vertices of the last :meth:`refresh`."""
        frames, count = len(state), len(self._index)
        if frames < 2 or not count:
            return
        posed = self.geometry.at(state)
        points = posed.skin[:, self._index]
        local = local_points(points, state.rotation, state.translation)

        def rows(at: slice, index: np.ndarray) -> np.ndarray:
            rotation, some = state.rotation[at], points[at, index]
            axes = np.broadcast_to(rotation.transpose(0, 2, 1)[:, None], (*some.shape, 3))
            by_body = posed.skin_by_body(at, self._index[index], axes)
            by_object = local_by_object(some, rotation, state.translation[at])
            return np.concatenate([by_body, by_object], axis=3)

        self.add_steps(ALL, local, rows, self._weight, self._outlier[self._kept], equations)


def _representatives(holds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose vertices of a patch that represent all of it.

    They have at least a tenth of its largest probability (tuned).

    Args:
        holds: (T - 1, M) probability that each vertex holds the object, times its share.

    Returns:
        Vertices (K,) and their weights (T - 1, K), whose sum is that of the whole patch.
    """
    most = holds.max(axis=0)
    near = np.flatnonzero(most > 0.1 * most.max())
    some = near[np.linspace(0, len(near) - 1, min(len(near), STICK_VERTICES)).round().astype(int)]
    weight = holds[:, some]
    part = np.maximum(weight.sum(axis=1), 0.1 * holds.sum(axis=1))
    share = np.divide(holds.sum(axis=1), part, out=np.zeros(len(holds)), where=part > 0)
    return some, weight * share[:, None]
