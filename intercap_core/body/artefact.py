"""Bodies in the body_fit and joint artefacts."""

from __future__ import annotations

import hashlib
from dataclasses import fields
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np
import torch

from intercap_core.artefacts import Artefact, Writer
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.body.vposer import VPoser
from intercap_core.config import BodyModels
from intercap_core.errors import UserError

# Cache of bodies by file and digest, and numbers of betas and expression coefficients. An
# entry lives as long as the body is referenced, so a stage that reads several artefacts loads once.
_LOADED: WeakValueDictionary[tuple[str, int, int], BodyModel] = WeakValueDictionary()


def file_digest(path: Path) -> str:
    """Return the digest of a body file that is stored in artefacts of fitted bodies."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def load_pose_prior(body_models: BodyModels, model: BodyModel) -> VPoser | None:
    """Load the VPoser of the settings on the body's device; None = the open prior.

    Raises UserError if the file is invalid or of another version than the settings name.
    """
    if body_models.vposer is None:
        return None
    version = body_models.vposer_version
    return VPoser.load(body_models.vposer, version, device=model.device, dtype=model.dtype)


def read_parameters(artefact: Artefact) -> BodyParameters:
    """Read all T frames of a body_fit or joint artefact; a shared shape has betas (1, S)."""
    names = [field.name for field in fields(BodyParameters)]
    arrays = (np.atleast_2d(artefact[name]) for name in names)
    tensors = (torch.as_tensor(array, dtype=torch.float32) for array in arrays)
    return BodyParameters(**dict(zip(names, tensors, strict=True)))


def put_parameters(
    writer: Writer, parameters: BodyParameters, joints: np.ndarray, *, betas: np.ndarray
) -> None:
    """Write the bodies of a body_fit or joint artefact.

    Args:
        parameters: T frames; their betas are not written.
        joints: (T, 55, 3) posed joints.
        betas: (T, S), or (S,) of a shared shape.
    """
    writer.put("betas", betas)
    for name in (field.name for field in fields(BodyParameters) if field.name != "betas"):
        writer.put(name, getattr(parameters, name).cpu().numpy())
    writer.put("joints", joints)


def load_model(body_models: BodyModels, gender: str, artefact: Artefact) -> BodyModel:
    """Load the body that a body_fit or joint artefact was fitted with.

    Raises UserError if the body file is damaged or the settings name another file.
    """
    path = body_models.of(gender) or OPEN_BODY
    digest = file_digest(path) if path.is_file() else ""
    betas, expression = artefact["betas"].shape[-1], artefact["expression"].shape[-1]
    key = (f"{path} {digest}", betas, expression)
    model = _LOADED.get(key)
    if model is None:
        _LOADED[key] = model = BodyModel.load(path, num_betas=betas, num_expression=expression)
    attributes = artefact.attributes
    if digest != attributes["body_model"]:
        raise UserError(
            f"{artefact.path}: the bodies of sequence {attributes['sequence']!r} were fitted "
            f"with another body file than {path}, which the settings give for a {gender} subject; "
            "name that file again, or re-run stage 'body_fit' and what follows"
        )
    return model
