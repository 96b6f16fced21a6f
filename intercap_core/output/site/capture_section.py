"""Section of a page on the capture: time, cameras, pairs of cameras, floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.evaluation import flags
from intercap_core.formats.recordings.frames import Frames
from intercap_core.output.site import charts
from intercap_core.output.site.capture_pictures import (
    CAMERA_COLOURS,
    CapturePictures,
    FloorProfile,
    draw_capture,
)
from intercap_core.schemas import FRAMES, SCENE

_MAX_PAIRS = 45  # drawn pairs of cameras
STATES = ("recorded", "part", "slipped", "missing", "dropped")
_WORDS = {
    "recorded": "recorded",
    "part": "only one of colour and depth",
    "slipped": "shows an earlier frame",
    "missing": "no image",
    "dropped": "dropped by annotation",
}


@dataclass(frozen=True, eq=False)
class CameraFacts:
    """One camera of a capture of T frame sets; seconds and metres; NaN = unknown."""

    name: str
    state: Sequence[str]
    """(T,) keys of STATES."""
    slip: Sequence[int]
    """(T,) whole frames by which the images are older than their device times."""
    start: float
    """Time of the first image."""
    end: float
    """Time of the last image."""
    offset: float
    """Exposure time minus the set's time."""
    offset_sigma: float
    """Standard deviation of ``offset``; NaN = not estimated."""
    depth_bias: float
    """Bias that is subtracted from the depth; NaN = no depth."""
    depth_bias_sigma: float
    """Standard deviation of ``depth_bias``; NaN = not stated."""
    moved: float
    """Distance by which refinement moved the camera."""
    turned_deg: float
    """Angle by which refinement rotated the camera."""
    slide: float
    """Distance by which the rig's centre is displaced if the camera's pose is off by one standard
    deviation in its least certain direction."""
    verdict: str
    """Why the refined or the given pose is used, in words; "" = not judged."""
    note: str
    """Remarks of stages frames and scene."""

    @property
    def recorded(self) -> int:
        """Number of sets with an image of this camera."""
        return sum(state in ("recorded", "part", "slipped") for state in self.state)


@dataclass(frozen=True)
class Pair:
    """Distances of the surfaces that two cameras measure, before and after refinement, metres.

    Medians over held-out points; NaN without overlap.
    """

    name: str
    """Names of both cameras."""
    before: float
    after: float
    points: int
    """Number of points on static surfaces."""
    weak: bool
    """Few points, or distances well above those of the other pairs."""
    moving: tuple[float, float, int]
    """Before, after and number of points, on moving surfaces."""


@dataclass(frozen=True, eq=False)
class CaptureFacts:
    """One capture, from its frames and scene artefacts; metres and seconds."""

    name: str
    fps: float
    times: np.ndarray
    """(T,) time of each frame set."""
    master: str
    """Name of the master camera."""
    cameras: Sequence[CameraFacts]
    pairs: Sequence[Pair]
    ground: str
    """Source and accuracy of the floor, in words."""
    verdict: str
    """Result of the refinement of the extrinsics, in words."""
    pictures: CapturePictures | None
    """None if an image is unreadable."""
    note: str = ""
    """Why there are no pictures."""
    gaps: Sequence[tuple[int, int]] = ()
    """As :func:`gaps` returns them."""


def read_capture(frames: Path, scene: Path) -> CaptureFacts:
    """Read and draw one capture; raises UserError as :func:`artefacts.read` does.

    If an image is unreadable, ``pictures`` is None and ``note`` has the reason.
    """
    with artefacts.read(frames, FRAMES) as recorded, artefacts.read(scene, SCENE) as refined:
        pictures, note = None, ""
        try:
            pictures = draw_capture(Frames(recorded), refined)
        except UserError as error:  # an unreadable image must not prevent the page
            note = str(error)
        names = recorded.text("camera_names")
        times, fps = recorded["times"], float(recorded.attributes["fps"])
        return CaptureFacts(
            name=str(recorded.attributes["sequence"]),
            fps=fps,
            times=times,
            master=str(recorded.attributes["master"]),
            cameras=_cameras(recorded, refined),
            pairs=_pairs(refined, names),
            ground=_ground(refined),
            verdict=str(refined.attributes["verdict"]),
            pictures=pictures,
            note=note,
            gaps=gaps(times, fps),
        )


