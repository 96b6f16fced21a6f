"""Section of a page on the object's track: first pose, images and standard deviation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.evaluation.figures import finite_median
from intercap_core.geometry.camera.masks import Runs
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render
from intercap_core.object_track.artefact import SOURCE_NONE as NO_TRACK
from intercap_core.output.site import charts
from intercap_core.output.site.embed import css
from intercap_core.output.site.fit_section import SquareCrop, draw_sheet, view_row
from intercap_core.output.site.overlays import choose_frames
from intercap_core.schemas import OBJECT_TRACK
from intercap_core.sequence_inputs import SequencePaths

GOOD_OVERLAP = 0.7  # smallest IoU of a view that agrees
VIEW_STATES = {
    "agrees": f"segmentation mask used, IoU {GOOD_OVERLAP:g} or more",
    "partly": f"segmentation mask used, IoU below {GOOD_OVERLAP:g}",
    "nothing": "no segmentation mask used",
}
TRACK_STATES = {
    "moving": "tracked",
    "resting": "at rest",
    "doubtful": "ambiguous: another pose may be true",
    "carried": "not visible, propagated from annotated poses",
    "lost": "lost",
    "gone": "not visible for so long that it has probably left",
}


def read_track(
    paths: SequencePaths, mesh: ObjectMesh, kept: Callable[[int, int], bytes]
) -> dict[str, Any]:
    """Read and draw one track; return the variables of the template fit.html.j2.

    Args:
        kept: returns the RLE of the candidate that the track uses in frame t and camera c, b"" if
            it uses none.

    Without a track, or if an image is unreadable, ``sheet`` is None and ``note`` has the reason.
    Raises UserError as :func:`artefacts.read` does.
    """
    with artefacts.read(paths.object_track, OBJECT_TRACK) as track:
        poses = rigid(track["rotation"], track["translation"])
        source = track.attributes["seed_source"]
        sheet, note = None, str(track.attributes["doubts"])
        seed = "none: the object was found in no frame"
        if source != NO_TRACK:

            def draw(camera: Camera, t: int, c: int, rgb: np.ndarray) -> np.ndarray | None:
                return _cell(camera, rgb, mesh, poses[t], kept(t, c))

            shown = choose_frames(1 - _mean(track["overlap"], 1), 5)
            sheet, note = draw_sheet(paths, shown, _CELL_PX, draw)
            origin = "annotated" if source == "annotated" else "found by search"
            seed = f"frame {track.attributes['seed_frame']}, {origin}"
        covariance = track["covariance"]
        sigma_mm = 1e3 * _largest(covariance[:, 3:, 3:])
        sigma_deg = np.degrees(_largest(covariance[:, :3, :3]))
        return {
            "of": "object's track",
            "object": str(track.attributes["object"]),
            "seed": seed,
            "sheet": sheet,
            "note": note,
            "colours": [
                ("the track", css(np.divide(TRACK_COLOUR, 255))),
                ("the segmentation mask that it uses", css(np.divide(CANDIDATE_COLOUR, 255))),
            ],
            "timeline": _timeline(track),
            "states": TRACK_STATES,
            "marks": "found again after a loss",
            "view_states": VIEW_STATES,
            "view_label": "medians of overlap, depth residual and contour distance",
            "charts": [
                _chart(values, label, least, most)
                for values, label, least, most in (
                    (sigma_mm, "deviation of the position, mm", 5.0, np.inf),
                    (sigma_deg, "deviation of the rotation, degrees", 2.0, 90.0),
                )
                if np.isfinite(values).any()
            ],
            "wide_chart": "",
        }


def _timeline(track: artefacts.Artefact) -> str:
    """Draw the states of the track and of every view."""
    states = _states(
        gone=track["gone"],
        lost=track["lost"],
        carried=track["carried"] if "carried" in track else np.zeros_like(track["lost"]),
        doubtful=track["ambiguous"],
        resting=track["resting"],
    )
    counts = [
        f"{n} {state}"
        for state in ("gone", "lost", "carried", "doubtful", "resting")
        if (n := states.count(state))
    ]
    label = " · ".join(counts) or "no doubtful frame"
    rows = [charts.TimelineRow("track", charts.state_runs(states, TRACK_STATES), label)]
    overlaps, depths, contours = (
        track[key].T for key in ("overlap", "depth_residual", "silhouette_residual")
    )
    for c, name in enumerate(track.text("camera_names")):
        used = np.isfinite(overlaps[c])
        good = overlaps[c] >= GOOD_OVERLAP
        label = f"{100 * used.mean():.0f} % used"
        if used.any():
            label += f" · IoU {finite_median(overlaps[c]):.2f}"
            label += _median_text(1e3 * depths[c], "mm") + _median_text(contours[c], "px")
        rows.append(view_row(name, used, good, VIEW_STATES, label))
    marks = [(t - 1, f"{t}: found again") for t in np.flatnonzero(track["recovered"]).tolist()]
    return charts.timeline(rows, len(states), marks)


def _states(**flags: np.ndarray) -> list[str]:
    """Return for each frame the name of its first set flag (T,), "moving" if none is set."""
    return np.select(list(flags.values()), list(flags), "moving").tolist()


def _chart(values: np.ndarray, label: str, least: float, most: float) -> str:
    """Plot values (T,), clipped to ``most``; the axis reaches at least to ``least``."""
    known = np.flatnonzero(np.isfinite(values))
    line = charts.Series("", "c1", known, np.minimum(values, most)[known])
    return charts.frame_chart([line], len(values), label, least)


def _median_text(values: np.ndarray, unit: str) -> str:
    return f" · {finite_median(values):.1f} {unit}" if np.isfinite(values).any() else ""


def _mean(values: np.ndarray, axis: int) -> np.ndarray:
    """Average finite values; 0 where none is finite."""
    known = np.isfinite(values)
    return np.where(known, values, 0).sum(axis) / np.maximum(known.sum(axis), 1)


def _largest(covariance: np.ndarray) -> np.ndarray:
    """Return the largest standard deviation (T,) of any axis of covariances (T, 3, 3), or NaN."""
    result = np.full(len(covariance), np.nan)
    known = np.isfinite(covariance).all((1, 2))
    result[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[known])[:, -1], 0))
    return result


TRACK_COLOUR, CANDIDATE_COLOUR = (255, 158, 46), (64, 224, 255)  # RGB
_CELL_PX = 148


def _cell(
    camera: Camera, rgb: np.ndarray, mesh: ObjectMesh, pose: np.ndarray, rle: bytes
) -> np.ndarray | None:
    """Draw the image around the object with both outlines; None if it is not in view."""
    lens = camera.colour
    in_camera = camera.colour_from_master @ pose
    centre = in_camera[:3, :3] @ mesh.centre_of_mass + in_camera[:3, 3]
    if centre[2] < 0.1 or not lens.sees(centre[None])[0]:
        return None
    x, y = lens.project(centre[None])[0]
    size = max(int(1.35 * mesh.diameter * lens.fx / centre[2]), 16)
    crop = SquareCrop(int(x) - size // 2, int(y) - size // 2, size, _CELL_PX)
    cell = crop.extract(rgb)
    drawn = render(mesh.vertices, mesh.faces, lens, in_camera, cull_back=mesh.watertight)
    crop.outline(cell, drawn.mask, drawn.x0, drawn.y0, TRACK_COLOUR)
    if rle:
        runs = Runs(rle, lens.height, lens.width)
        left, top, width, height = runs.box
        mask = runs.decode()[top : top + height, left : left + width]
        crop.outline(cell, mask, left, top, CANDIDATE_COLOUR)
    return cell
