"""The page's section on one capture: its time, its cameras, their pairs, the floor."""

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

_MAX_PAIRS = 45
_LEAST_PROFILE_MM = 10.0
_BIAS = 6  # of a camera's rows of camera_covariance, after its turn and its shift
_GAP = 1.5  # frame periods between two sets that are more than one step apart
STATES = ("recorded", "part", "slipped", "missing", "dropped")
_WORDS = {
    "recorded": "recorded",
    "part": "only one of colour and depth",
    "slipped": "shows an older moment",
    "missing": "no image",
    "dropped": "dropped by annotation",
}


@dataclass(frozen=True, eq=False)
class CameraFacts:
    """One camera of a capture; seconds, metres, NaN = not known.

    ``state`` (T,) of STATES; ``slip`` (T,) whole frames; ``turned_deg`` and ``moved`` by
    refinement, ``slide`` the deviation of the pose in the direction in which it is least known,
    ``depth_bias_sigma`` that of the depth bias.
    """

    name: str
    state: Sequence[str]
    slip: Sequence[int]
    start: float
    end: float
    offset: float
    offset_sigma: float
    depth_bias: float
    depth_bias_sigma: float
    moved: float
    turned_deg: float
    slide: float
    verdict: str
    note: str

    @property
    def recorded(self) -> int:
        """Sets with an image of this camera."""
        return sum(state in ("recorded", "part", "slipped") for state in self.state)


@dataclass(frozen=True)
class Pair:
    """Two cameras whose surfaces overlap; residuals in metres, NaN = no overlap.

    ``moving`` is before, after and points of what moves.
    """

    name: str
    before: float
    after: float
    points: int
    weak: bool
    moving: tuple[float, float, int]


@dataclass(frozen=True, eq=False)
class CaptureFacts:
    """One capture as the frames and scene artefacts tell it; metres and seconds."""

    name: str
    fps: float
    times: np.ndarray
    master: str
    cameras: Sequence[CameraFacts]
    pairs: Sequence[Pair]
    ground: str
    verdict: str
    pictures: CapturePictures | None
    note: str = ""
    gaps: Sequence[tuple[int, int]] = ()


def read_capture(frames: Path, scene: Path) -> CaptureFacts:
    """Read and draw one capture from its frames and scene artefacts.

    What cannot be drawn is left out, with its reason in ``note``. Raises UserError as
    :func:`artefacts.read` does.
    """
    with artefacts.read(frames, FRAMES) as recorded, artefacts.read(scene, SCENE) as refined:
        pictures, note = None, ""
        try:
            pictures = draw_capture(Frames(recorded), refined)
        except UserError as error:  # one image that does not decode must not prevent the report
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
    colour: np.ndarray,
    depth: np.ndarray,
    slip: np.ndarray,
    dropped: np.ndarray,
) -> list[str]:
    """What each set holds of one camera, one of STATES, from what is there; all (T,)."""
    state = np.full(len(colour), "missing", object)
    state[colour | depth] = "part"
    state[colour & (depth | (not depth.any()))] = "recorded"
    state[(colour | depth) & (slip != 0)] = "slipped"
    state[dropped] = "dropped"
    return state.tolist()


def gaps(times: np.ndarray, fps: float) -> list[tuple[int, int]]:
    """Where time runs on without any image: (set before the gap, number of sets missing)."""
    steps = np.diff(times) * fps
    return [(int(t), round(float(steps[t])) - 1) for t in np.flatnonzero(steps > _GAP)]


