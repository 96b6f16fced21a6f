"""Errors of the joint fit without each of its terms, or with another variant of a term.

    python -m bench.ablation [SETTINGS] [--sequences NAME ...] [--variants NAME ...]
        [--output results/ablation.json] [--folder results/ablation]

Stages `joint` and `metrics` are computed for each variant in ``VARIANTS`` from the artefacts of a
run of SETTINGS (default: those of `make evaluate-quick`, which must have run). Results that are up
to date by their content are reused, so an interrupted run continues. Prints a table, writes its
figures with keys ``<variant>.<measure>``, the table as Markdown and three pictures (grasps.jpg,
acceleration.png, contact_path.png) into the folder. No file of the project is overwritten.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column, Table

from bench.again import artefacts_of, check_run, compute_once, slug
from bench.command import exit_on_user_error, figure_class
from intercap_core import artefacts
from intercap_core.config import JointSettings
from intercap_core.evaluation.contact import CONTACT_M
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.proximity import PosedObject
from intercap_core.evaluation.tracks import read_body, read_object
from intercap_core.evaluation.truth import Truth
from intercap_core.joint.problem import TERMS
from intercap_core.joint.terms.stick import local_points
from intercap_core.output.site.closeups import SIDES, closeup, holds, read_handling
from intercap_core.project import Project, load_project
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

    Raises UserError if matplotlib is not installed.
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
            sheet = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR)
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
    """Tracks of one sequence by variant, and "truth"."""

    tracks: Mapping[str, _Track]
    """By variant."""
    truth: Truth
    regions: Mapping[str, np.ndarray]
    """Vertices of the body by region."""
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
    """Plot the acceleration of the skin vertex that smoothing changes most, for each sequence.

    The legend has the mean errors against the truth.
    """
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
    """Plot the path of the vertex with the longest true contact, in the object's frame.

    The origin is the middle of the true path; a large dot marks its start.
    """
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
    """Vertex with the longest true contact, and the frames of it, by sequence with a hold."""
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


SETTINGS = Path("config/evaluation/quick.yaml")
STAGES = ("joint", "metrics")  # what is computed for each variant
SEQUENTIAL = "sequential only"
# Settings of `joint` that differ from the project's, by the variant's name.
VARIANTS: dict[str, dict[str, Any]] = {
    EVERYTHING: {},
    "without contact": {"contact_weight": 0.0},
    WITHOUT_STICK: {"stick_weight": 0.0},
    WITHOUT_CONTACT: {"contact_weight": 0.0, "stick_weight": 0.0},
    "without planting": {"plant_weight": 0.0},
    WITHOUT_SMOOTHNESS: {"body_smoothness": 0.0, "object_smoothness": 0.0},
    "without penetration": {"penetration_weight": 0.0},
    "without ground": {"ground_weight": 0.0},
    "without drift": {"drift_weight": 0.0},
    "without cameras": {"refine_cameras": False},
    "without renewed images": {"look_again": False, "refine_cameras": False},
    "contact to annotated vertices": {"contact_to": "annotated"},
}
# Terms whose weight is in none of these variants.
VARIANTS |= {
    f"without {term.equation.symbol}": {name: 0.0}
    for term in TERMS
    for name in term.equation.settings
    if isinstance(JointSettings.model_fields[name].default, float)
    and not any(name in settings for settings in VARIANTS.values())
}


@dataclass(frozen=True)
class Measure:
    """Column of the table."""

    title: str
    """Of the column."""
    name: str
    joint: str = "joint"
    sequential: str = "body_fit"


MEASURES = (
    Measure("body PVE mm", "body_pve_mm"),
    Measure("hands in grasp mm", "hand_grasp_mpjpe_mm"),
    Measure("slip mm/s", "slip_mm_s"),
    Measure("planted mm/s", "planted_mm_s"),
    Measure("floor mm", "floor_mm"),
    Measure("acceleration body", "acceleration_body_mm"),
    Measure("hands", "acceleration_hands_mm"),
    Measure("object mm", "object_translation_mm", sequential="object_track"),
    Measure("p95", "object_translation_p95_mm", sequential="object_track"),
    Measure("contact by vertex", "contact_f1"),
    Measure("detected F1", "contact_detected_f1", sequential=""),
    Measure("penetration mm", "mean_mm", joint="penetration", sequential=""),
)
Figures = dict[str, float]
Paths = dict[str, dict[str, dict[str, Path]]]  # by variant, sequence and stage


def ablate(
    settings: Path, sequences: Sequence[str], variants: Sequence[str], folder: Path
) -> tuple[Paths, dict[str, Figures]]:
    """Compute all variants; returns their artefacts, and figures by variant.

    The last entry of the figures is that of the sequential fits. Raises UserError if a sequence
    or variant is unknown, or has no truth or artefacts.
    """
    plain = load_project(settings)
    names = list(sequences or plain.sequences)
    check_run(plain, names, STAGES, variants, VARIANTS)
    projects = {  # all before the first is computed, so that invalid settings fail at once
        variant: load_project(settings, {"joint": VARIANTS[variant]}) for variant in variants
    }
    paths: Paths = {}
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=Console(stderr=True),
    )  # fmt: skip
    with bar as progress:
        task = progress.add_task("", total=len(variants) * len(names))
        for variant in variants:
            paths[variant] = {}
            for name in names:
                progress.update(task, description=f"{variant}: {name}")
                begin = time.perf_counter()
                paths[variant][name] = _fit(projects[variant], name, folder / slug(variant))
                seconds = time.perf_counter() - begin
                progress.console.print(f"{variant}: {name}, {seconds:.0f} s", highlight=False)
                progress.advance(task)
    return paths, {
        **{variant: _figures(found, sequential=False) for variant, found in paths.items()},
        SEQUENTIAL: _figures(next(iter(paths.values())), sequential=True),
    }


def _fit(project: Project, sequence: str, folder: Path) -> dict[str, Path]:
    """The sequence's artefacts with joint and metrics of this variant, computed where missing."""
    paths = artefacts_of(project, sequence)
    for stage in STAGES:
        output = folder / sequence / f"{stage}.h5"
        paths[stage] = compute_once(stage, project, sequence, paths, output)
    return paths


