"""Pictures of an ablation: grasps, acceleration of a vertex, path of a contact point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.command import figure_class
from intercap_core import artefacts
from intercap_core.evaluation.contact import CONTACT_M
from intercap_core.evaluation.proximity import PosedObject
from intercap_core.evaluation.tracks import read_body, read_object
from intercap_core.evaluation.truth import Truth
from intercap_core.joint.terms.stick import local_points
from intercap_core.output.site.closeups import SIDES, closeup, holds, read_handling
from intercap_core.project import Project
from intercap_core.schemas import SCENE
from intercap_core.sequence_inputs import SequencePaths

Paths = Mapping[str, Mapping[str, Mapping[str, Path]]]  # by variant, sequence and stage
# Variants of the ablation that the pictures show
EVERYTHING = "everything"
WITHOUT_CONTACT, WITHOUT_STICK = "without contact and stick", "without stick"
WITHOUT_SMOOTHNESS = "without smoothness"
_COLOURS = {"truth": "#222222", "sequential": "#b0b6bf", "without": "#e07a1f", "joint": "#2f6fdb"}
_MIN_HOLD_S = 0.5  # shorter holds have no path to look at
_HEAD_PX, _INK = 24, (52, 44, 40)


def draw_pictures(project: Project, paths: Paths, folder: Path) -> list[Path]:
    """Draw the pictures that the computed variants allow into ``folder``; returns their paths.

    Raises UserError where matplotlib is not installed.
    """
    figure = figure_class()
    folder.mkdir(parents=True, exist_ok=True)
    drawn = [
        _grasps(project, paths, folder / "grasps.jpg"),
        _accelerations(project, paths, folder / "acceleration.png", figure),
        _contact_paths(project, paths, folder / "contact_path.png", figure),
    ]
    return [path for path in drawn if path is not None]


def _grasps(project: Project, paths: Paths, output: Path) -> Path | None:
    """The longest grasp of every sequence, with and without contact and stick, and the truth."""
    if not {EVERYTHING, WITHOUT_CONTACT} <= set(paths):
        return None
    sheets = []
    for name, by_stage in paths[EVERYTHING].items():
        handling = read_handling(
            SequencePaths(**by_stage),
            project.models(name),
            truth=project.sequences[name].truth,
            joints={
                "no contact/stick": paths[WITHOUT_CONTACT][name]["joint"],
                "joint": by_stage["joint"],
            },
        )
        for hold in holds(handling.probability)[:1]:
            picture = closeup(handling, hold)
            sheet = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_COLOR)
            head = np.full((_HEAD_PX, sheet.shape[1], 3), 255, np.uint8)
            words = f"{name}: {hold.caption}".replace("–", "-")
            cv2.putText(head, words, (3, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _INK, 1, cv2.LINE_AA)
            sheets += [head, sheet]
    if not sheets:
        return None
    cv2.imwrite(str(output), np.vstack(sheets), [cv2.IMWRITE_JPEG_QUALITY, 85])
    return output


@dataclass(frozen=True, eq=False)
class _Track:
    """Skin (T, V, 3) and object poses of one variant, master frame, metres."""

    skin: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray

    def local(self, vertex: int) -> np.ndarray:
        """Path (T, 3) of a skin vertex in the object's frame."""
        points = self.skin[:, vertex : vertex + 1].astype(np.float64)
        return local_points(points, self.rotation, self.translation)[:, 0]


@dataclass(frozen=True, eq=False)
class _Known:
    """One sequence: tracks by variant (and "truth"), ``fps`` and the body's ``regions``."""

    tracks: Mapping[str, _Track]
    truth: Truth
    regions: Mapping[str, np.ndarray]
    fps: float


def _read(project: Project, paths: Paths, sequence: str, versions: Mapping[str, str]) -> _Known:
    """Read the variants of a sequence; "" stands for the sequential fits."""
    row, models = project.sequences[sequence], project.config.body_models
    gender = project.subjects[row.subject].gender
    tracks, model = {}, None
    for name, variant in versions.items():
        by_stage = paths[variant or EVERYTHING][sequence]
        stages = ("joint", "joint") if variant else ("body_fit", "object_track")
        body = read_body(by_stage[stages[0]], stages[0], models, gender)
        pose = read_object(by_stage[stages[1]], stages[1])
        tracks[name] = _Track(np.stack(list(body.vertices())), pose.rotation, pose.translation)
        model = body.model
    assert model is not None and row.truth is not None
    with artefacts.read(paths[EVERYTHING][sequence]["scene"], SCENE) as scene:
        times, fps = scene["times"], float(scene.attributes["fps"])
    truth = Truth.load(row.truth, times, fps, model.num_vertices)
    assert truth.vertices is not None
    tracks["truth"] = _Track(truth.vertices, truth.rotation, truth.translation)
    regions = {name: np.asarray(ids) for name, ids in model.regions.items()}
    return _Known(tracks, truth, regions, fps)