def camera_states(
    colour: np.ndarray, depth: np.ndarray, slip: np.ndarray, dropped: np.ndarray
) -> list[str]:
    """Return the state of one camera in each set, one of STATES.

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


def context(facts: CaptureFacts) -> dict[str, Any]:
    """Return the variables of the template capture.html.j2."""
    drawn = facts.pictures
    pictures = [*drawn.views, drawn.slice_] if drawn else []
    return {
        "name": facts.name,
        "note": facts.note,
        "verdict": facts.verdict,
        "ground": facts.ground,
        "frame": drawn.frame if drawn else None,
        "pictures": [row for row in pictures if row],
        "profiles": _profile_charts(drawn) if drawn else [],
        "pairs": _pair_charts(facts.pairs),
        "pairs_left_out": max(0, len(facts.pairs) - _MAX_PAIRS),
        "timeline": _timeline(facts),
        "states": [(state, _WORDS[state]) for state in STATES],
        "gaps": [f"after frame {t} ({count} {_sets(count)})" for t, count in facts.gaps],
        "cameras": [_row(camera, facts.master) for camera in facts.cameras],
        "legend": [(camera.name, _colour(c)) for c, camera in enumerate(facts.cameras)],
        "sets": len(facts.times),
    }


def _cameras(recorded: artefacts.Artefact, refined: artefacts.Artefact) -> list[CameraFacts]:
    """Collect the facts of each camera from the artefacts of frames and scene."""
    start, end = refined["master_from_colour_start"], refined["master_from_colour"]
    turn = np.swapaxes(start[:, :3, :3], 1, 2) @ end[:, :3, :3]
    cosine = np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)
    colour, depth = recorded["colour_index"] >= 0, recorded["depth_index"] >= 0
    slip, dropped, times = refined["slip"], recorded["dropped"], recorded["times"]
    offset, sigma, bias = (
        refined[key] for key in ("time_offset", "time_offset_sigma", "depth_bias")
    )
    has_depth = refined["depth_size"][:, 0] > 0
    variance = np.einsum("cici->ci", refined["camera_covariance"])[:, 6]  # of the depth bias
    bias_sigma = np.sqrt(np.maximum(variance, 0))  # 0 = not stated
    notes = zip(recorded.text("note"), refined.text("note"), strict=True)
    judged = "camera_verdict" in refined  # absent in artefacts of earlier versions
    slides = (
        np.linalg.norm(refined["camera_slide"], axis=1) if judged else np.full(len(end), np.nan)
    )
    verdicts = refined.text("camera_verdict") if judged else [""] * len(end)
    result = []
    for c, (name, words) in enumerate(zip(recorded.text("camera_names"), notes, strict=True)):
        recorded_sets = np.flatnonzero(colour[:, c] | depth[:, c])
        first, last = times[recorded_sets[[0, -1]]] if len(recorded_sets) else (np.nan, np.nan)
        result.append(
            CameraFacts(
                name=name,
                state=camera_states(colour[:, c], depth[:, c], slip[:, c], dropped),
                slip=slip[:, c].tolist(),
                start=float(first),
                end=float(last),
                offset=float(offset[c]),
                offset_sigma=float(sigma[c]),
                depth_bias=float(bias[c]) if has_depth[c] else float("nan"),
                depth_bias_sigma=float(bias_sigma[c]) if bias_sigma[c] > 0 else float("nan"),
                moved=float(np.linalg.norm(end[c, :3, 3] - start[c, :3, 3])),
                turned_deg=float(np.degrees(np.arccos(cosine[c]))),
                slide=float(slides[c]) if slides[c] > 0 else float("nan"),
                verdict=verdicts[c],
                note="; ".join(dict.fromkeys(word for word in words if word)),
            )
        )
    return result


def _pairs(scene: artefacts.Artefact, names: Sequence[str]) -> list[Pair]:
    columns = ("residual_before", "residual_after", "points", "weak",
               "moving_before", "moving_after", "moving_points")  # fmt: skip
    rows = zip(scene["pairs"], *(scene[f"pair_{column}"] for column in columns), strict=True)
    return [
        Pair(
            f"{names[i]}–{names[j]}", float(before), float(after), int(points), bool(weak),
            (float(moving_before), float(moving_after), int(moving_points)),
        )
        for (i, j), before, after, points, weak, moving_before, moving_after, moving_points in rows
    ]  # fmt: skip


def _ground(scene: artefacts.Artefact) -> str:
    stated = scene.attributes
    if not stated["ground_found"]:
        source = stated.get("up_source", "a hint")
        text = f"no floor was found or annotated, vertical by {source}"
    elif stated["ground_source"] == "stated":
        text = "as stated with the calibration"
    else:
        text = f"{stated['ground_source']}, {int(stated['ground_inliers']):,} supporting points"
        rms = 1e3 * float(stated["ground_rms"])
        text += f", RMS {rms:.1f} mm" if np.isfinite(rms) else ""
    return f"{text}; {stated['ground_note']}" if "ground_note" in stated else text


def _pair_charts(pairs: Sequence[Pair]) -> list[tuple[str, str]]:
    """Plot residuals of static and of moving surfaces: (caption, SVG)."""
    worst = sorted(pairs, key=lambda pair: -np.nan_to_num(pair.after, nan=-1.0))[:_MAX_PAIRS]
    shown = [pair for pair in pairs if pair in worst]
    static = [(pair, pair.before, pair.after, pair.points) for pair in shown]
    moving = [(pair, *pair.moving) for pair in shown]
    return [
        (
            what,
            charts.bar_pairs(
                [
                    charts.BarPair.change(
                        pair.name, 1e3 * before, 1e3 * after, f"{points:,} points", pair.weak
                    )
                    for pair, before, after, points in rows
                ],
                "median distance, mm",
            ),
        )
        for what, rows in (("static surfaces", static), ("person and moving surfaces", moving))
        if any(points for *_, points in rows)
    ]


def _timeline(facts: CaptureFacts) -> str:
    rows = []
    for camera in facts.cameras:
        states = [
            f"slipped by {slip}" if state == "slipped" else state
            for state, slip in zip(camera.state, camera.slip, strict=True)
        ]
        runs = []
        for first, last, text in flags.ranges(states):
            state, _, frames = text.partition(" by ")
            at = f"{first}" if first == last else f"{first}–{last}"
            late = f", {frames} {_frames(int(frames))} before" if frames else ""
            runs.append((first, last, f"state {state}", f"{at}: {_WORDS[state]}{late}"))
        rows.append(charts.TimelineRow(camera.name, runs, _row_label(camera)))
    marks = [(t, f"{count} {_sets(count)} without any image") for t, count in facts.gaps]
    return charts.timeline(rows, len(facts.times), marks)


def _row_label(camera: CameraFacts) -> str:
    """Return the text at the end of a camera's row of the timeline."""
    if not camera.recorded:
        return "no image"
    parts = [f"{camera.start:.2f}–{camera.end:.2f} s"]
    parts += [
        f"{count} {word}"
        for state, word in (("missing",) * 2, ("slipped", _slipped(camera)), ("part", "incomplete"))
        if (count := list(camera.state).count(state))
    ]
    if np.isfinite(camera.offset_sigma):
        parts.append(f"{_offset(camera)} ms")
    return " · ".join(parts)


