"""Section of a page on the body fit: images, residuals, and standard deviation of every joint."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.body.joints import BODY_JOINTS, FINGER_JOINTS, JOINT_NAMES
from intercap_core.body.keypoints import BODY, FEET, SKELETON, keypoint_pairs
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.render import render
from intercap_core.output.site import charts
from intercap_core.output.site.embed import css
from intercap_core.output.site.fit_section import SquareCrop, draw_sheet, view_row
from intercap_core.output.site.overlays import choose_frames
from intercap_core.schemas import BODY_FIT, PERSON, SCENE
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

GOOD_PX = 8.0  # a view agrees up to this median keypoint error, scaled to 1080 rows
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


def read_fit(paths: SequencePaths, models: SequenceModels) -> dict[str, Any]:
    """Read and draw the fit; return the variables of the template fit.html.j2.

    If an image is unreadable, ``sheet`` is None and ``note`` has the reason. Raises UserError as
    :func:`artefacts.read` does.
    """
    with artefacts.read(paths.scene, SCENE) as scene:
        rig = Rig.from_artefact(scene)
    with artefacts.read(paths.person, PERSON) as person:
        detected = person["keypoints"]
    with artefacts.read(paths.body_fit, BODY_FIT) as fit:
        parameters, model = read_parameters(fit), load_model(models.body_models, models.gender, fit)
        sigma_mm, cloud_mm = 1e3 * fit["joint_sigma"], 1e3 * fit["cloud_residual"]
        keypoint_px, untrusted = fit["keypoint_residual"], fit["failed"] | fit["bridged"]
        states = np.where(untrusted, "lost", np.where(fit["uncertain"], "doubtful", "moving"))
    shown = choose_frames(sigma_mm[:, BODY_JOINTS].max(1), 4)
    with torch.no_grad():
        posed = model.forward(parameters.frames(torch.tensor(shown)))
        points = model.keypoints(posed).double().numpy()
    vertices, faces = posed.vertices.double().numpy(), model.faces.numpy()

    def draw(camera: Camera, t: int, c: int, rgb: np.ndarray) -> np.ndarray | None:
        i = shown.index(t)
        return _cell(camera, rgb, vertices[i], faces, points[i], detected[t, c])

    sheet, note = draw_sheet(paths, shown, _CELL_PX, draw)
    return {
        "of": "body's fit",
        "sheet": sheet,
        "note": note,
        "colours": [
            ("the fitted body", css(np.divide(FIT_COLOUR, 255))),
            ("keypoints of the detector", css(np.divide(KEYPOINT_COLOUR, 255))),
        ],
        "timeline": _timeline(states.tolist(), cloud_mm, keypoint_px, rig),
        "states": FIT_STATES,
        "marks": "",
        "view_states": VIEW_STATES,
        "view_label": "the share of frames that show the person and the median keypoint error",
        "charts": [_over_time(sigma_mm)],
        "wide_chart": _by_joint(sigma_mm),
    }


def _timeline(states: list[str], cloud_mm: np.ndarray, keypoint_px: np.ndarray, rig: Rig) -> str:
    """Draw the states of the fit and of every view.

    Args:
        states: (T,) keys of FIT_STATES.
        cloud_mm: (T,) median distance of the person's points, NaN if unknown.
        keypoint_px: (T, C) median error of the keypoints, pixels, NaN if the person is not visible.
    """
    counts = [
        f"{n} {word}"
        for state, word in (("lost", "interpolated"), ("doubtful", "doubtful"))
        if (n := states.count(state))
    ]
    label = ", ".join(counts) or "no doubtful frame"
    if np.isfinite(cloud_mm).any():
        label += f" · median distance to point cloud {np.nanmedian(cloud_mm):.1f} mm"
    rows = [charts.TimelineRow("fit", charts.state_runs(states, FIT_STATES), label)]
    for camera, pixels in zip(rig, keypoint_px.T, strict=True):
        visible = np.isfinite(pixels)
        good = pixels <= GOOD_PX * camera.colour.height / 1080
        label = f"{100 * visible.mean():.0f} % visible"
        label += f" · {np.median(pixels[visible]):.1f} px" if visible.any() else ""
        rows.append(view_row(camera.name, visible, good, VIEW_STATES, label))
    return charts.timeline(rows, len(states))


def _over_time(sigma_mm: np.ndarray) -> str:
    """Plot the largest deviation of the body joints and of each hand in every frame.

    ``sigma_mm``: (T, 55) standard deviation of each joint, millimetres.
    """
    left, right = FINGER_JOINTS
    frames = np.arange(len(sigma_mm))
    lines = [
        charts.Series(name, colour, frames, sigma_mm[:, at].max(1))
        for name, colour, at in (
            ("body", "c1", BODY_JOINTS), ("left hand", "c2", left), ("right hand", "c3", right),
        )
    ]  # fmt: skip
    return charts.frame_chart(lines, len(frames), "largest deviation of a joint, mm")


def _by_joint(sigma_mm: np.ndarray) -> str:
    """Plot median and largest deviation over the frames of each joint, and of each hand's mean.

    ``sigma_mm``: (T, 55) standard deviation of each joint, millimetres.
    """
    rows = [
        (JOINT_NAMES[j].replace("_", " "), sigma_mm[:, j]) for j in range(*BODY_JOINTS.indices(55))
    ]
    rows += [
        (f"{side} fingers", sigma_mm[:, at].mean(1))
        for side, at in zip(("left", "right"), FINGER_JOINTS, strict=True)
    ]
    pairs = [
        charts.BarPair(
            name, float(v.max()), float(np.median(v)), f"{np.median(v):.1f}, up to {v.max():.1f}"
        )
        for name, v in rows
    ]
    return charts.bar_pairs(pairs, "standard deviation, mm", "largest value and median")


FIT_COLOUR, KEYPOINT_COLOUR = (107, 168, 235), (255, 210, 64)  # RGB
_CELL_PX = 220
# Trunk, arms, legs, feet and nose
_BONES = keypoint_pairs([*SKELETON, *FEET]).tolist()


def _cell(
    camera: Camera,
    rgb: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    keypoints: np.ndarray,
    detected: np.ndarray,
) -> np.ndarray | None:
    """Draw outline and bones of the fit, and the detected keypoints, over a crop of one image.

    Args:
        vertices: (V, 3) of the fit, master frame, metres.
        keypoints: (135, 3) of the fit, master frame, metres.
        detected: (135, 3) x, y, confidence.

    Returns:
        The crop, None if the body is not in view.
    """
    lens = camera.colour
    local = apply(camera.colour_from_master, vertices)
    seen = lens.sees(local)
    if not seen.any():
        return None
    pixels = lens.project(local[seen])
    low, high = pixels.min(0), pixels.max(0)
    size = max(int(1.12 * float((high - low).max())), 32)
    x0, y0 = np.rint((low + high - size) / 2).astype(int)
    crop = SquareCrop(int(x0), int(y0), size, _CELL_PX)
    cell = crop.extract(rgb)
    drawn = render(vertices, faces, lens, camera.colour_from_master, cull_back=True)
    crop.outline(cell, drawn.mask, drawn.x0, drawn.y0, FIT_COLOUR)
    points = apply(camera.colour_from_master, keypoints[BODY])
    known = lens.sees(points)
    at = crop.to_cell(lens.project(np.where(known[:, None], points, [0.0, 0.0, 1.0]))).tolist()
    for a, b in _BONES:
        if known[a] and known[b]:
            cv2.line(cell, at[a], at[b], FIT_COLOUR, 1, cv2.LINE_AA)
    confident = detected[BODY][detected[BODY, 2] >= 0.3]  # default of person.min_confidence
    for dot in crop.to_cell(confident[:, :2]).tolist():
        cv2.circle(cell, dot, 2, KEYPOINT_COLOUR, -1, cv2.LINE_AA)
    return cell
