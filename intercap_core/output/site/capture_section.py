"""Section of a page on the capture: time, cameras, pairs of cameras, floor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.output.export.motion import describe_up
from intercap_core.output.site import charts
from intercap_core.output.site.capture_pictures import camera_colour, draw_capture
from intercap_core.schemas import FRAMES, SCENE

_MAX_PAIRS = 45  # drawn pairs of cameras
STATES = {  # of a camera in a frame set
    "recorded": "recorded",
    "part": "only one of colour and depth",
    "slipped": "shows an earlier frame (images lost)",
    "missing": "no image",
    "dropped": "dropped by annotation",
}


def read_capture(frames: Path, scene: Path) -> dict[str, Any]:
    """Read and draw one capture; return the variables of the template capture.html.j2.

    If an image is unreadable, there are no pictures and ``note`` has the reason. Raises UserError
    as :func:`artefacts.read` does.
    """
    with artefacts.read(frames, FRAMES) as recorded, artefacts.read(scene, SCENE) as refined:
        drawn: dict[str, Any] = {"frame": None, "pictures": [], "profiles": []}
        note = ""
        try:
            drawn = draw_capture(Frames(recorded), refined)
        except UserError as error:  # an unreadable image must not prevent the page
            note = str(error)
        names, times = recorded.text("camera_names"), recorded["times"]
        rows, cameras = _cameras(recorded, refined)
        missing = gaps(times, float(recorded.attributes["fps"]))
        marks = [(t, f"{count} {_sets(count)} without any image") for t, count in missing]
        return {
            "name": str(recorded.attributes["sequence"]),
            "note": note,
            "verdict": str(refined.attributes["verdict"]),
            "ground": _ground(refined),
            **drawn,
            "pairs": _pair_charts(refined, names),
            "pairs_left_out": max(0, len(refined["pairs"]) - _MAX_PAIRS),
            "timeline": charts.timeline(rows, len(times), marks),
            "states": STATES,
            "gaps": [f"after frame {t} ({count} {_sets(count)})" for t, count in missing],
            "cameras": cameras,
            "legend": [(name, camera_colour(c)) for c, name in enumerate(names)],
            "sets": len(times),
        }


def camera_states(
    colour: np.ndarray, depth: np.ndarray, slip: np.ndarray, dropped: np.ndarray
) -> list[str]:
    """Return the state of one camera in each set, a key of STATES.

    Args:
        colour, depth: (T,) bool, whether the set has such an image.
        slip: (T,) whole frames by which the image is older than its device time.
        dropped: (T,) bool, dropped by annotation.
    """
    state = np.full(len(colour), "missing", object)
    state[colour | depth] = "part"
    state[colour & (depth | (not depth.any()))] = "recorded"
    state[(colour | depth) & (slip != 0)] = "slipped"
    state[dropped] = "dropped"
    return state.tolist()


def gaps(times: np.ndarray, fps: float) -> list[tuple[int, int]]:
    """Return gaps without any image: (index of the set before, number of missing sets)."""
    steps = np.diff(times) * fps
    return [(int(t), round(float(steps[t])) - 1) for t in np.flatnonzero(steps > 1.5)]


def _cameras(
    recorded: artefacts.Artefact, refined: artefacts.Artefact
) -> tuple[list[charts.TimelineRow], list[dict[str, Any]]]:
    """Return the row of each camera in the timeline, and in the table."""
    start, end = refined["master_from_colour_start"], refined["master_from_colour"]
    turn = np.swapaxes(start[:, :3, :3], 1, 2) @ end[:, :3, :3]
    cosine = np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)
    colour, depth = recorded["colour_index"] >= 0, recorded["depth_index"] >= 0
    slip, dropped, times = refined["slip"], recorded["dropped"], recorded["times"]
    offset, sigma = refined["time_offset"], refined["time_offset_sigma"]
    bias = np.where(refined["depth_size"][:, 0] > 0, refined["depth_bias"], np.nan)
    variance = np.einsum("cici->ci", refined["camera_covariance"])[:, 6]  # of the depth bias
    bias_sigma = np.sqrt(np.maximum(variance, 0))  # 0 = not stated
    notes = zip(recorded.text("note"), refined.text("note"), strict=True)
    slides, verdicts = np.full(len(end), np.nan), [""] * len(end)
    if "camera_verdict" in refined:  # absent in artefacts of earlier versions
        slides = np.linalg.norm(refined["camera_slide"], axis=1)
        verdicts = refined.text("camera_verdict")
    rows, table = [], []
    for c, (name, words) in enumerate(zip(recorded.text("camera_names"), notes, strict=True)):
        states = camera_states(colour[:, c], depth[:, c], slip[:, c], dropped)
        delay = bias_mm = ""
        if np.isfinite(sigma[c]):
            delay = f"{1e3 * float(offset[c]):+.1f} ± {1e3 * float(sigma[c]):.1f}"
        if np.isfinite(bias[c]):
            bias_mm = f"{1e3 * float(bias[c]):.1f}"
            bias_mm += f" ± {1e3 * float(bias_sigma[c]):.1f}" if bias_sigma[c] > 0 else ""
        span = times[np.flatnonzero(colour[:, c] | depth[:, c])]
        rows.append(
            charts.TimelineRow(
                name, _runs(states, slip[:, c]), _row_label(states, slip[:, c], span, delay)
            )
        )
        table.append(
            {
                "name": name,
                "master": name == str(recorded.attributes["master"]),
                "recorded": _count_images(states),
                "counts": [states.count(state) for state in ("missing", "slipped")],
                "offset": delay,
                "bias": bias_mm,
                "moved": 1e3 * float(np.linalg.norm(end[c, :3, 3] - start[c, :3, 3])),
                "turned": float(np.degrees(np.arccos(cosine[c]))),
                # displacement of the rig's centre by one standard deviation of the camera's pose
                # in its least certain direction
                "slide": 1e3 * float(slides[c]) if slides[c] > 0 else float("nan"),
                "verdict": verdicts[c],
                "note": "; ".join(dict.fromkeys(word for word in words if word)),
            }
        )
    return rows, table


def _count_images(states: Sequence[str]) -> int:
    return sum(state in ("recorded", "part", "slipped") for state in states)


def _ground(scene: artefacts.Artefact) -> str:
    stated = scene.attributes
    if not stated["ground_found"]:
        text = "no floor was found or annotated"
    elif stated["ground_source"] == "stated":
        text = "as stated with the calibration"
    else:
        text = f"{stated['ground_source']}, {int(stated['ground_inliers']):,} supporting points"
        rms = 1e3 * float(stated["ground_rms"])
        text += f", RMS {rms:.1f} mm" if np.isfinite(rms) else ""
    text = f"{text}; {describe_up(scene)}"
    return f"{text}; {stated['ground_note']}" if "ground_note" in stated else text


def _pair_charts(scene: artefacts.Artefact, names: Sequence[str]) -> list[tuple[str, str]]:
    """Plot residuals of static and of moving surfaces: (caption, SVG).

    They are medians over held-out points, NaN without overlap. At most ``_MAX_PAIRS`` pairs with
    the largest residuals are shown.
    """
    after = np.nan_to_num(scene["pair_residual_after"], nan=-1.0)
    shown = np.sort(np.argsort(-after, kind="stable")[:_MAX_PAIRS])
    labels, weak = [f"{names[i]}–{names[j]}" for i, j in scene["pairs"]], scene["pair_weak"]
    plots = []
    for what, residual, points in (
        ("static surfaces", "pair_residual", scene["pair_points"]),
        ("person and moving surfaces", "pair_moving", scene["pair_moving_points"]),
    ):
        before, after = scene[f"{residual}_before"], scene[f"{residual}_after"]
        bars = [
            charts.BarPair.change(
                labels[p], 1e3 * float(before[p]), 1e3 * float(after[p]),
                f"{int(points[p]):,} points", bool(weak[p]),
            )
            for p in shown
        ]  # fmt: skip
        if points[shown].any():
            plots.append((what, charts.bar_pairs(bars, "median distance, mm")))
    return plots


def _runs(states: Sequence[str], slip: np.ndarray) -> list[tuple[int, int, str, str]]:
    """Return the runs of a :class:`.charts.TimelineRow`; slips (T,) are part of the words."""
    late = slip.tolist()
    words = STATES | {f"slipped {n}": f"{STATES['slipped']}, {n} {_sets(n)} before" for n in late}
    slipped = [
        f"slipped {n}" if state == "slipped" else state
        for state, n in zip(states, late, strict=True)
    ]
    return charts.state_runs(slipped, words)


def _row_label(states: Sequence[str], slip: np.ndarray, times: np.ndarray, delay: str) -> str:
    """Return the text at the end of a camera's row of the timeline.

    Args:
        times: times of its images.
        delay: text on the delay of its exposures.
    """
    if not _count_images(states):
        return "no image"
    late = sorted({int(slip[t]) for t, state in enumerate(states) if state == "slipped"})
    words = {
        "missing": "missing",
        "slipped": f"earlier by {' or '.join(map(str, late))}",
        "part": "incomplete",
    }
    parts = [f"{times[0]:.2f}–{times[-1]:.2f} s"]
    parts += [f"{n} {word}" for state, word in words.items() if (n := states.count(state))]
    return " · ".join([*parts, f"{delay} ms"] if delay else parts)


def _sets(count: int) -> str:
    return "frame" if count == 1 else "frames"
