"""Stage ``joint``: body, object and contact refined together over all frames (equation 6).

The fit starts from the sequential fits of stages ``body_fit`` and ``object_track``.
:mod:`intercap_core.joint.problem` lists the energy terms.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.annotation import ContactInterval
from intercap_core.body.artefact import put_parameters
from intercap_core.config import digest
from intercap_core.joint.fit import fit
from intercap_core.joint.inputs import open_inputs
from intercap_core.joint.released.artefact import import_joint
from intercap_core.joint.result import Convergence, JointFit
from intercap_core.schemas import CONTACT_REGIONS, JOINT
from intercap_core.sequence_inputs import FitSettings, SequenceModels, SequencePaths

log = logging.getLogger(__name__)


def run(
    *,
    paths: SequencePaths,
    models: SequenceModels,
    fit_settings: FitSettings,
    output: Path,
    contact: Sequence[ContactInterval] | None = None,
    results: Path | None = None,
) -> None:
    """Write joint.h5: a fit that starts from the sequential fits, or imported results.

    Without an object, or if its track is lost in all frames, only the body's terms are minimised.
    Raises UserError if an artefact or the mesh cannot be used.

    Args:
        contact: annotated intervals; None to detect contact from the geometry.
        results: result of another program, imported instead of a fit.
    """
    settings = fit_settings.joint
    if results is not None:
        betas, settings_digest = fit_settings.body_fit.betas, digest(settings)
        import_joint(results, paths, models, output, betas=betas, settings_digest=settings_digest)
        return
    with open_inputs(paths, models, fit_settings) as inputs:
        fitted = fit(inputs, settings, contact)
    for issue in fitted.issues:
        first, last = issue.frames.start, max(issue.frames.start, issue.frames.stop - 1)
        sequence = inputs.attributes["sequence"]
        log.warning("sequence %s, frames %d to %d: %s", sequence, first, last, issue.text)
    with artefacts.write(
        output,
        JOINT,
        settings_digest=digest(settings),
        subject=models.subject.subject,
        object=models.object_.name if models.object_ else "",
        iterations=fitted.steps,
        refused=fitted.refused,
        converged=fitted.convergence == Convergence.CONVERGED,
        last_step_mm=1e3 * fitted.last_step_m,
        last_decrease=fitted.last_decrease,
        cameras_corrected=fitted.cameras_corrected,
        **inputs.attributes,
    ) as writer:
        parameters = fitted.state.parameters(inputs.model)
        with torch.no_grad():
            joints = inputs.model(parameters, vertex_ids=np.array([0])).joints.numpy()
        put_parameters(writer, parameters, joints, betas=fitted.state.betas)
        _put_fit(writer, fitted)
        writer.put("hand_undetermined", inputs.sequential.flags.hands)
        cameras = inputs.cameras
        writer.put("camera_names", list(cameras.now.rig.names))
        writer.put("master_from_colour", cameras.now.rig.master_from_colour)
        writer.put("depth_bias", cameras.now.depth_bias)
        writer.put("camera_covariance", cameras.covariance)
        writer.put("time_offset", inputs.time_offset)
        writer.put("time_offset_sigma", inputs.time_offset_sigma)


def _put_fit(writer: artefacts.Writer, fitted: JointFit) -> None:
    """Write residuals, object, contact, energies and flags."""
    before, after = fitted.energy_before, fitted.energy_after
    names = sorted(before.keys() | after.keys())
    writer.put("keypoint_residual", fitted.residuals.keypoint_px)
    writer.put("cloud_residual", fitted.residuals.cloud_m)
    writer.put("rotation", fitted.state.rotation)
    writer.put("translation", fitted.state.translation)
    writer.put("region_names", CONTACT_REGIONS)
    writer.put("contact_probability", fitted.contact.probability)
    writer.put("contact_annotated", fitted.contact.labels)
    writer.put("energy_names", names)
    writer.put("energy_before", [before.get(name, 0.0) for name in names])
    writer.put("energy_after", [after.get(name, 0.0) for name in names])
    fitted.flags.write(writer)
