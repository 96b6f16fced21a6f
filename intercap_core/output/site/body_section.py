"""The page's section on one body's fit: its evidence, and the stated deviation of every joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.keypoints import BODY, FEET, SKELETON, keypoint_pairs
from intercap_core.errors import UserError
from intercap_core.evaluation.body import BODY_JOINTS, FINGER_JOINTS
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.render import render
from intercap_core.output.site import charts
from intercap_core.output.site.drawing import Crop, Sheet, make_sheet
from intercap_core.output.site.overlays import choose_frames
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


FIT_COLOUR, KEYPOINT_COLOUR = (107, 168, 235), (255, 210, 64)  # RGB
_CELL_PX = 220
_MARGIN = 0.06  # of the body's box, around it
_CONFIDENT = 0.3
# Trunk, arms, legs, feet and nose; the rest of the face is in the outline.
_BONES = keypoint_pairs([*SKELETON, *FEET]).tolist()


@dataclass(frozen=True, eq=False)
class PosedBody:
    """One frame's fit, master frame: ``vertices`` (V, 3), ``keypoints`` (135, 3)."""

    vertices: np.ndarray
    keypoints: np.ndarray


def body_sheet(
    images: Frames,
    rig: Rig,
    bodies: Mapping[int, PosedBody],
    faces: np.ndarray,
    detected: np.ndarray,
) -> Sheet:
    """Draw outline and bones of the fits, and the detected keypoints, over crops of the images.

    ``bodies`` by frame, in the order of the rows; ``detected`` (T, C, 135, 3) x, y, confidence.
    """

    def draw(camera: Camera, t: int, c: int, rgb: np.ndarray) -> np.ndarray | None:
        return _cell(camera, rgb, bodies[t], faces, detected[t, c])

    return make_sheet(images, rig, list(bodies), _CELL_PX, draw)


def _cell(
    camera: Camera,
    rgb: np.ndarray,
    body: PosedBody,
    faces: np.ndarray,
    detected: np.ndarray,
) -> np.ndarray | None:
    lens = camera.colour
    local = apply(camera.colour_from_master, body.vertices)
    crop = _crop(lens.project(local[seen])) if (seen := lens.sees(local)).any() else None
    if crop is None:
        return None
    cell = crop.of(rgb)
    drawn = render(body.vertices, faces, lens, camera.colour_from_master, cull_back=True)
    crop.outline(cell, drawn.mask, drawn.x0, drawn.y0, FIT_COLOUR)
    points = apply(camera.colour_from_master, body.keypoints[BODY])
    known = lens.sees(points)
    at = crop.placed(lens.project(np.where(known[:, None], points, [0.0, 0.0, 1.0])))
    for a, b in _BONES:
        if known[a] and known[b]:
            cv2.line(cell, _pixel(at[a]), _pixel(at[b]), FIT_COLOUR, 1, cv2.LINE_AA)
    confident = detected[BODY][detected[BODY, 2] >= _CONFIDENT]
    for dot in crop.placed(confident[:, :2]):
        cv2.circle(cell, _pixel(dot), 2, KEYPOINT_COLOUR, -1, cv2.LINE_AA)
    return cell


def _crop(pixels: np.ndarray) -> Crop:
    """The square around the body's pixels (N, 2)."""
    low, high = pixels.min(0), pixels.max(0)
    size = max(int((1 + 2 * _MARGIN) * float((high - low).max())), 32)
    x0, y0 = np.rint((low + high - size) / 2).astype(int)
    return Crop(int(x0), int(y0), size, _CELL_PX)


def _pixel(point: Sequence[int] | np.ndarray) -> tuple[int, int]:
    return int(point[0]), int(point[1])