def _slipped(camera: CameraFacts) -> str:
    """Describe by how many frames the images slipped, such as "slipped by 2 or 3"."""
    late = {
        slip for state, slip in zip(camera.state, camera.slip, strict=True) if state == "slipped"
    }
    return f"slipped by {' or '.join(map(str, sorted(late)))}"


def _offset(camera: CameraFacts) -> str:
    if not np.isfinite(camera.offset_sigma):
        return ""
    return f"{1e3 * camera.offset:+.1f} ± {1e3 * camera.offset_sigma:.1f}"


def _bias(camera: CameraFacts) -> str:
    """Format the bias in millimetres with its deviation; "" for a camera without depth."""
    if not np.isfinite(camera.depth_bias):
        return ""
    text = f"{1e3 * camera.depth_bias:.1f}"
    sigma = camera.depth_bias_sigma
    return f"{text} ± {1e3 * sigma:.1f}" if np.isfinite(sigma) else text


def _row(camera: CameraFacts, master: str) -> dict[str, Any]:
    states = list(camera.state)
    return {
        "name": camera.name,
        "master": camera.name == master,
        "recorded": camera.recorded,
        "counts": [states.count(state) for state in ("missing", "slipped")],
        "offset": _offset(camera),
        "bias": _bias(camera),
        "moved": 1e3 * camera.moved,
        "turned": camera.turned_deg,
        "slide": 1e3 * camera.slide,
        "verdict": camera.verdict,
        "note": camera.note,
    }


def _profile_charts(drawn: CapturePictures) -> list[tuple[str, str]]:
    """Plot the floor before and after refinement with one scale: (caption, SVG)."""
    every = [profile for profiles in drawn.profiles for profile in profiles]
    if not every:
        return []
    top = max(10.0, *(1e3 * float(np.abs(p.height).max()) for p in every))
    top = 10 * float(np.ceil(top / 10))
    low = min(float(p.along.min()) for p in every)
    high = max(float(p.along.max()) for p in every)
    return [
        (
            f"the floor along a strip near the middle, {when} refinement" if when
            else "the floor along a strip near the middle",
            _profile_chart(profiles, (low, high), top),
        )
        for when, profiles in zip(drawn.when, drawn.profiles, strict=True)
    ]  # fmt: skip


def _profile_chart(
    profiles: Sequence[FloorProfile], x_range: tuple[float, float], top: float
) -> str:
    series = [charts.Series("", _colour(p.c), p.along, 1e3 * p.height) for p in profiles]
    return charts.line_chart(
        series,
        x_label="along the strip, m",
        y_label="height over the floor, mm",
        x_range=x_range,
        y_range=(-top, top),
    )


def _colour(c: int) -> str:
    return CAMERA_COLOURS[c % len(CAMERA_COLOURS)]


def _frames(count: int) -> str:
    return "frame" if count == 1 else "frames"


def _sets(count: int) -> str:
    return "set" if count == 1 else "sets"
