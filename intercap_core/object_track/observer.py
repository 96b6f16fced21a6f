"""The images of one recording and the questions that tracking asks of them, frame by frame."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh, Paint
from intercap_core.geometry.rigid.render import Renderer, open_renderer
from intercap_core.object_track.constants import (
    ASSESS_MIN_OVERLAP,
    LOOK_NEAR_M,
    PASS_ROUNDS,
    PASS_SCALE,
)
from intercap_core.object_track.evidence import PoseEvidence, evidence_at
from intercap_core.object_track.fit import (
    Fit,
    MotionPrior,
    assess_all,
    fit_pose,
)
from intercap_core.object_track.motion import carried
from intercap_core.object_track.places import Places
from intercap_core.object_track.search import rank_frames, search
from intercap_core.object_track.view import View
from intercap_core.object_track.view_cache import ViewCache
from intercap_core.progress import Progress

Pictures = Callable[[int], list[np.ndarray | None]]
"""Of frame t the views' images (h, w, 3) uint8 BGR, reduced; None where there is none."""

log = logging.getLogger(__name__)


@dataclass(eq=False)
class Observer:
    """One object in T frames.

    ``load`` gives the views of frame t, one a camera; ``labels_by_view`` [T][C][candidates] the
    labels alone; ``labels`` the classes the object may be given; ``up`` (3,) the vertical;
    ``joints`` (T, K, 3) of the person, NaN unknown, master frame; ``surveyed`` frames in which
    something was seen that may be the object, the most promising first; ``pictures`` the colour
    images, ``paint`` the mesh's own colours, where there are any.
    """

    mesh: ObjectMesh
    load: Callable[[int], list[View]]
    labels_by_view: list[list[list[str]]]
    settings: ObjectTrackSettings
    labels: tuple[str, ...] = ()
    up: np.ndarray | None = None
    joints: np.ndarray | None = None
    pictures: Pictures | None = None
    paint: Paint | None = None
    views: Callable[[int], list[View]] = field(init=False)
    renderer: Renderer = field(init=False)

    def __post_init__(self) -> None:
        self.views = ViewCache(self.load)
        self._progress = Progress(log, f"{self.mesh.name}: fitted", None, "poses")
        self.renderer = open_renderer(self.settings.render_on)

    @property
    def count(self) -> int:
        """Frames, T."""
        return len(self.labels_by_view)

    @cached_property
    def _survey(self) -> tuple[Places, list[int]]:
        return Places.survey(self.mesh, self.views, self.count, self.labels, self.joints)

    @property
    def places(self) -> Places:
        """Where in the room the object may be."""
        return self._survey[0]

    def frames_to_search(self) -> list[int]:
        """All frames, the most promising first."""
        first = self._survey[1]
        known = set(first)
        return first + [t for t in rank_frames(self.labels_by_view, self.labels) if t not in known]

    def promise(self, t: int) -> int:
        """Views of frame t with a candidate that has one of the object's labels, or none."""
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
    ) -> list[Fit]:
        """Fitted hypotheses of frame t, the likeliest first; ``rotations`` (N, 3, 3) are tried, or
        all there are, near ``places`` (M, 3), or anywhere, in ``motion`` (:func:`.search.search`).
        """

        def place_prior(place: np.ndarray) -> float:
            if places is not None and np.linalg.norm(places - place, axis=1).min() > LOOK_NEAR_M:
                return 0.0
            return self.places.prior(t, place)

        return search(
            self.mesh,
            self.field,
            self.views(t),
            labels=self.labels,
            up=self.up,
            min_overlap=self.settings.min_overlap,
            background_term=self.settings.background_term,
            place_prior=place_prior,
            rotations=rotations,
            motion=motion,
            renderer=self.renderer,
        )

    def fit(
        self,
        t: int,
        pose: np.ndarray,
        prior: MotionPrior | None,
        rounds: tuple[int, ...] = PASS_ROUNDS,
        scale: float = PASS_SCALE,
        mesh: ObjectMesh | None = None,
        twist: np.ndarray | None = None,
    ) -> Fit:
        """The pose (4, 4) of frame t fitted from one that is nearly right, of an object that moves
        by ``twist`` (6,); ``mesh`` instead of the object's own."""
        self._progress.step()
        return fit_pose(
            mesh or self.mesh,
            self.views(t),
            pose,
            prior=prior,
            min_overlap=self.settings.min_overlap,
            background_term=self.settings.background_term,
            labels=self.labels,
            rounds=rounds,
            start_scale=scale,
            twist=twist,
            renderer=self.renderer,
        )

    def evidence(self, t: int, pose: np.ndarray, twist: np.ndarray) -> PoseEvidence:
        """What frame t says about a pose (4, 4) of an object that moves by ``twist`` (6,)."""
        return evidence_at(
            self.mesh,
            self.views(t),
            pose,
            min_overlap=self.settings.min_overlap,
            background_term=self.settings.background_term,
            labels=self.labels,
            twist=twist,
            renderer=self.renderer,
        )

    def carried(self, t: int, u: int, pose: np.ndarray) -> np.ndarray:
        """Poses (N, 4, 4) of frame u of what hands may hold at ``pose`` (4, 4) in frame t."""
        if self.joints is None:
            return np.zeros((0, 4, 4))
        centre, radius = self.mesh.centre_at(pose), self.mesh.diameter / 2
        return carried(self.joints[[t, u]], pose, centre, radius)

    def assess(
        self,
        t: int,
        pose: np.ndarray,
        mesh: ObjectMesh | None = None,
        twist: np.ndarray | None = None,
    ) -> Fit:
        """How well a pose (4, 4) agrees with frame t as it is, of an object that moves by ``twist``
        (6,); ``mesh`` instead of the object's."""
        return self.assess_all(t, pose[None], mesh, None if twist is None else twist[None])[0]

    def assess_all(
        self,
        t: int,
        poses: np.ndarray,
        mesh: ObjectMesh | None = None,
        twists: np.ndarray | None = None,
    ) -> list[Fit]:
        """:meth:`assess` of many poses (N, 4, 4) at once, moving by ``twists`` (N, 6)."""
        return assess_all(
            mesh or self.mesh,
            self.views(t),
            poses,
            min_overlap=ASSESS_MIN_OVERLAP,
            labels=self.labels,
            twists=twists,
            renderer=self.renderer,
        )
