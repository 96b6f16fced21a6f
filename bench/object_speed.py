"""Compare the object's tracker with the paper's recipe: milliseconds per frame and errors.

    python -m bench.object_speed [config/bench/config.yaml] [--output results/bench.json]

Needs the artefacts of ``intercap dev bench``.
On its first sequence shorter schedules of the baseline
are measured too. Then tracker and recipe are compared on ``--frames`` frames of one recording of
each object (config/object; recordings that do not exist are made). Both get the same frames,
decoded and reduced in advance, the same first pose (the true pose with an error of 10 mm and 5
degrees) and the same number of threads. Adds figures with keys ``object.<measure>`` to the output.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from bench.timing import AS_GOOD, NEAR_BEST, THREADS  # before the numerical libraries

# isort: split
import numpy as np
import torch
from rich.progress import track

from bench.clips import ObjectClip
from bench.command import from_command_line, report_figures
from bench.object_baseline import FrameFit, Recipe, fit_by_adam
from intercap_core.commands.run import run_workflow
from intercap_core.errors import UserError
from intercap_core.evaluation.object_pose import LOST_ROTATION_DEG, LOST_TRANSLATION_M
from intercap_core.object_track.fit import FIT_ROUNDS, MotionPrior
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.motion import extrapolate, predict_prior
from intercap_core.object_track.tracker import Tracker
from intercap_core.object_track.view import View
from intercap_core.project import load_project

FRAMES = 20
RECORDINGS = Path("config/object/config.yaml")  # one recording of each object
REPEATS = 3  # of measurements, whose median is reported
# Adam steps a frame (400 / 150 times as many in the first) and learning rate in metres, twice that
# in radians. Chosen on recordings that are not measured here.
SCHEDULES = {5: (4e-3, 8e-3), 10: (4e-3, 8e-3), 20: (2e-3, 4e-3), 40: (2e-3, 4e-3), 75: (2e-3,)}


@dataclass(frozen=True)
class Run:
    """Time and errors of one method on a clip."""

    ms: float  # per frame
    translation_mm: tuple[float, float]  # median and 95th percentile
    rotation_deg: tuple[float, float]  # median and 95th percentile
    lost: float  # share of the evaluated frames
    errors: np.ndarray = field(default_factory=lambda: np.zeros((2, 0)), compare=False)  # mm, deg
    frames: int = 0  # all frames

    @classmethod
    def of(cls, clip: ObjectClip, poses: np.ndarray, seconds: float) -> Run:
        """From poses (T, 4, 4) and the total seconds."""
        millimetres, degrees = clip.errors(poses, np.arange(len(clip)))
        return cls.of_errors(
            np.stack([millimetres[clip.seen], degrees[clip.seen]]), len(clip), seconds
        )

    @classmethod
    def of_errors(cls, errors: np.ndarray, frames: int, seconds: float) -> Run:
        """From errors (2, n), the number of tracked frames and the total seconds."""
        millimetres, degrees = errors
        lost = (millimetres > 1e3 * LOST_TRANSLATION_M) | (degrees > LOST_ROTATION_DEG)
        return cls(
            1e3 * seconds / frames,
            (float(np.median(millimetres)), float(np.percentile(millimetres, 95))),
            (float(np.median(degrees)), float(np.percentile(degrees, 95))),
            float(lost.mean()),
            errors,
            frames,
        )

    @classmethod
    def pooled(cls, runs: Sequence[Run]) -> Run:
        """Pool several recordings; every frame has the same weight."""
        seconds = sum(1e-3 * run.ms * run.frames for run in runs)
        errors = np.concatenate([run.errors for run in runs], axis=1)
        return cls.of_errors(errors, sum(run.frames for run in runs), seconds)

    def figures(self, prefix: str) -> dict[str, float]:
        """Errors and lost frames by key."""
        return {
            f"{prefix}translation_median_mm": self.translation_mm[0],
            f"{prefix}translation_p95_mm": self.translation_mm[1],
            f"{prefix}rotation_median_deg": self.rotation_deg[0],
            f"{prefix}rotation_p95_deg": self.rotation_deg[1],
            f"{prefix}lost_share": self.lost,
        }

    def as_good_as(self, other: Run) -> bool:
        """Whether no median or p95 is worse by more than 2 % and no more frames are lost."""
        mine, its = ((*r.translation_mm, *r.rotation_deg) for r in (self, other))
        near = all(a <= AS_GOOD * b for a, b in zip(mine, its, strict=True))
        return near and self.lost <= other.lost


def _given(start: np.ndarray) -> GivenPose:
    """The first frame's pose as an annotation, with an annotation's standard deviations."""
    return GivenPose(0, start, 0.01, np.radians(5.0))


def run_tracker(clip: ObjectClip, start: np.ndarray | None, repeats: int = REPEATS) -> Run:
    """Run the whole stage; without ``start`` it searches the first pose."""
    seconds, poses = [], np.zeros(0)
    for _ in range(repeats if start is not None else 1):
        tracker = Tracker(clip.observer())
        begin = time.process_time()
        track = tracker.run([] if start is None else [_given(start)])
        seconds.append(time.process_time() - begin)
        poses = np.array([frame.fit.pose for frame in track.frames])
    return Run.of(clip, poses, statistics.median(seconds))


def run_single_pass(clip: ObjectClip, start: np.ndarray) -> Run:
    """Fit each frame once in order, as the paper does, without the stage's other steps."""
    seconds, poses = [], np.zeros(0)
    for _ in range(REPEATS):
        observer = clip.observer()
        begin = time.process_time()
        fit = observer.fit(0, start, MotionPrior(start), rounds=FIT_ROUNDS, scale=1.0)
        found = [fit.pose, fit.pose]  # before the first frame it rested
        for t in range(1, len(clip)):
            before, now = found[-2:]
            guess = extrapolate(before, now)
            found.append(
                observer.fit(t, guess, predict_prior(before, now, guess, clip.step_s)).pose
            )
        poses = np.array(found[1:])
        seconds.append(time.process_time() - begin)
    return Run.of(clip, poses, statistics.median(seconds))


