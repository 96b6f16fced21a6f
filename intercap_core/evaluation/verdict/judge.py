"""The verdict on one sequence: an estimate of its errors without truth.

It has the errors in cameras held out of the fit (:mod:`.hold_out`), and one stated error for each
of body, hands and object (:mod:`.stated`).
"""

from __future__ import annotations

import logging

import numpy as np

from intercap_core import artefacts
from intercap_core.body.joints import BOTH_HANDS, JOINT_INDEX
from intercap_core.evaluation.verdict.hold_out import JudgedPart, JudgedPoints, hold_out
from intercap_core.evaluation.verdict.stated import FEATURES, estimate_error
from intercap_core.joint.inputs import open_inputs
from intercap_core.joint.result import JointResult
from intercap_core.joint.sequential import SequentialFits
from intercap_core.schemas import SCENE
from intercap_core.sequence_inputs import FitSettings, SequenceModels, SequencePaths

log = logging.getLogger(__name__)

_WRISTS = [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]]

Values = dict[str, np.ndarray | list[str]]


def reach_verdict(
    paths: SequencePaths, models: SequenceModels, fit_settings: FitSettings
) -> Values:
    """Evaluate the joint artefact with the inputs of the joint stage; no truth is read.

    Returns the datasets ``verdict/...`` of the metrics artefact by name, without the prefix. Those
    of single cameras are omitted if fewer than two cameras show the person. Raises UserError if an
    artefact or the mesh cannot be used.
    """
    with artefacts.read(paths.scene, SCENE) as source:
        result = JointResult.read(paths.joint, source)
        cameras = source.text("camera_names")
    with open_inputs(paths, models, fit_settings) as inputs:
        held = hold_out(inputs, fit_settings.joint, result)
        sequential = inputs.sequential
        weights = JudgedPoints(inputs).weights
    parts = list(weights)
    estimates = [
        estimate_error(
            held,
            part,
            start_sigma(sequential, part, weights[part]),
            _known(sequential, result, part),
        )
        for part in parts
    ]
    for part, estimate in zip(parts, estimates, strict=True):
        if estimate.silent:
            log.warning("%s: error cannot be estimated: %s", part, estimate.silent)
            continue
        error, factor = 1e3 * estimate.error, estimate.factor
        low, high = error / factor, error * factor
        log.info("%s: estimated error %.1f mm (%.1f to %.1f)", part, error, low, high)
    values: Values = {
        "part_names": [str(part) for part in parts],
        "feature_names": list(FEATURES),
        "features": np.stack([s.features for s in estimates]),
        "error": np.array([s.error for s in estimates]),
        "error_factor": np.array([s.factor for s in estimates]),
        "error_frame": np.stack([s.by_frame for s in estimates]),
        "silent": [s.silent for s in estimates],
        "camera_names": cameras,
    }
    if held is None:
        return values
    shift = np.full((len(parts), len(cameras), len(result.state)), np.nan)
    for place, part in enumerate(parts):
        shift[place, held.cameras] = held.shift[part]
    values |= {
        "held_camera": held.camera_index,
        "shift": shift,
        "repeated": np.stack([held.repeated[part] for part in parts]),
    }
    for name, within in vars(held.all_cameras).items():
        values[name] = within
        values[f"{name}_held_out"] = getattr(held.held_out, name)
    return values


def start_sigma(fits: SequentialFits, part: JudgedPart, weights: np.ndarray) -> np.ndarray:
    """Standard deviation in space (T,) of a part that the sequential fits state, metres.

    Fingers have the errors of the smoothed hand, at which the joint fit starts, and of the wrist.
    """
    if part == JudgedPart.OBJECT:
        return np.sqrt(3) * fits.object_sigma
    variance = fits.joint_sigma**2
    hands = fits.hand_sigma**2 + variance[:, _WRISTS]
    variance[:, BOTH_HANDS] = np.repeat(hands, 15, axis=1)
    return np.sqrt(3 * variance @ weights)


def _known(fits: SequentialFits, result: JointResult, part: JudgedPart) -> np.ndarray:
    """Mask (T,) of the frames in which the part was measured, not filled in, and neither images nor
    the other part contradict the joint fit."""
    flags = fits.flags
    if part == JudgedPart.OBJECT:
        return ~(flags.lost | flags.carried | result.contradicted | result.penetrating)
    return ~(flags.filled | result.penetrating)
