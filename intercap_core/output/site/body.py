"""The page's section on one body's fit: its evidence, and the stated deviation of every joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.body.joints import JOINT_NAMES
from intercap_core.errors import UserError
from intercap_core.evaluation.body import BODY_JOINTS, FINGER_JOINTS
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.output.site import charts
from intercap_core.output.site.body_pictures import (
    FIT_COLOUR,
    KEYPOINT_COLOUR,
    PosedBody,
    body_sheet,
)
from intercap_core.output.site.overlays import choose_frames
from intercap_core.output.site.sheets import Sheet
from intercap_core.schemas import BODY_FIT, PERSON, SCENE
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

GOOD_PX = 8.0  # a view agrees up to this median error, at 1080 rows
_ROWS = 4  # moments of the sheet
_LEAST_MM = 10.0  # height of the charts at least
VIEW_STATES = {
    "agrees": f"keypoints within {GOOD_PX:g} px of 1080 rows",
    "partly": "further off",
    "nothing": "person not seen",
}
FIT_STATES = {
    "moving": "fitted",
    "doubtful": "not determined by what was seen",
    "lost": "not fitted: bridged between its neighbours",
}


@dataclass(frozen=True, eq=False)
class BodyFacts:
    """One body's fit, NaN = not known.

    ``pixels`` (T, C) median errors of the keypoints, and ``rows`` (C,) of each camera's image;
    ``cloud_mm`` (T,) median distance of the person's points; ``sigma_mm`` (T, 55) stated deviation
    of the joints; ``state`` (T,) of FIT_STATES.
    """

    name: str
    subject: str
    cameras: list[str]
    rows: np.ndarray
    pixels: np.ndarray
    cloud_mm: np.ndarray
    sigma_mm: np.ndarray
    state: list[str]
    sheet: Sheet | None
    note: str = ""


def read_fit(paths: SequencePaths, models: SequenceModels) -> BodyFacts:
    """Read and draw one fit. What cannot be drawn is left out, with its reason in ``note``.

    Raises UserError as :func:`artefacts.read` does.
    """
    with artefacts.read(paths.scene, SCENE) as setting:
        rig, image_of = Rig.from_artefact(setting), setting["image_of"]
    with artefacts.read(paths.person, PERSON) as people:
        detected = people["keypoints"]
    with artefacts.read(paths.body_fit, BODY_FIT) as fit:
        parameters = read_parameters(fit)
        worst = fit["joint_sigma"][:, BODY_JOINTS].max(1)
        shown = choose_frames(worst, _ROWS)
        model = load_model(models.body_models, models.gender, fit)
        with torch.no_grad():
            posed = model.forward(parameters.frames(torch.tensor(shown)))
            points = model.keypoints(posed).double().numpy()
        vertices = posed.vertices.double().numpy()
        bodies = {t: PosedBody(vertices[i], points[i]) for i, t in enumerate(shown)}
        sheet, note = None, ""
        try:
            with Frames.open(paths.frames) as images:
                faces = model.faces.numpy()
                sheet = body_sheet(images.showing(image_of), rig, bodies, faces, detected)
        except UserError as error:  # one unreadable image must not prevent the report
            note = str(error)
        untrusted = fit["failed"] | fit["bridged"]
        return BodyFacts(
            name=str(fit.attributes["sequence"]),
            subject=str(fit.attributes["subject"]),
            cameras=list(rig.names),
            rows=np.array([camera.colour.height for camera in rig]),
            pixels=fit["keypoint_residual"],
            cloud_mm=1e3 * fit["cloud_residual"],
            sigma_mm=1e3 * fit["joint_sigma"],
            state=[
                "lost" if bad else "doubtful" if unsure else "moving"
                for bad, unsure in zip(untrusted, fit["uncertain"], strict=True)
            ],
            sheet=sheet,
            note=note,
        )


def context(facts: BodyFacts) -> dict[str, Any]:
    """What the template needs; the sheet is left as it is."""
    bridged, unsure = facts.state.count("lost"), facts.state.count("doubtful")
    doubts = [f"{n} {word}" for n, word in ((bridged, "bridged"), (unsure, "doubtful")) if n]
    beside = ", ".join(doubts) or "no frame in doubt"
    if np.isfinite(facts.cloud_mm).any():
        beside += f" · points {np.nanmedian(facts.cloud_mm):.1f} mm off"
    rows = [charts.StateRow("fit", charts.state_runs(facts.state, FIT_STATES), beside)]
    for c, name in enumerate(facts.cameras):
        pixels = facts.pixels[:, c]
        seen = np.isfinite(pixels)
        limit = GOOD_PX * facts.rows[c] / 1080
        states = [
            "nothing" if not there else "agrees" if value <= limit else "partly"
            for there, value in zip(seen, pixels, strict=True)
        ]
        said = f"{100 * seen.mean():.0f} % seen"
        said += f" · {np.median(pixels[seen]):.1f} px" if seen.any() else ""
        rows.append(charts.StateRow(name, charts.state_runs(states, VIEW_STATES), said))
    return {
        "name": facts.name,
        "subject": facts.subject,
        "sheet": facts.sheet,
        "note": facts.note,
        "timeline": charts.state_timeline(rows, len(facts.state)),
        "charts": [_over_time(facts), _by_joint(facts)],
        "fit_states": list(FIT_STATES.items()),
        "view_states": list(VIEW_STATES.items()),
        "colours": {
            "fit": "#{:02x}{:02x}{:02x}".format(*FIT_COLOUR),
            "keypoints": "#{:02x}{:02x}{:02x}".format(*KEYPOINT_COLOUR),
        },
    }


def _over_time(facts: BodyFacts) -> str:
    """The least sure joint of the body and of each hand, over the frames."""
    left, right = FINGER_JOINTS
    parts = (
        ("body", "c1", BODY_JOINTS), ("left hand", "c2", left), ("right hand", "c3", right),
    )  # fmt: skip
    worst = {(name, colour): facts.sigma_mm[:, at].max(1) for name, colour, at in parts}
    top = max(_LEAST_MM, 1.1 * max(float(values.max(initial=0.0)) for values in worst.values()))
    total = len(facts.state)
    return charts.line_chart(
        [charts.Series(name, colour, np.arange(total), y) for (name, colour), y in worst.items()],
        x_label="frame",
        y_label="deviation of the least sure joint, mm",
        x_range=(0.0, float(max(total - 1, 1))),
        y_range=(0.0, top),
    )


def _by_joint(facts: BodyFacts) -> str:
    """Each joint's stated deviation, in the median frame and the worst one; fingers by hand."""
    sigma = facts.sigma_mm
    rows = [
        (JOINT_NAMES[j].replace("_", " "), sigma[:, j]) for j in range(*BODY_JOINTS.indices(55))
    ]
    rows += [
        (f"{side} fingers", sigma[:, at].mean(1))
        for side, at in zip(("left", "right"), FINGER_JOINTS, strict=True)
    ]
    return charts.bars(
        [
            charts.Bar(name, float(np.median(v)), float(v.max()), f"up to {v.max():.1f}")
            for name, v in rows
        ],
        "stated deviation, mm",
    )
