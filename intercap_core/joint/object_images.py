"""What the images show of the object, looked at anew through corrected cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import open_renderer
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.joint.cameras import Cameras
from intercap_core.joint.constants import VIEWS_KEPT_BYTES
from intercap_core.object_track.constants import TRACKING_FACES
from intercap_core.object_track.evidence import PoseEvidence, evidence_at, report_at
from intercap_core.object_track.free_turns import free_turns, without_turns
from intercap_core.object_track.recording import ObjectRecording
from intercap_core.object_track.view_cache import ViewCache
from intercap_core.object_track.view_report import ViewReport


class ObjectImages:
    """The views of every moment, as the tracker sees them (equation 1: silhouettes and depth of
    the candidate that fits best, hidden by the person's mask).

    ``cameras`` (V,) places of those with images and a pose among the ``count`` of the rig; ``mesh``
    simplified.
    """

    def __init__(
        self,
        recording: ObjectRecording,
        mesh: ObjectMesh,
        settings: ObjectTrackSettings,
        labels: tuple[str, ...],
        threads: ThreadPool | None = None,
    ) -> None:
        """``threads`` look at a frame each where the CPU draws, None is one."""
        self._recording = recording
        self._views = ViewCache(recording.views, VIEWS_KEPT_BYTES)
        self._geometry = list(recording.geometry)
        self._settings, self._labels = settings, labels
        self._renderer = open_renderer(settings.render_on, threads=1)
        self._threads = ThreadPool()
        if threads is not None and self._renderer.device == "cpu":
            self._threads = threads
        self.mesh, self.cameras = mesh.simplified(TRACKING_FACES), recording.cameras
        self.count = recording.count

    def take_cameras(self, cameras: Cameras) -> None:
        """See through these cameras from now on."""
        self._geometry = [
            given.corrected(
                cameras.rig[c],
                float(np.nan_to_num(cameras.depth_bias[c])),
                given.time_offset_s,
            )
            for c, given in zip(self.cameras, self._geometry, strict=True)
        ]

    def take_offsets(self, time_offset: np.ndarray) -> None:
        """Take the cameras to expose ``time_offset`` (C,) seconds late."""
        self._geometry = [
            given.corrected(given.camera, given.depth_bias_m, float(time_offset[c]))
            for c, given in zip(self.cameras, self._geometry, strict=True)
        ]

    def look(
        self, frames: Sequence[int], poses: np.ndarray, twists: np.ndarray
    ) -> dict[int, PoseEvidence]:
        """What each of ``frames`` says about its pose, of those (T, 4, 4) of an object that moves
        by ``twists`` (T, 6), without what facets seem to say of the turns of a round one."""
        found = self._threads.map(lambda t: self._look(t, poses[t], twists[t]), frames)
        return dict(zip(frames, found, strict=True))

    def compare(
        self, frames: Sequence[int], poses: np.ndarray, twists: np.ndarray, camera: np.ndarray
    ) -> dict[int, ViewReport]:
        """How the one ``camera`` (T,) of each of ``frames`` agrees with its pose, of those (T, 4,
        4) of an object that moves by ``twists`` (T, 6), where it has an image and a pose."""
        place = {c: number for number, c in enumerate(self.cameras)}
        shown = [t for t in frames if int(camera[t]) in place]

        def one(t: int) -> ViewReport:
            number = place[int(camera[t])]
            kept = self._views.kept(t)
            view = self._recording.view(t, number) if kept is None else kept[number]
            return report_at(
                self.mesh,
                view.through(self._geometry[number]),
                poses[t],
                min_overlap=self._settings.min_overlap,
                labels=self._labels,
                twist=twists[t],
                renderer=self._renderer,
            )

        return dict(zip(shown, self._threads.map(one, shown), strict=True))

    def _look(self, t: int, pose: np.ndarray, twist: np.ndarray) -> PoseEvidence:
        views = [
            view.through(geometry)
            for view, geometry in zip(self._views(t), self._geometry, strict=True)
        ]
        found = evidence_at(
            self.mesh,
            views,
            pose,
            min_overlap=self._settings.min_overlap,
            background_term=self._settings.background_term,
            labels=self._labels,
            twist=twist,
            renderer=self._renderer,
        )
        turns = free_turns(self.mesh, pose)
        depth = without_turns(found.of_depth, found.depth_gradient, turns)
        contour = without_turns(
            found.information - found.of_depth, found.gradient - found.depth_gradient, turns
        )
        return PoseEvidence(
            depth[0] + contour[0], depth[1] + contour[1], depth[0], depth[1], found.reports
        )

    def rays(self, place: np.ndarray) -> np.ndarray:
        """By how much (V, 3), metres, what is at ``place`` (3,) seems farther to each camera, for
        a metre of depth."""
        poses = np.array(
            [
                geometry.master_from_depth if geometry.camera.depth else geometry.master_from_colour
                for geometry in self._geometry
            ]
        )
        away = place - poses[:, :3, 3]
        return away / (away * poses[:, :3, 2]).sum(axis=1, keepdims=True)

    def centres(self) -> np.ndarray:
        """(V, 3) of the cameras, master frame."""
        return np.array([geometry.master_from_colour[:3, 3] for geometry in self._geometry])
