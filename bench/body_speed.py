"""Compare the body's fit with the paper's recipe, and the body model with other packages.

    python -m bench.body_speed [config/bench/config.yaml] [--output results/bench.json]

Needs the artefacts of ``intercap dev bench``.
Both methods read the same keypoints, clouds and cameras
of the first sequence, decoded in advance, start from the same triangulated joints and use the same
number of threads. The recipe is measured as published, with all its stages in every frame, and in
its fastest form: each frame continues from the frame before with the last stage only, and stops
when the truth says that it is as accurate as ours or at its best. Adds figures with keys
``body.<measure>`` to the output.

The body model's forward pass is compared with `body-models` (Apache-2.0) and `smplfitter` (MIT) on
one file, for all vertices of 32 bodies. The `smplx` package is licensed for non-commercial research
only and is not measured.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bench.timing import THREADS, first_as_good  # before the numerical libraries

# isort: split

import numpy as np
import torch
from rich.progress import track
from torch import Tensor

from bench.body_baseline import STAGES, FrameFit, fit_by_lbfgs
from bench.clips import BodyClip
from bench.command import from_command_line, report_figures
from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.maps import maps_path
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body_fit.schedule import Fitter
from intercap_core.body_fit.start import place_trunk
from intercap_core.errors import UserError
from intercap_core.project import load_project

FRAMES = 6
RECIPE_FRAMES = 2  # frames fitted by the whole recipe, which is slow
SPARSE = 10  # every tenth vertex is evaluated along the recipe's path


@dataclass(frozen=True, eq=False)
class Run:
    """Time and errors of one method on N frames."""

    seconds: float  # per frame
    pve: np.ndarray  # (N,) mean vertex error, millimetres

    @property
    def pve_mm(self) -> float:
        return float(self.pve.mean())


def fit_clip(clip: BodyClip) -> Run:
    """Fit all frames of the clip as the stage does."""
    begin = time.process_time()
    fit = Fitter(clip.model, clip.seen, clip.clouds, clip.settings).run()
    seconds = time.process_time() - begin
    if len(fit.frames) != len(clip):
        raise UserError(f"{clip.seen.sequence}: frames without a person cannot be compared")
    return Run(seconds / len(clip), clip.errors(fit.vectors, fit.frames))


def fit_frames_separately(clip: BodyClip) -> Run:
    """Fit every frame separately."""
    runs = [fit_clip(clip.part(slice(t, t + 1))) for t in range(len(clip))]
    return Run(float(np.mean([r.seconds for r in runs])), np.concatenate([r.pve for r in runs]))


def initial_bodies(clip: BodyClip) -> Tensor:
    """Initial bodies (T, P) of both methods: the rest pose aligned to the triangulated trunk."""
    model, rest = clip.model, clip.model.zeros()
    keypoints = model.keypoints_of(rest)[0].double().cpu().numpy()
    pelvis = model.forward(rest, vertex_ids=np.array([0])).joints[0, 0].double().cpu().numpy()
    at = torch.as_tensor(place_trunk(keypoints, clip.seen.joints, pelvis)).to(model.template)
    vectors = model.zeros(len(at)).vector().clone()
    vectors[:, :3], vectors[:, TRANSL] = at[:, :3], at[:, 3:]
    vectors[:, 75:120], vectors[:, 120:165] = model.hand_mean
    return vectors


def run_recipe(clip: BodyClip) -> tuple[list[FrameFit], list[FrameFit]]:
    """Fits of the first frames by all stages, and of all frames but the first by the last stage.

    Every frame but the first starts from the frame before it.
    """
    start = initial_bodies(clip)[0]
    whole: list[FrameFit] = []
    short: list[FrameFit] = []
    for t in track(range(len(clip)), "the paper's recipe"):
        before = (short or whole)[-1].end if whole else start
        if t < RECIPE_FRAMES:
            whole.append(fit_by_lbfgs(clip.model, clip.seen, t, clip.clouds[t], before))
        if t:
            short.append(
                fit_by_lbfgs(clip.model, clip.seen, t, clip.clouds[t], before, STAGES[-1:])
            )
    return whole, short


def end_of_fits(clip: BodyClip, fits: list[FrameFit], first: int) -> Run:
    """Errors and times at the end of the fits of frames ``first``, ``first + 1``, ..."""
    frames = np.arange(first, first + len(fits))
    seconds = float(np.mean([fit.seconds[-1] for fit in fits]))
    return Run(seconds, clip.errors(torch.stack([fit.end for fit in fits]), frames))


def first_reaching(
    clip: BodyClip, fits: list[FrameFit], first: int, wanted: np.ndarray
) -> tuple[Run, bool]:
    """Errors and times where the fits first reach ``wanted`` (N,), else near their smallest.

    The second value tells whether every frame reached its wanted error.
    """
    seconds, errors, reached = [], [], []
    for t, fit in enumerate(fits, first):
        path = fit.vectors[fit.best]
        pve = clip.errors(path, np.full(len(path), t), step=SPARSE)
        e, is_as_good = first_as_good(pve, wanted[t])
        seconds.append(fit.seconds[e])
        errors.append(clip.errors(path[e : e + 1], np.array([t])))
        reached.append(is_as_good)
    return Run(float(np.mean(seconds)), np.concatenate(errors)), all(reached)


def measure(settings: Path, output: Path, frames: int) -> None:
    """Measure, print and add the figures to ``output``; see the module's docstring."""
    torch.set_num_threads(THREADS)
    forward = forward_times()
    project = load_project(settings)
    sequence = next(iter(project.sequences))
    recording = BodyClip.load(project, sequence)
    first = max((len(recording) - frames) // 2, 0)
    at = slice(first, first + frames)
    clip = recording.part(at)
    fit_clip(clip.part(slice(0, 2)))  # imports and warms up

    all_at_once = fit_clip(recording)
    together, alone = fit_clip(clip), fit_frames_separately(clip)
    whole, short = run_recipe(clip)
    again = fit_clip(recording)  # before and after, to average out other load
    fit = Run((all_at_once.seconds + again.seconds) / 2, all_at_once.pve[at])
    recipe, quick = end_of_fits(clip, whole, 0), end_of_fits(clip, short, 1)
    reached, is_as_good = first_reaching(clip, short, 1, fit.pve)
    figures = {
        "fps": 1 / fit.seconds,
        "fps_frames_together": 1 / together.seconds,
        "fps_one_by_one": 1 / alone.seconds,
        "pve_mm": fit.pve_mm,
        "one_by_one_pve_mm": alone.pve_mm,
        "baseline_fps": 1 / recipe.seconds,
        "baseline_pve_mm": recipe.pve_mm,
        "baseline_quick_fps": 1 / quick.seconds,
        "baseline_quick_pve_mm": quick.pve_mm,
        "baseline_until_fps": 1 / reached.seconds,
        "baseline_until_pve_mm": reached.pve_mm,
        "baseline_reaches_our_accuracy": float(is_as_good),
        "baseline_ms_per_evaluation": _milliseconds_an_evaluation(whole + short),
        "speedup_recipe": recipe.seconds / fit.seconds,
        "speedup_accuracy": reached.seconds / fit.seconds,
        "speedup": min(recipe.seconds, reached.seconds) / fit.seconds,
        "speedup_one_by_one": min(recipe.seconds, reached.seconds) / alone.seconds,
        **forward,
        "frames": len(clip),
        "threads": THREADS,
    }
    report_figures(output, "body", figures)


def _milliseconds_an_evaluation(fits: list[FrameFit]) -> float:
    return 1e3 * float(np.median(np.concatenate([np.diff(fit.seconds) for fit in fits])))


BATCH = 32
FORWARD_REPEATS = 7
AGREE_M = 1e-5
Posing = Callable[[Tensor], Tensor]  # parameter vectors (B, P) to vertices (B, V, 3)


def forward_times() -> dict[str, float]:
    """Median milliseconds by name, forward and with the gradient of a sum over the vertices.

    All pose the open body with 10 + 10 shape directions and random pose blend shapes, as many as in
    a licensed file. Raises ValueError if the vertices of a package differ from ours.
    """
    with tempfile.TemporaryDirectory() as folder:
        full, short = write_files(Path(folder))
        model = BodyModel.load(full)
        posings = {
            "forward": lambda x: model.forward(model.parameters(x)).vertices,
            "forward_body_models": _body_models(model, full),
            "forward_smplfitter": _smplfitter(model, short),
        }
    generator = torch.Generator().manual_seed(0)
    x = 0.2 * torch.randn(BATCH, model.num_parameters, generator=generator)
    found = {}
    for name, posing in posings.items():
        with torch.no_grad():
            apart = (posing(x) - posings["forward"](x)).abs().max().item()
            if apart > AGREE_M:
                raise ValueError(f"{name}: vertices differ by {apart:.1e} m")
            found[f"{name}_ms_b{BATCH}"] = _milliseconds(posing, x)
        found[f"{name}_backward_ms_b{BATCH}"] = _milliseconds(posing, x.clone().requires_grad_())
    peers = [found[f"{name}_ms_b{BATCH}"] for name in posings if name != "forward"]
    return found | {f"peer_forward_ms_b{BATCH}": min(peers)}


def write_files(folder: Path) -> tuple[Path, Path]:
    """Write the open body with pose blend shapes, with 400 and with 20 shape directions."""
    with np.load(OPEN_BODY) as file:
        arrays = {name: file[name] for name in file.files}
    shape, expression = np.split(arrays["shapedirs"].astype(np.float32), 2, axis=2)
    table = np.concatenate([shape[:, :, :10], expression[:, :, :10]], 2)
    wide = np.zeros((*table.shape[:2], 400), np.float32)
    wide[:, :, :10], wide[:, :, 300:310] = table[:, :, :10], table[:, :, 10:]
    posedirs = np.random.default_rng(3).normal(0, 2e-3, (len(table), 3, 486)).astype(np.float32)
    numbers = np.array({name: number for number, name in enumerate(JOINT_NAMES)})  # as published
    arrays |= {"posedirs": posedirs, "joint2num": numbers}
    paths = []
    for name, directions in (("full", wide), ("short", table)):
        path = folder / name / "SMPLX_NEUTRAL.npz"
        path.parent.mkdir()
        np.savez(path, **(arrays | {"shapedirs": directions}))
        maps_path(path).write_text(maps_path(OPEN_BODY).read_text())
        np.save(path.parent / "kid_template.npy", np.zeros_like(arrays["v_template"]))
        paths.append(path)
    return paths[0], paths[1]


def _body_models(model: BodyModel, path: Path) -> Posing:
    from body_models.smplx.torch import SMPLX

    peer = SMPLX(model_path=path, flat_hand_mean=True)

    def pose(x: Tensor) -> Tensor:
        params = model.parameters(x)
        turns = params.full_pose()
        return peer.forward_vertices(
            pelvis_rotation=turns[:, 0],
            body_pose=turns[:, 1:22],
            head_pose=turns[:, 22:25],
            hand_pose=turns[:, 25:],
            global_translation=params.transl,
            shape=params.betas,
            expression=params.expression,
        )

    return pose


def _smplfitter(model: BodyModel, path: Path) -> Posing:
    from smplfitter.pt import BodyModel as Peer

    peer = Peer("smplx", "neutral", str(path.parent))

    def pose(x: Tensor) -> Tensor:
        params = model.parameters(x)
        shape = torch.cat([params.betas, params.expression], 1)
        return peer(params.full_pose(), shape, params.transl)["vertices"]

    return pose


def _milliseconds(posing: Posing, x: Tensor) -> float:
    seconds = []
    for _ in range(1 + FORWARD_REPEATS):  # the first warms up
        x.grad = None
        begin = time.process_time()
        vertices = posing(x)
        if x.requires_grad:
            vertices.sum().backward()
        seconds.append(time.process_time() - begin)
    return 1e3 * statistics.median(seconds[1:])


if __name__ == "__main__":
    from_command_line(measure, (__doc__ or "").splitlines()[0], FRAMES)
