"""Section of a page on the body's fit: its evidence, and the stated deviation of every joint."""

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

GOOD_PX = 8.0  # a view agrees up to this median keypoint error, scaled to 1080 rows
_ROWS = 4  # frames of the sheet
_LEAST_MM = 10.0  # least height of the charts
VIEW_STATES = {
    "agrees": f"keypoint error up to {GOOD_PX:g} px at 1080 rows",
    "partly": "larger error",
    "nothing": "person not visible",
}
FIT_STATES = {
    "moving": "fitted",
    "doubtful": "not determined by the observations",
    "lost": "not fitted: interpolated between fitted frames",
}


@dataclass(frozen=True, eq=False)
class BodyFacts:
    """The fit of one body over T frames and C cameras; unknown values are NaN."""

    name: str
    subject: str
    cameras: list[str]
    rows: np.ndarray
    """(C,) height of each camera's image, pixels."""
    pixels: np.ndarray
    """(T, C) median error of the keypoints, pixels."""
    cloud_mm: np.ndarray
    """(T,) median distance of the person's points."""
    sigma_mm: np.ndarray
    """(T, 55) stated deviation of the joints."""
    state: list[str]
    """(T,) keys of FIT_STATES."""
    sheet: Sheet | None
    note: str = ""
    """Why there is no sheet."""


def read_fit(paths: SequencePaths, models: SequenceModels) -> BodyFacts:
    """Read and draw the fit; raises UserError as :func:`artefacts.read` does."""
    with artefacts.read(paths.scene, SCENE) as scene:
        rig, image_of = Rig.from_artefact(scene), scene["image_of"]
    with artefacts.read(paths.person, PERSON) as person:
        detected = person["keypoints"]
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
        except UserError as error:  # an unreadable image must not prevent the page
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
    """Return the variables of the template body.html.j2."""
    bridged, unsure = facts.state.count("lost"), facts.state.count("doubtful")
    counts = [f"{n} {word}" for n, word in ((bridged, "interpolated"), (unsure, "doubtful")) if n]
    label = ", ".join(counts) or "no doubtful frame"
    if np.isfinite(facts.cloud_mm).any():
        label += f" · points {np.nanmedian(facts.cloud_mm):.1f} mm off"
    rows = [charts.StateRow("fit", charts.state_runs(facts.state, FIT_STATES), label)]
    for c, name in enumerate(facts.cameras):
        pixels = facts.pixels[:, c]
        seen = np.isfinite(pixels)
        limit = GOOD_PX * facts.rows[c] / 1080
        states = [
            "nothing" if not visible else "agrees" if value <= limit else "partly"
            for visible, value in zip(seen, pixels, strict=True)
        ]
        label = f"{100 * seen.mean():.0f} % visible"
        label += f" · {np.median(pixels[seen]):.1f} px" if seen.any() else ""
        rows.append(charts.StateRow(name, charts.state_runs(states, VIEW_STATES), label))
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
    """Plot the largest deviation of body joints and of each hand over the frames."""
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
        y_label="largest deviation of a joint, mm",
        x_range=(0.0, float(max(total - 1, 1))),
        y_range=(0.0, top),
    )


def _by_joint(facts: BodyFacts) -> str:
    """Plot the median and largest stated deviation of each joint; fingers are pooled by hand."""
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
_MARGIN = 0.06  # around the body's box, share of its size
_CONFIDENT = 0.3  # least confidence of drawn keypoints
# Trunk, arms, legs, feet and nose
_BONES = keypoint_pairs([*SKELETON, *FEET]).tolist()


@dataclass(frozen=True, eq=False)
class PosedBody:
    """The fit in one frame, master frame, metres."""

    vertices: np.ndarray
    """(V, 3)"""
    keypoints: np.ndarray
    """(135, 3)"""


def body_sheet(
    images: Frames,
    rig: Rig,
    bodies: Mapping[int, PosedBody],
    faces: np.ndarray,
    detected: np.ndarray,
) -> Sheet:
    """Draw outline and bones of the fits, and the detected keypoints, over crops of the images.

    Args:
        bodies: by frame, in the order of the rows.
        detected: (T, C, 135, 3) x, y, confidence.
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
    cell = crop.extract(rgb)
    drawn = render(body.vertices, faces, lens, camera.colour_from_master, cull_back=True)
    crop.outline(cell, drawn.mask, drawn.x0, drawn.y0, FIT_COLOUR)
    points = apply(camera.colour_from_master, body.keypoints[BODY])
    known = lens.sees(points)
    at = crop.to_cell(lens.project(np.where(known[:, None], points, [0.0, 0.0, 1.0])))
    for a, b in _BONES:
        if known[a] and known[b]:
            cv2.line(cell, _pixel(at[a]), _pixel(at[b]), FIT_COLOUR, 1, cv2.LINE_AA)
    confident = detected[BODY][detected[BODY, 2] >= _CONFIDENT]
    for dot in crop.to_cell(confident[:, :2]):
        cv2.circle(cell, _pixel(dot), 2, KEYPOINT_COLOUR, -1, cv2.LINE_AA)
    return cell


def _crop(pixels: np.ndarray) -> Crop:
    """Return the square around the body's pixels (N, 2)."""
    low, high = pixels.min(0), pixels.max(0)
    size = max(int((1 + 2 * _MARGIN) * float((high - low).max())), 32)
    x0, y0 = np.rint((low + high - size) / 2).astype(int)
    return Crop(int(x0), int(y0), size, _CELL_PX)


def _pixel(point: Sequence[int] | np.ndarray) -> tuple[int, int]:
    return int(point[0]), int(point[1])
