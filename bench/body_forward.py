"""The body model beside its peers on one file: milliseconds for all vertices of 32 bodies.

The peers are `body-models` (Apache-2.0) and the model inside `smplfitter` (MIT). The `smplx`
package, the field's first, is licensed for non-commercial research alone: it is neither a
dependency nor measured.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.maps import maps_path
from intercap_core.body.model import BodyModel

BATCH = 32
REPEATS = 7
AGREE_M = 1e-5
Posing = Callable[[Tensor], Tensor]  # parameter vectors (B, P) to vertices (B, V, 3)


def forward_times() -> dict[str, float]:
    """Median milliseconds by name, forward and with the gradient of a sum over the vertices.

    All pose the open body with 10 + 10 shape directions and random pose blend shapes, as many as in
    a licensed file. Raises ValueError where a peer's vertices are others than ours.
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
    """The open body with pose blend shapes, with 400 shape directions and with 20."""
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
    for _ in range(1 + REPEATS):  # the first warms up
        x.grad = None
        begin = time.perf_counter()
        vertices = posing(x)
        if x.requires_grad:
            vertices.sum().backward()
        seconds.append(time.perf_counter() - begin)
    return 1e3 * statistics.median(seconds[1:])
