"""The energy of a recording, built from its inputs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from intercap_core.config import JointSettings
from intercap_core.joint.cameras import CameraEvidence, Cameras
from intercap_core.joint.inputs import JointInputs
from intercap_core.joint.problem import JointProblem, build_terms
from intercap_core.joint.state import State
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.contact import Contact
from intercap_core.joint.terms.object_data import NoObject, ObjectData
from intercap_core.joint.terms.object_images import ObjectImagesData
from intercap_core.joint.terms.term import TermContext

ObjectTerm = ObjectData | ObjectImagesData | NoObject
"""The term that stands for E_O."""


@dataclass(frozen=True, eq=False)
class Assembly:
    """The energy of a recording, and those of its terms that the fit updates between rounds."""

    problem: JointProblem  # All terms
    body: BodyData  # E_B
    object_: ObjectTerm  # E_O
    contact: Contact | None  # E_C; None without an object
    num_frames: int
    share: float  # Weight of a frame in the correction of the cameras

    def take_cameras(self, cameras: Cameras) -> None:
        """Use these cameras from the next refresh on."""
        self.body.take_cameras(cameras)
        if isinstance(self.object_, ObjectImagesData):
            self.object_.take_cameras(cameras)

    def camera_evidence(self, state: State) -> Iterator[CameraEvidence]:
        """Evidence on the cameras of body and object at ``state``.

        One of the frames with the same errors represents them.
        """
        every = round(1 / self.share)
        self.body.refresh(state, every)
        # the body weighs a twentieth (tuned): errors of keypoints and clothing depend on the view
        # and the pose, and so resemble errors of a camera
        yield self.body.camera_evidence(state, 0.05 * self.share)
        if isinstance(self.object_, ObjectImagesData):
            self.object_.refresh(state, every)
            yield self.object_.camera_evidence(state)

    def contradicted(self) -> np.ndarray:
        """Mask (T,) of frames whose images contradict the object's pose at the last refresh."""
        if isinstance(self.object_, ObjectImagesData):
            return self.object_.contradicted()
        return np.zeros(self.num_frames, bool)


def assemble(inputs: JointInputs, settings: JointSettings) -> Assembly:
    """Build all terms. A floor that the sequential fits contradict is left out.

    E_O compares images, or uses the object track if there are no images. Without an object only
    the body's terms remain.
    """
    sequential, floor = inputs.sequential, inputs.floor
    context = TermContext(
        geometry=inputs.geometry,
        settings=settings,
        start=sequential.state,
        trust=sequential.trust,
        fps=inputs.fps,
        floor=None if inputs.against_floor else floor,
        encoder=inputs.encoder,
        up=floor.normal if floor else None,
    )
    share = min(1.0, 1 / (inputs.fps * 0.3))  # errors of masks and keypoints last 0.3 s; tuned
    object_data: ObjectTerm = NoObject()
    if sequential.tracked is not None:
        object_data = (
            ObjectImagesData(sequential.tracked, inputs.images, share)
            if inputs.images
            else ObjectData(sequential.tracked)
        )
    terms = build_terms(context, (inputs.body_data, object_data))
    return Assembly(
        problem=JointProblem(terms, inputs.threads),
        body=inputs.body_data,
        object_=object_data,
        contact=context.find(Contact) if inputs.geometry.has_object else None,
        num_frames=len(sequential.state),
        share=share,
    )
