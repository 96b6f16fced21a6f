"""Where the joint fit starts: what the two sequential stages, body and object, have found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.artefacts import Artefact
from intercap_core.body.parameters import TRANSL
from intercap_core.joint.constants import UNTRACKED_SIGMA
from intercap_core.joint.problem import Trust
from intercap_core.joint.state import State
from intercap_core.joint.terms.object_data import TrackedPoses

# In the order of `BodyParameters`.
_POSE = (
    "global_orient",
    "body_pose",
    "jaw_pose",
    "leye_pose",
    "reye_pose",
    "left_hand_pose",
    "right_hand_pose",
    "transl",
)


@dataclass(frozen=True)
class Flags:
    """Frames (T,) that a sequential fit has flagged.

    ``filled``: the body was not seen well enough; ``uncertain``: the body is not determined by what
    was seen; ``lost``, ``ambiguous`` and ``carried``: the object track's, where an object is named.
    ``hands`` (T, 2), left and right: the hand is not determined by what was seen, or not fitted at
    all; no reason to flag the frame.
    """

    filled: np.ndarray
    uncertain: np.ndarray
    lost: np.ndarray
    ambiguous: np.ndarray
    carried: np.ndarray
    hands: np.ndarray


@dataclass(frozen=True)
class SequentialFits:
    """One state of body and object, and how far it is to be trusted.

    ``state`` has the mean shape. ``tracked`` is None where there is no object: the track is lost in
    every frame, and the state's poses of the object are NaN. ``joint_sigma`` (T, 55) and
    ``object_sigma`` (T,) are stated standard deviations of positions, metres.
    """

    state: State
    tracked: TrackedPoses | None
    trust: Trust
    flags: Flags
    joint_sigma: np.ndarray
    object_sigma: np.ndarray

    @classmethod
    def read(cls, body: Artefact, track: Artefact, scene: Artefact) -> SequentialFits:
        """Read body_fit.h5, object_track.h5 and, for the cameras' times, scene.h5."""
        state = _state(body, track)
        failed, lost = body["failed"], track["lost"]
        named = bool(track.attributes["object"])
        filled = failed | body["bridged"]
        flags = Flags(
            filled=filled,
            uncertain=body["uncertain"],
            lost=lost & named,
            ambiguous=track["ambiguous"],
            carried=_carried(track),
            hands=_undetermined_hands(body) | filled[:, None],
        )
        resting = track["resting"]
        tracked = None
        if lost.all():
            state = state.without_object()
        else:
            tracked = TrackedPoses.from_track(
                state.rotation,
                state.translation,
                track["covariance"] - track["spread"],
                lost,
                flags.ambiguous,
                resting,
                carried=flags.carried,
                visible=(track["candidate"] >= 0) | np.isfinite(track["depth_residual"]),
                times=scene["times"],
                time_offset=scene["time_offset"],
            )
        sigma = np.sqrt(np.trace(track["covariance"][:, 3:, 3:], axis1=1, axis2=2) / 3)
        return cls(
            state=state,
            tracked=tracked,
            trust=Trust(~failed, ~lost, resting[1:] & resting[:-1]),
            flags=flags,
            joint_sigma=body["joint_sigma"].astype(float),
            object_sigma=np.where(lost | ~np.isfinite(sigma), UNTRACKED_SIGMA, sigma),
        )


def _carried(track: Artefact) -> np.ndarray:
    """Frames (T,) bool whose pose of the object follows from annotated ones alone."""
    return np.asarray(track["carried"] if "carried" in track else np.zeros_like(track["lost"]))


def _undetermined_hands(body: Artefact) -> np.ndarray:
    """Left and right hands (T, 2) bool that the body fit says nothing determines."""
    parts = body.text("part_names")
    hands = [parts.index(f"{side}_hand") for side in ("left", "right")]
    return np.asarray(body["undetermined"][:, hands])


def pose_vector(body: Artefact) -> np.ndarray:
    """Pose and translation (T, 168) of a body_fit or joint artefact."""
    vector = np.concatenate([body[name] for name in _POSE], axis=1).astype(float)
    assert vector.shape[1] == TRANSL.stop
    return vector


def _state(body: Artefact, track: Artefact) -> State:
    """The sequential fits as one state, with the mean shape."""
    vector = pose_vector(body)
    betas = body["betas"].astype(float)
    fitted = ~body["failed"]
    shape = betas[fitted].mean(axis=0) if fitted.any() else betas.mean(axis=0)
    rotation, translation = (track[name].astype(float) for name in ("rotation", "translation"))
    return State(vector, shape, body["expression"].astype(float), rotation, translation)