def context(facts: CaptureFacts) -> dict[str, Any]:
    """What the template prints of one capture."""
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
    start, end = refined["master_from_colour_start"], refined["master_from_colour"]
    turn = np.swapaxes(start[:, :3, :3], 1, 2) @ end[:, :3, :3]
    cosine = np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)
    colour, depth = recorded["colour_index"] >= 0, recorded["depth_index"] >= 0
    slip, dropped, times = refined["slip"], recorded["dropped"], recorded["times"]
    offset, sigma, bias = (
        refined[key] for key in ("time_offset", "time_offset_sigma", "depth_bias")
    )
    has_depth = refined["depth_size"][:, 0] > 0
    variance = np.einsum("cici->ci", refined["camera_covariance"])[:, _BIAS]
    bias_sigma = np.sqrt(np.maximum(variance, 0))  # 0 = none is stated
    notes = zip(recorded.text("note"), refined.text("note"), strict=True)
    # artefacts from before each camera was judged by itself have neither
    told = "camera_verdict" in refined
    slides = np.linalg.norm(refined["camera_slide"], axis=1) if told else np.full(len(end), np.nan)
    verdicts = refined.text("camera_verdict") if told else [""] * len(end)
    result = []
    for c, (name, words) in enumerate(zip(recorded.text("camera_names"), notes, strict=True)):
        there = np.flatnonzero(colour[:, c] | depth[:, c])
        first, last = times[there[[0, -1]]] if len(there) else (np.nan, np.nan)
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
    told = scene.attributes
    if not told["ground_found"]:
        words = f"no floor was seen or annotated, upright by {told.get('up_source', 'a hint')}"
    elif told["ground_source"] == "stated":
        words = "as stated with the calibration"
    else:
        words = f"{told['ground_source']}, {int(told['ground_inliers']):,} points support it"
        rms = 1e3 * float(told["ground_rms"])
        words += f", RMS {rms:.1f} mm" if np.isfinite(rms) else ""
    return f"{words}; {told['ground_note']}" if "ground_note" in told else words


def _pair_charts(pairs: Sequence[Pair]) -> list[tuple[str, str]]:
    """Residuals of the static surfaces, and of what moves: (caption, SVG)."""
    worst = sorted(pairs, key=lambda pair: -np.nan_to_num(pair.after, nan=-1.0))[:_MAX_PAIRS]
    shown = [pair for pair in pairs if pair in worst]
    static = [(pair, pair.before, pair.after, pair.points) for pair in shown]
    moving = [(pair, *pair.moving) for pair in shown]
    return [
        (
            what,
            charts.bar_pairs(
                [
                    charts.BarPair(
                        pair.name, 1e3 * before, 1e3 * after, f"{points:,} points", pair.weak
                    )
                    for pair, before, after, points in rows
                ],
                "median distance, mm",
            ),
        )
        for what, rows in (("static surfaces", static), ("the person and what moves", moving))
        if any(points for *_, points in rows)
    ]


def _timeline(facts: CaptureFacts) -> str:
    rows = []
    for camera in facts.cameras:
        said = [
            f"slipped by {slip}" if state == "slipped" else state
            for state, slip in zip(camera.state, camera.slip, strict=True)
        ]
        runs = []
        for first, last, words in flags.ranges(said):
            state, _, frames = words.partition(" by ")
            at = f"{first}" if first == last else f"{first}–{last}"
            late = f", {frames} {_frames(int(frames))} before" if frames else ""
            runs.append((first, last, state, f"{at}: {_WORDS[state]}{late}"))
        rows.append(charts.StateRow(camera.name, runs, _beside(camera)))
    marks = [(t, f"{count} {_sets(count)} without any image") for t, count in facts.gaps]
    return charts.state_timeline(rows, len(facts.times), marks)


def _beside(camera: CameraFacts) -> str:
    """What is written at the end of a camera's row of the timeline."""
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
    """By how many frames its images are late, e.g. "slipped by 2 or 3"."""
    late = {
        slip for state, slip in zip(camera.state, camera.slip, strict=True) if state == "slipped"
    }
    return f"slipped by {' or '.join(map(str, sorted(late)))}"


def _offset(camera: CameraFacts) -> str:
    if not np.isfinite(camera.offset_sigma):
        return ""
    return f"{1e3 * camera.offset:+.1f} ± {1e3 * camera.offset_sigma:.1f}"


def _bias(camera: CameraFacts) -> str:
    """Millimetres, with its deviation where one is stated; "" of a camera without depth."""
    if not np.isfinite(camera.depth_bias):
        return ""
    words = f"{1e3 * camera.depth_bias:.1f}"
    sigma = camera.depth_bias_sigma
    return f"{words} ± {1e3 * sigma:.1f}" if np.isfinite(sigma) else words


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
    """The floor before and after on one scale: (caption, SVG)."""
    every = [profile for profiles in drawn.profiles for profile in profiles]
    if not every:
        return []
    top = max(_LEAST_PROFILE_MM, *(1e3 * float(np.abs(p.height).max()) for p in every))
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
    profiles: Sequence[FloorProfile],
    x_range: tuple[float, float],
    top: float,
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