def _accelerations(project: Project, paths: Paths, output: Path, figure: Any) -> Path | None:
    """Acceleration over time, in each sequence, of the skin vertex whose acceleration smoothing
    changes most, for better or worse; the legend has the mean errors against truth."""
    if not {EVERYTHING, WITHOUT_SMOOTHNESS} <= set(paths):
        return None
    versions = {"without smoothness": WITHOUT_SMOOTHNESS, "joint": EVERYTHING}
    names = list(paths[EVERYTHING])
    sheet = figure(figsize=(9, 2.3 * len(names)), layout="constrained")
    rows = np.atleast_1d(sheet.subplots(len(names), 1))
    for axes, name in zip(rows, names, strict=True):
        found = _read(project, paths, name, versions)
        every = {
            label: np.diff(track.skin, n=2, axis=0) * np.float32(found.fps**2)
            for label, track in found.tracks.items()
        }
        change = np.linalg.norm(every["joint"] - every["without smoothness"], axis=2)
        vertex = int(change.mean(0).argmax())
        for label, vectors in every.items():
            size = np.linalg.norm(vectors[:, vertex], axis=1)
            off = np.linalg.norm((vectors - every["truth"])[:, vertex], axis=1).mean()
            words = label if label == "truth" else f"{label}, off by {off:.1f} m/s²"
            when = (np.arange(len(size)) + 1) / found.fps
            axes.plot(when, size, label=words, color=_colour(label), linewidth=1.4)
        region = next((r for r, ids in found.regions.items() if vertex in ids), "skin")
        axes.set(ylabel="m/s²", title=f"{name}: a vertex of the {region.replace('_', ' ')}")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    rows[-1].set_xlabel("seconds; acceleration of the vertex that smoothing changes most")
    sheet.savefig(output, dpi=110, metadata={"Software": None})
    return output


def _contact_paths(project: Project, paths: Paths, output: Path, figure: Any) -> Path | None:
    """Where the vertex that truly touches longest goes in the object's frame while it does, from
    the middle of the true path; a large dot is its begin."""
    if not {EVERYTHING, WITHOUT_STICK} <= set(paths):
        return None
    versions = {"sequential": "", "without stick": WITHOUT_STICK, "joint": EVERYTHING}
    known = _held(project, paths, versions)
    if not known:
        return None
    sheet = figure(figsize=(4.2 * len(known), 5.8), layout="constrained")
    columns = np.atleast_1d(sheet.subplots(1, len(known)))
    for axes, (name, (found, vertex, frames)) in zip(columns, known.items(), strict=True):
        local = {label: track.local(vertex)[frames] for label, track in found.tracks.items()}
        start = local["truth"].mean(0)
        spread = np.concatenate([path - path.mean(0) for path in local.values()])
        plane = np.linalg.svd(spread, full_matrices=False)[2][:2]
        for label, path in local.items():
            x, y = 1e3 * plane @ (path - start).T
            length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
            axes.plot(x, y, label=f"{label}, {1e3 * length:.0f} mm", color=_colour(label),
                      linewidth=1.2, marker=".", markersize=3)  # fmt: skip
            axes.plot(x[0], y[0], "o", color=_colour(label), markersize=5)
        drawn = 1e3 * np.concatenate([path - start for path in local.values()]) @ plane.T
        middle, reach = (drawn.max(0) + drawn.min(0)) / 2, 0.54 * np.ptp(drawn, axis=0).max()
        axes.set(
            title=f"{name}\na contact point on the object", xlabel="mm", aspect="equal",
            xlim=(middle[0] - reach, middle[0] + reach),
            ylim=(middle[1] - reach, middle[1] + reach),
        )  # fmt: skip
        axes.grid(alpha=0.3)
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.13), "ncols": 2}
        axes.legend(fontsize="small", title="length of the path", title_fontsize="small", **below)
    columns[0].set_ylabel("mm")
    sheet.savefig(output, dpi=110, metadata={"Software": None})
    return output


def _held(
    project: Project, paths: Paths, versions: Mapping[str, str]
) -> dict[str, tuple[_Known, int, np.ndarray]]:
    """By sequence in which a hand truly holds the object: what is known, the skin vertex of the
    hands that truly touches it longest, and the frames in which it does."""
    found = {}
    for name in paths[EVERYTHING]:
        known = _read(project, paths, name, versions)
        true, skin = known.truth, known.tracks["truth"].skin
        hands = np.concatenate([known.regions[f"{side}_hand"] for side in SIDES])
        surface = PosedObject(true.object_vertices, true.object_faces)
        touching = np.stack(
            [
                surface.signed_distance(
                    points[hands].astype(np.float64), true.rotation[t], true.translation[t]
                )
                < CONTACT_M
                for t, points in enumerate(skin)
            ]
        )
        longest = int(touching.sum(0).argmax())
        frames = np.flatnonzero(touching[:, longest])
        if len(frames) >= _MIN_HOLD_S * known.fps:
            found[name] = (known, int(hands[longest]), frames)
    return found


def _colour(label: str) -> str:
    return next(colour for name, colour in _COLOURS.items() if label.startswith(name))
