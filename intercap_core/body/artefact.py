"""Bodies as the body_fit and joint artefacts hold them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from intercap_core.artefacts import Artefact
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.body.vposer import VPoser
from intercap_core.config import BodyModels

_NAMES = (
    "betas", "expression", "global_orient", "body_pose", "left_hand_pose", "right_hand_pose",
    "jaw_pose", "leye_pose", "reye_pose", "transl",
)  # fmt: skip


def body_path(body_models: BodyModels, gender: str) -> Path | None:
    """The body file for a gender: its own, else the neutral one, else None (the open body)."""
    return getattr(body_models, gender, None) or body_models.neutral


def load_pose_prior(body_models: BodyModels, model: BodyModel) -> VPoser | None:
    """The VPoser that the settings name, on the body's device; None = the open prior.

    Raises UserError for a file that is none, or of another version than named.
    """
    if body_models.vposer is None:
        return None
    version = body_models.vposer_version
    return VPoser.load(body_models.vposer, version, device=model.device, dtype=model.dtype)


def read_parameters(artefact: Artefact) -> BodyParameters:
    """All T frames of a body_fit or joint artefact; one shape has betas (1, S)."""
    values = {
        name: torch.as_tensor(np.atleast_2d(artefact[name]), dtype=torch.float32) for name in _NAMES
    }
    return BodyParameters(**values)


def load_model(body_models: BodyModels, gender: str, parameters: BodyParameters) -> BodyModel:
    """The body that the parameters belong to. Raises UserError for a broken body file."""
    return BodyModel.load(
        body_path(body_models, gender),
        num_betas=parameters.betas.shape[1],
        num_expression=parameters.expression.shape[1],
    )
