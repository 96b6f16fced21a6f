"""A measured capture with a moving body, and its exports."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import torch
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.body.artefact import read_parameters
from intercap_core.body.model import BodyModel
from intercap_core.config import ExportSettings
from intercap_core.entries import ObjectEntry
from intercap_core.flags import Flags
from intercap_core.inputs.arrays import read_pickle
from intercap_core.output.export.about import About, ExportBody, Verdict
from intercap_core.output.export.format import Content
from intercap_core.output.export.motion import Motion
from intercap_core.output.export.silhouettes import Scenes
from intercap_core.schemas import JOINT
from intercap_core.stage_list import STAGES
from intercap_core.stages import export
from tests.helpers import fitted_capture as fitted

NAME = "s01_o09"  # of the exported capture
NUM_COMPONENTS = 12  # of a hand's pose, as the InterCap release has them


def run(capture: fitted.Capture, output: Path, **settings: Any) -> Path:
    """Export the capture into ``output``, which is returned."""
    export.run(
        paths=capture.inputs(*STAGES["export"].reads),
        models=capture.models,
        settings=ExportSettings(**settings),
        output=output,
    )
    return output


def stated(folder: Path) -> dict[str, dict[str, Any]]:
    """What the files of all formats state about their numbers, by format and file."""
    found: dict[str, dict[str, Any]] = {}
    for name in ("amass/body", "amass/object", "intercap/res"):
        with np.load(folder / f"{name}.npz") as file:
            arrays = {key: file[key] for key in file.files}
        found[name] = {key: value if value.ndim else value.item() for key, value in arrays.items()}
    found["intercap"] = read_pickle(folder / "intercap" / "res.pkl")["about"]
    for name in ("bop", "meshes"):
        found[name] = json.loads((folder / name / "about.json").read_text())
    found["coco"] = json.loads((folder / "coco" / "annotations.json").read_text())["info"]
    found["glb"] = pygltflib.GLTF2().load(str(folder / "glb" / f"{NAME}.glb")).asset.extras
    return found


def plain_about(motion: Motion) -> About:
    """Return facts without flags, contact and verdict."""
    total = len(motion)
    verdict = Verdict((), np.zeros((0, total)), ())
    return About(NAME, ExportBody.of(motion.model, "neutral"), Flags.of(total, []), None, verdict)


def content(scenes: Scenes, object_: ObjectEntry, **settings: Any) -> Content:
    """What the writers of formats get, without facts about the frames; the master is z-up."""
    return Content(
        scenes.motion, np.eye(4), scenes.motion, ExportSettings(**settings),
        plain_about(scenes.motion), scenes, scenes.rig, object_,
    )  # fmt: skip


def lively(capture: fitted.Capture, folder: Path) -> fitted.Capture:
    """The capture with another joint result: every joint turned, a face that moves, hands within
    the first components of their pose space, and an object that turns."""
    made = capture.copied(folder, "joint")
    rng = np.random.default_rng(4)
    model = capture.model
    with made.edit("joint") as file:
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
    with artefacts.read(made.paths["joint"], JOINT) as joint:
        joints = posed(model, joint)[1]
    with made.edit("joint") as file:
        file["joints"][...] = joints
    return made


def posed(model: BodyModel, joint: artefacts.Artefact) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (T, V, 3) and joints (T, 55, 3) of a joint artefact, master frame."""
    with torch.no_grad():
        out = model.forward(read_parameters(joint))
    return out.vertices.numpy(), out.joints.numpy()
