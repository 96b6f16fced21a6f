"""A measured capture with a moving body, and its exports."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.body.artefact import read_parameters
from intercap_core.body.model import BodyModel
from intercap_core.config import ExportSettings, MetricsSettings
from intercap_core.output.export.about import About, ExportBody, Verdict
from intercap_core.output.export.motion import Motion
from intercap_core.schemas import JOINT
from intercap_core.stage_list import STAGES
from intercap_core.stages import export, metrics
from tests.helpers import fitted_capture as fitted

NUM_COMPONENTS = 12  # of a hand's pose, as the InterCap release has them


def measured_capture(folder: Path, object_name: str = "cup") -> fitted.Capture:
    """A capture of a person with an object, up to metrics."""
    made = fitted.make_capture(folder, object_name=object_name)
    metrics.run(
        paths=made.inputs(*STAGES["metrics"].reads),
        output=made.paths["metrics"],
        models=made.models,
        settings=MetricsSettings(),
        fit_settings=fitted.FIT_SETTINGS,
    )
    return made


def run(capture: fitted.Capture, output: Path, **settings: Any) -> Path:
    """Export the capture into ``output``, which is returned."""
    export.run(
        paths=capture.inputs(*STAGES["export"].reads),
        models=capture.models,
        settings=ExportSettings(**settings),
        output=output,
    )
    return output


def plain_about(motion: Motion) -> About:
    """Return facts without flags, contact and verdict."""
    total = len(motion)
    verdict = Verdict((), np.zeros((0, total)), ())
    return About("cap", ExportBody.of(motion.model, "neutral"), [""] * total, None, verdict)


def changed(capture: fitted.Capture, stage: str, folder: Path) -> tuple[fitted.Capture, Path]:
    """The capture with a copy of one artefact in ``folder``, to be changed."""
    folder.mkdir(exist_ok=True)
    path = Path(shutil.copy(capture.paths[stage], folder / f"{stage}.h5"))
    return replace(capture, paths=capture.paths | {stage: path}), path


def lively(capture: fitted.Capture, folder: Path) -> fitted.Capture:
    """The capture with another joint result: every joint turned, a face that moves, hands within
    the first components of their pose space, and an object that turns."""
    made, path = changed(capture, "joint", folder)
    rng = np.random.default_rng(4)
    model = capture.model
    with h5py.File(path, "r+") as file:
        total = len(file["transl"])
        file["betas"][...] = rng.normal(0, 1, file["betas"].shape)
        file["expression"][...] = rng.normal(0, 1.5, file["expression"].shape)
        for name in ("global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose"):
            file[name][...] += rng.normal(0, 0.2, file[name].shape)
        for side, name in enumerate(("left_hand_pose", "right_hand_pose")):
            code = rng.normal(0, 0.5, (total, NUM_COMPONENTS))
            basis = model.hand_components[side, :NUM_COMPONENTS].numpy()
            file[name][...] = model.hand_mean[side].numpy() + code @ basis
        file["rotation"][...] = Rotation.random(total, random_state=5).as_matrix()
    with artefacts.read(path, JOINT) as joint:
        joints = posed(model, joint)[1]
    with h5py.File(path, "r+") as file:
        file["joints"][...] = joints
    return made


def posed(model: BodyModel, joint: artefacts.Artefact) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (T, V, 3) and joints (T, 55, 3) of a joint artefact, master frame."""
    with torch.no_grad():
        out = model.forward(read_parameters(joint))
    return out.vertices.numpy(), out.joints.numpy()
