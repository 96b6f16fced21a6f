"""Flags of the joint fit: frames and parts that are not to be trusted, each with its reason."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.flags import OF_BODY, OF_OBJECT, PARTS, Cause, Flags
from intercap_core.joint.contact.annotated import AnnotationIssue
from intercap_core.joint.inputs import JointInputs
from intercap_core.joint.result import BODY_INSIDE, CARRIED, CONTRADICTED, OBJECT_INSIDE
from intercap_core.joint.state import State


@dataclass(frozen=True)
class FrameFaults:
    """Masks (T,) of frames with a fault of the fit."""

    stalled: np.ndarray  # No step moved the frame
    against_images: np.ndarray  # Its images contradict the object's final pose
    deep: np.ndarray  # Skin is deep inside the object
    sunk: np.ndarray  # The object is deep inside the body

    @classmethod
    def of(
        cls, inputs: JointInputs, state: State, stalled: np.ndarray, against_images: np.ndarray
    ) -> FrameFaults:
        """The faults of the final ``state``."""
        deep = sunk = np.zeros(len(state), bool)
        if inputs.geometry.has_object:
            posed = inputs.geometry.at(state)
            limit = 0.03  # m, far more than skin yields: one pose is wrong; tuned on the studio
            deep = posed.proximity.distance.min(axis=1) < -limit
            sunk = posed.object_depth(inputs.threads) > limit
        return cls(stalled, against_images, deep, sunk)


def fit_flags(inputs: JointInputs, faults: FrameFaults, issues: Sequence[AnnotationIssue]) -> Flags:
    """Flags of all frames. Only poses that were measured are flagged for penetration."""
    flags, every = inputs.sequential.flags, np.ones(len(faults.stalled), bool)
    lost = "object lost, filled in" if inputs.geometry.has_object else "object found in no frame"
    causes: list[Cause] = [
        (flags.filled, "body not seen well enough, filled in", OF_BODY),
        (flags.uncertain, "body not determined by what was seen", OF_BODY),
        (flags.hands[:, 0], "left hand not determined by what was seen", ["hands"]),
        (flags.hands[:, 1], "right hand not determined by what was seen", ["hands"]),
        (flags.lost, lost, OF_OBJECT),
        (flags.ambiguous & flags.carried, CARRIED, OF_OBJECT),
        (flags.ambiguous & ~flags.carried, "object pose ambiguous", OF_OBJECT),
    ]
    for inside, reason in ((faults.deep, BODY_INSIDE), (faults.sunk, OBJECT_INSIDE)):
        causes += [
            (inside & ~flags.lost, reason, OF_BODY),
            (inside & ~flags.filled, reason, OF_OBJECT),
        ]
    frames = np.arange(len(every))
    causes += [
        *(
            (np.isin(frames, list(issue.frames)), issue.text, ["contact"])
            for issue in issues
            if issue.distrusted
        ),
        (faults.stalled, "no step of the joint fit lowered its energy", PARTS),
        (faults.against_images, CONTRADICTED, OF_OBJECT),
        (every & bool(inputs.against_floor), inputs.against_floor, PARTS),
    ]
    has_object = inputs.geometry.has_object or bool(flags.lost.any())
    return Flags.of(len(every), causes, has_object=has_object)
