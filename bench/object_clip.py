"""Some frame sets of a recording, in memory, as the object's tracker sees them, and their truth.

Reads the artefacts of the stages before ``object_track``; what is decoded here is not timed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.errors import UserError
from intercap_core.evaluation import object_pose
from intercap_core.evaluation.truth import Truth
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.twist import moved
from intercap_core.object_track.constants import TRACKING_FACES
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.recording import ObjectRecording
from intercap_core.object_track.tracker import Tracker
from intercap_core.object_track.view import View
from intercap_core.project import Project

# Of an annotated pose: turn (rad) and shift (m), as large as the evaluation's annotations are wrong
ANNOTATION_ERROR = np.concatenate([np.radians(5) * np.ones(3), 0.010 * np.ones(3)]) / np.sqrt(3)
SEEN_VIEWS = 2  # frames that fewer truly see are not counted, as in the evaluation


@dataclass(frozen=True, eq=False)
class ObjectClip:
    """T consecutive frame sets with C views each.

    ``whole`` is the object's mesh, ``mesh`` the one that is tracked; ``true_rotation`` (T, 3, 3),
    ``true_translation`` (T, 3) and ``true_views`` (T,) are of the recording's truth.
    """

    whole: ObjectMesh
    mesh: ObjectMesh
    views: list[list[View]]
    times: np.ndarray
    up: np.ndarray | None
    joints: np.ndarray
    labels: tuple[str, ...]
    settings: ObjectTrackSettings
    true_rotation: np.ndarray
    true_translation: np.ndarray
    true_views: np.ndarray

    @classmethod
    def load(cls, project: Project, sequence: str, count: int) -> ObjectClip:
        """The first ``count`` frame sets from the first that shows the object well.

        Raises UserError where the sequence has no truth or an artefact is missing.
        """
        row = project.sequences[sequence]
        if row.truth is None:
            raise UserError(f"sequence {sequence} has no truth; measure a virtual recording")
        entry = project.objects[row.object]
        whole = ObjectMesh.load(entry)
        with Frames.open(project.artefact(sequence, "frames")) as frames:
            source = ObjectRecording(
                frames,
                Detections.load(project.artefact(sequence, "detections")),
                project.artefact(sequence, "scene"),
                project.artefact(sequence, "person"),
                whole.diameter,
            )
            truth = Truth.load(row.truth, frames.time_s, frames.fps, 0)
            first = int(np.argmax(truth.object_views >= SEEN_VIEWS))
            kept = slice(first, min(first + count, frames.num_sets))
            views = [source.views(t) for t in range(kept.start, kept.stop)]
            return cls(
                whole,
                whole.simplified(TRACKING_FACES),
                views,
                frames.time_s[kept],
                source.up if np.isfinite(source.up).all() else None,
                source.joints[kept],
                entry.labels,
                project.config.object_track,
                truth.rotation[kept],
                truth.translation[kept],
                truth.object_views[kept],
            )

    def __len__(self) -> int:
        return len(self.views)

    @property
    def annotated(self) -> np.ndarray:
        """The first frame's pose (4, 4) as a person might set it: off by 10 mm and 5 degrees."""
        pose = rigid(self.true_rotation[0], self.true_translation[0])
        return moved(pose, ANNOTATION_ERROR)

    @property
    def step_s(self) -> float:
        """Seconds between frames."""
        return float(np.median(np.diff(self.times)))

    def tracker(self) -> Tracker:
        """The project's tracker on these frames."""
        return Tracker(
            self.mesh,
            self.views.__getitem__,
            self._labels_by_view,
            self.settings,
            times=self.times,
            labels=self.labels,
            up=self.up,
            joints=self.joints,
        )

    def observer(self) -> Observer:
        """What the tracker asks of the images, for one pass of it."""
        return Observer(
            self.mesh,
            self.views.__getitem__,
            self._labels_by_view,
            self.settings,
            self.labels,
            self.up,
            self.joints,
        )

    @cached_property
    def _labels_by_view(self) -> list[list[list[str]]]:
        return [[[k.label for k in view.candidates] for view in views] for views in self.views]

    def errors(self, poses: np.ndarray, frames: np.ndarray | int) -> tuple[np.ndarray, np.ndarray]:
        """Errors of poses (..., 4, 4) in the given frame or frames: millimetres, degrees (...)."""
        centre = self.whole.centre_of_mass
        rotation = np.broadcast_to(self.true_rotation[frames], (*poses.shape[:-2], 3, 3))
        apart = object_pose.centre_error(
            object_pose.posed_point(poses[..., :3, :3], poses[..., :3, 3], centre),
            object_pose.posed_point(rotation, self.true_translation[frames], centre),
        )
        turned = object_pose.rotation_error_deg(poses[..., :3, :3], rotation, self.mesh.symmetry)
        return 1e3 * apart, turned

    @cached_property
    def seen(self) -> np.ndarray:
        """Frames (T,) bool that count: enough views truly see the object."""
        return self.true_views >= SEEN_VIEWS