def run_recipe(clip: ObjectClip, start: np.ndarray, recipe: Recipe) -> Run:
    """Run the baseline; each frame starts at the pose that the tracker would extrapolate."""
    begin, before, now = time.process_time(), start, start
    poses: list[np.ndarray] = []
    for views in clip.views:
        guess = extrapolate(before, now)
        fit = fit_frame(clip, views, guess, recipe, recipe.steps if poses else recipe.first_steps)
        before, now = (now if poses else fit.poses[-1]), fit.poses[-1]
        poses.append(now)
    return Run.of(clip, np.array(poses), time.process_time() - begin)


def fit_frame(
    clip: ObjectClip, views: list[View], pose: np.ndarray, recipe: Recipe, steps: int
) -> FrameFit:
    """The baseline's fit of one frame with the clip's mesh and settings."""
    return fit_by_adam(
        clip.mesh,
        views,
        pose,
        recipe,
        steps,
        min_overlap=clip.settings.min_overlap,
        labels=clip.labels,
    )


def run_schedules(clip: ObjectClip, start: np.ndarray) -> list[tuple[int, Run]]:
    """Run the baseline with each schedule; returns (steps per frame, result), fewest first."""
    found = []
    for steps, rates in SCHEDULES.items():
        first = steps * Recipe.first_steps // Recipe.steps
        for rate in rates:
            recipe = Recipe(first, steps, learning_rate_m=rate, learning_rate_rad=2 * rate)
            found.append((steps, run_recipe(clip, start, recipe)))
    return found


def shortest_as_good(ours: Run, found: list[tuple[int, Run]]) -> tuple[int, Run, bool]:
    """The shortest schedule as accurate as ours, else the shortest near the baseline's best.

    The last value tells whether it is as accurate as ours.
    """
    for steps, run in found:
        if run.as_good_as(ours):
            return steps, run, True
    fewest_lost = min(run.lost for _, run in found)
    kept = [(steps, run) for steps, run in found if run.lost == fewest_lost]
    best = min(run.translation_mm for _, run in kept)  # median, then p95
    return next((*e, False) for e in kept if e[1].translation_mm[0] <= NEAR_BEST * best[0])


def milliseconds_a_step(clip: ObjectClip, start: np.ndarray, steps: int) -> float:
    """Median duration of an Adam step in one frame."""
    fit = fit_frame(clip, clip.views[0], start, Recipe(), steps)
    return 1e3 * float(np.median(np.diff(fit.seconds)[1:]))


