"""One recording of one object, with the searches, fits and comparisons of its frames."""

from __future__ import annotations

import logging
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh, Paint
from intercap_core.geometry.rigid.render import Renderer
from intercap_core.geometry.solve.thread_pool import threads_of_job
from intercap_core.object_track.evidence import ERROR_LASTING_S, ImageEvidence, evidence_at
from intercap_core.object_track.fit import AT_REST, FittedPose, MotionPrior, assess_all, fit_pose
from intercap_core.object_track.motion import estimate_hand_motions
from intercap_core.object_track.places import Places
from intercap_core.object_track.search import rank_frames, search_pose
from intercap_core.object_track.view import FitContext, View
from intercap_core.progress import Progress

Pictures = Callable[[int], list[np.ndarray | None]]
"""Returns the reduced colour images (h, w, 3) uint8 BGR of frame t, None without an image."""

log = logging.getLogger(__name__)


@dataclass(eq=False)
class Observer:
    """One object in T frames of one recording."""

    mesh: ObjectMesh
    """Mesh that is rendered."""
    views: Callable[[int], list[View]]
    """Returns the views of frame t, one per camera. It is called often, so that they are cached."""
    labels_by_view: list[list[list[str]]]
    """Labels of the candidates, [T][C][candidates]."""
    settings: ObjectTrackSettings
    """Settings of stage ``object_track``."""
    times: np.ndarray
    """(T,) of the frames, seconds."""
    joints: np.ndarray
    """(T, K, 3) of the person, master frame, NaN where unknown."""
    labels: tuple[str, ...] = ()
    """Detector classes of the object; empty: any but a person."""
    up: np.ndarray | None = None
    """(3,) vertical in the master frame."""
    pictures: Pictures | None = None
    """Colour images of the views."""
    paint: Paint | None = None
    """Colours of the mesh."""

    def __post_init__(self) -> None:
        self._progress = Progress(log, f"{self.mesh.name}: fitted", None, "poses")

    @cached_property
    def context(self) -> FitContext:
        """Object and settings of all fits."""
        settings, renderer = self.settings, Renderer(threads_of_job())
        return FitContext(
            self.mesh, self.labels, settings.min_overlap, settings.background_term, renderer
        )

    @property
    def count(self) -> int:
        """Number of frames, T."""
        return len(self.labels_by_view)

    @cached_property
    def step_s(self) -> float:
        """Median time between frames, seconds."""
        return float(np.median(np.diff(self.times))) if self.count > 1 else ERROR_LASTING_S

    @cached_property
    def share(self) -> float:
        """Independent observations per frame, at most 1: errors last ``ERROR_LASTING_S``."""
        return min(1.0, self.step_s / ERROR_LASTING_S)

    def frames_in(self, seconds: float) -> int:
        """Return the number of frames in ``seconds``, at least 1."""
        return max(1, round(seconds / self.step_s))

    @cached_property
    def _survey(self) -> tuple[Places, list[int]]:
        return Places.survey(self.mesh, self.views, self.count, self.labels, self.joints)

    @property
    def places(self) -> Places:
        """Prior of positions in the room."""
        return self._survey[0]

    def frames_to_search(self) -> list[int]:
        """Return all frames, the most promising first."""
        ranked = rank_frames(self.labels_by_view, self.labels)
        return list(dict.fromkeys([*self._survey[1], *ranked]))

    def count_promising_views(self, t: int) -> int:
        """Count the views of frame t with a candidate that has no label or one of the object."""
        return sum(
            any(label in self.labels or not label or not self.labels for label in view)
            for view in self.labels_by_view[t]
        )

    @cached_property
    def field(self) -> DistanceField:
        """Distances to the object's surface."""
        mesh = self.mesh
        return DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight, threads=1)

    def search(
        self,
        t: int,
        rotations: np.ndarray | None = None,
        places: np.ndarray | None = None,
        motion: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> list[FittedPose]:
        """Search the pose of frame t.

        Args:
            t: frame.
            rotations, motion: as in :func:`.search.search_pose`.
            places: (M, 3) positions within 75 cm of which to search; None = everywhere.

        Returns:
            Fitted hypotheses, the likeliest first.
        """

        def place_prior(place: np.ndarray) -> float:
            if places is not None and np.linalg.norm(places - place, axis=1).min() > 0.75:
                return 0.0
            return self.places.prior(t, place)

        return search_pose(
            self.context, self.field, self.views(t),
            up=self.up, place_prior=place_prior, rotations=rotations, motion=motion,
        )  # fmt: skip

    def fit(
        self,
        t: int,
        pose: np.ndarray,
        prior: MotionPrior | None,
        rounds: tuple[int, ...] = (3, 3),
        scale: float = 0.5,
        twist: np.ndarray = AT_REST,
    ) -> FittedPose:
        """Fit the pose (4, 4) of frame t.

        Arguments are those of :func:`.fit.fit_pose`, with defaults for a start at the pose of a
        neighbouring frame.
        """
        self._progress.step()
        return fit_pose(
            self.context, self.views(t), pose,
            prior=prior, rounds=rounds, start_scale=scale, twist=twist,
        )  # fmt: skip

    def evidence(self, t: int, pose: np.ndarray, twist: np.ndarray) -> ImageEvidence:
        """Evaluate the images of frame t as a quadratic form of small motions of ``pose`` (4, 4).

        ``twist`` (6,) is the object's motion per second.
        """
        return evidence_at(self.context, self.views(t), pose, twist)

    def carried(self, t: int, u: int, pose: np.ndarray) -> np.ndarray:
        """Predict poses (N, 4, 4) of frame u from ``pose`` (4, 4) of frame t, one per near hand."""
        centre, radius = self.mesh.centre_at(pose), self.mesh.diameter / 2
        poses = [
            hand.carry(pose)
            for hand in estimate_hand_motions(self.joints[[t, u]])
            if hand is not None and hand.reaches(centre, radius)
        ]
        return np.array(poses).reshape(-1, 4, 4)

    def assess(self, t: int, pose: np.ndarray, twist: np.ndarray = AT_REST) -> FittedPose:
        """Compare a pose (4, 4) with frame t without a fit; arguments as in :meth:`fit`."""
        return self.assess_all(t, pose[None], twist[None])[0]

    def assess_all(
        self, t: int, poses: np.ndarray, twists: np.ndarray | None = None
    ) -> list[FittedPose]:
        """Compare many poses (N, 4, 4), moving by ``twists`` (N, 6), with frame t at once."""
        return assess_all(self.context, self.views(t), poses, twists)

    def with_mesh(self, mesh: ObjectMesh) -> Observer:
        """Return the same recording with another mesh that is fitted and compared."""
        other = copy(self)
        other.mesh, other.context = mesh, replace(self.context, mesh=mesh)
        return other
