"""A picture: how the error of one frame's pose falls with time, ours and the paper's recipe."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from bench.figures import figure_class
from bench.object_baseline import Recipe, fit_by_adam
from bench.object_clip import ObjectClip
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.twist import moved
from intercap_core.object_track.fit import fit_pose

FRAMES = 10
OFF_M, OFF_DEG = 0.03, 10.0
ROUNDS = [(n,) for n in range(1, 5)] + [(4, n) for n in range(1, 6)]
STEPS = 150
FASTER = Recipe(learning_rate_m=4e-3, learning_rate_rad=8e-3)


def draw_convergence(clip: ObjectClip, output: Path) -> None:
    """Fit ``FRAMES`` frames from 3 cm and 10 degrees off the truth, in seeded directions.

    Medians over the frames against the median time from the fit's begin, everything included that
    is done for one frame. Ours are fits that were stopped after as many steps. Raises UserError
    where matplotlib is not installed.
    """
    figure_of = figure_class()

    frames = np.flatnonzero(clip.seen)
    frames = frames[np.linspace(0, len(frames) - 1, min(FRAMES, len(frames))).round().astype(int)]
    starts = [_start(clip, int(t)) for t in frames]
    lines = {"Gauss-Newton (ours)": _ours(clip, frames, starts)}
    for name, recipe in (
        ("Adam, the paper's recipe", Recipe()),
        (f"Adam, learning rate {FASTER.learning_rate_m:g}", FASTER),
    ):
        lines[name] = _baseline(clip, frames, starts, recipe)
    figure = figure_of(figsize=(7.5, 3.2), layout="constrained")
    for axes, column, label in zip(figure.subplots(1, 2), (1, 2), ("mm", "degrees"), strict=True):
        for name, points in lines.items():
            axes.plot(points[:, 0], points[:, column], label=name, marker=".", markersize=3)
        axes.set(xscale="log", yscale="log", xlabel="seconds a frame", ylabel=f"error, {label}")
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].legend(fontsize="small")
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=150, metadata={"Software": None})


def _start(clip: ObjectClip, t: int) -> np.ndarray:
    turn, shift = np.random.default_rng(t).normal(size=(2, 3))
    turn *= np.radians(OFF_DEG) / np.linalg.norm(turn)
    shift *= OFF_M / np.linalg.norm(shift)
    return moved(rigid(clip.true_rotation[t], clip.true_translation[t]), np.append(turn, shift))


def _ours(clip: ObjectClip, frames: np.ndarray, starts: list[np.ndarray]) -> np.ndarray:
    """Rows (steps, 3) of seconds, millimetres and degrees."""
    rows: list[np.ndarray] = []
    for rounds in ROUNDS:
        found: list[tuple[float, ...]] = []
        for t, start in zip(frames, starts, strict=True):
            begin = time.perf_counter()
            fit = fit_pose(
                clip.mesh,
                clip.views[t],
                start,
                prior=None,
                min_overlap=clip.settings.min_overlap,
                background_term=clip.settings.background_term,
                labels=clip.labels,
                rounds=rounds,
            )
            seconds = time.perf_counter() - begin
            found.append((seconds, *map(float, clip.errors(fit.pose, int(t)))))
        rows.append(np.median(found, axis=0))
    return np.array(rows)


def _baseline(
    clip: ObjectClip, frames: np.ndarray, starts: list[np.ndarray], recipe: Recipe
) -> np.ndarray:
    """Rows (steps, 3) as of :func:`_ours`."""
    found = []
    for t, start in zip(frames, starts, strict=True):
        fit = fit_by_adam(
            clip.mesh,
            clip.views[t],
            start,
            recipe,
            STEPS,
            min_overlap=clip.settings.min_overlap,
            labels=clip.labels,
        )
        if len(fit.poses) == STEPS + 1:  # something was seen
            found.append(np.stack([fit.seconds, *clip.errors(fit.poses, int(t))], 1)[1:])
    return np.median(found, axis=0)