def measure(settings: Path, output: Path, frames: int) -> None:
    """Measure, print and add the figures to ``output``; see the module's docstring."""
    torch.set_num_threads(THREADS)
    project = load_project(settings)
    sequence = next(iter(project.sequences))
    clip = ObjectClip.load(project, sequence, frames)
    start = clip.annotated
    warm = ObjectClip.load(project, sequence, 2)  # compiles and imports
    Tracker(warm.observer()).run([_given(start)])
    milliseconds_a_step(warm, start, 3)

    ours, single = run_tracker(clip, start), run_single_pass(clip, start)
    found = run_schedules(clip, start)
    recipe = run_recipe(clip, start, Recipe())
    found.append((Recipe.steps, recipe))
    again = run_tracker(clip, start)  # before and after, to average out other load
    ours = replace(ours, ms=(ours.ms + again.ms) / 2)
    search = len(clip) * (run_tracker(clip, None).ms - ours.ms)
    steps, reached, is_as_good = shortest_as_good(ours, found)
    fast = milliseconds_a_step(clip, start, 50)
    figures = {
        "ms_per_frame": ours.ms,
        "one_pass_ms_per_frame": single.ms,
        "search_ms": max(search, 0.0),
        "baseline_ms_per_frame": recipe.ms,
        "baseline_until_ms_per_frame": reached.ms,
        "baseline_until_steps": steps,
        "baseline_reaches_our_accuracy": float(is_as_good),
        "baseline_ms_per_step": fast,
        "speedup_recipe": recipe.ms / ours.ms,
        "speedup_accuracy": reached.ms / ours.ms,
        "speedup": min(recipe.ms, reached.ms) / ours.ms,
        "speedup_one_pass": min(recipe.ms, reached.ms) / single.ms,
        **ours.figures(""),
        **single.figures("one_pass_"),
        **recipe.figures("baseline_"),
        **reached.figures("baseline_until_"),
        "frames": len(clip),
        "threads": THREADS,
    }
    compared = compare_recordings(RECORDINGS, frames)
    report_figures(output, "object", {**figures, **compared_figures(compared)})


def compare_recordings(settings: Path, frames: int) -> dict[str, tuple[Run, Run]]:
    """Our whole track and the paper's recipe on one recording of each object, by object.

    Missing recordings and artefacts are computed. Objects that fewer than two cameras see in the
    clip are skipped.
    """
    project = load_project(settings)
    targets = [str(project.artefact(name, "person")) for name in project.sequences]
    if run_workflow(settings, arguments=targets):
        raise UserError(f"{settings}: not every recording could be made; see the lines above")
    found = {}
    for sequence, row in track(project.sequences.items(), description="objects"):
        clip = ObjectClip.load(project, sequence, frames)
        if clip.seen.any():
            start = clip.annotated
            found[row.object] = (run_tracker(clip, start, 1), run_recipe(clip, start, Recipe()))
    return found


def compared_figures(found: Mapping[str, tuple[Run, Run]]) -> dict[str, float]:
    """Keys ``<object>.<measure>`` and ``all_<measure>``; the recipe's after ``baseline_``."""
    figures = {"all_objects": float(len(found))}
    groups = {f"{name}.": pair for name, pair in found.items()}
    groups["all_"] = (Run.pooled([o for o, _ in found.values()]),
                      Run.pooled([r for _, r in found.values()]))  # fmt: skip
    for prefix, pair in groups.items():
        for who, run in zip(("", "baseline_"), pair, strict=True):
            figures |= run.figures(f"{prefix}{who}")
            figures[f"{prefix}{who}ms_per_frame"] = run.ms
            figures[f"{prefix}{who}frames"] = float(run.frames)
        figures[f"{prefix}speedup_recipe"] = pair[1].ms / pair[0].ms
    nearer = (ours.translation_mm[0] < recipe.translation_mm[0] for ours, recipe in found.values())
    figures["all_nearer_count"] = float(sum(nearer))
    return figures


if __name__ == "__main__":
    from_command_line(measure, (__doc__ or "").splitlines()[0], FRAMES)