def _figures(paths: Mapping[str, Mapping[str, Path]], *, sequential: bool) -> Figures:
    from intercap_core.commands.evaluate.sequences import areas

    found = areas([SequenceMetrics.read(by_stage["metrics"]) for by_stage in paths.values()])
    return {
        measure.name if measure.joint == "joint" else f"{measure.joint}_{measure.name}": value
        for measure in MEASURES
        if (area := measure.sequential if sequential else measure.joint)
        and (value := found[area].get(measure.name)) is not None
    }


def rows(figures: Mapping[str, Figures]) -> list[list[str]]:
    """Cells of the table, one row per variant, "–" where a figure is unknown."""
    keys = [m.name if m.joint == "joint" else f"{m.joint}_{m.name}" for m in MEASURES]
    return [
        [variant, *(_number(found[key]) if key in found else "–" for key in keys)]
        for variant, found in figures.items()
    ]


def _number(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def markdown(figures: Mapping[str, Figures], settings: Path, sequences: Sequence[str]) -> str:
    """A section for bench/RESULTS.md, without its heading's date and commit."""
    titles = ["variant", *(measure.title for measure in MEASURES)]
    lines = [
        "## What each term of the joint fit is worth",
        f"`python -m bench.ablation {settings}`, {', '.join(sequences)}. Accelerations are errors,",
        "mm a frame^2 at 30 fps; contact is F1; penetration is the joint fit's:",
        "",
        f"| {' | '.join(titles)} |",
        f"|{'---|' * len(titles)}",
        *(f"| {' | '.join(row)} |" for row in rows(figures)),
    ]
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line, compute, and write table, figures and pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("settings", type=Path, nargs="?", default=SETTINGS)
    parser.add_argument("--sequences", nargs="+", metavar="NAME", help="default: all of SETTINGS")
    parser.add_argument(
        "--variants", nargs="+", metavar="NAME", help=f"default: all, {', '.join(VARIANTS)}"
    )
    parser.add_argument("--output", type=Path, default=Path("results/ablation.json"))
    parser.add_argument("--folder", type=Path, default=Path("results/ablation"))
    options = parser.parse_args(arguments)
    with exit_on_user_error():
        names = options.sequences or list(load_project(options.settings).sequences)
        variants = options.variants or list(VARIANTS)
        paths, figures = ablate(options.settings, names, variants, options.folder)
        pictures = draw_pictures(load_project(options.settings), paths, options.folder)
    variant = Column("variant", no_wrap=True)
    table = Table(variant, *(measure.title for measure in MEASURES), box=None)
    for row in rows(figures):
        table.add_row(*row)
    console = Console()
    console.width = max(console.width, 170)
    console.print(table)
    section = options.folder / "RESULTS.md"
    section.write_text(markdown(figures, options.settings, names), encoding="utf-8")
    flat = {
        f"{slug(variant)}.{key}": round(value, 4)
        for variant, found in figures.items()
        for key, value in found.items()
    }
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(flat, indent=1) + "\n", encoding="utf-8")
    for path in (options.output, section, *pictures):
        print(path)


if __name__ == "__main__":
    main()
