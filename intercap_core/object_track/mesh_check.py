"""Checks after tracking: whether the images show this mesh, in this size, with this symmetry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.constants import (
    CHECK_FRAMES,
    CHECK_GAIN,
    CHECK_HOPELESS,
    CHECK_SCALES,
    LIKENESS_LOG_RATIO,
    NEAR_TURN_CHANGED_SHARE,
)
from intercap_core.object_track.frame_result import FrameResult
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.turns import changed_share


def mesh_doubts(observer: Observer, frames: list[FrameResult]) -> list[str]:
    """What speaks against the mesh, in words, none where nothing does; ``frames`` (T) are the final
    track."""
    believed = [t for t, frame in enumerate(frames) if not (frame.lost or frame.carried)]
    found = []
    if believed:
        likely = float(np.median([frames[t].fit.log_ratio for t in believed]))
        if likely < LIKENESS_LOG_RATIO:
            found.append(
                f"the images hardly show this mesh ({likely:.0f} nats in half of the frames, "
                f"expected {LIKENESS_LOG_RATIO:.0f} and more); check that it is this object"
            )
    return found + _scale_doubt(observer, frames, believed) + symmetry_doubt(observer)


def symmetry_doubt(observer: Observer) -> list[str]:
    """Whether the mesh changes by a motion that is declared to leave it as it is."""
    mesh = observer.mesh
    worst = max((changed_share(mesh, observer.field, s) for s in mesh.symmetry.elements(8)[1:]),
                default=0.0)  # fmt: skip
    if mesh.symmetry.sphere or worst < NEAR_TURN_CHANGED_SHARE:
        return []
    return [
        f"its symmetry moves {worst:.0%} of the surface elsewhere; check 'symmetry' in objects.yaml"
    ]


def _scale_doubt(observer: Observer, frames: list[FrameResult], believed: list[int]) -> list[str]:
    """Whether a clearly larger or smaller mesh fits the surest frames clearly better."""
    surest = sorted(believed, key=lambda t: -frames[t].fit.log_ratio)[:CHECK_FRAMES]
    if not surest:
        return []

    def ratio(mesh: ObjectMesh) -> float:
        found = []
        for t in surest:
            fit = frames[t].fit
            found.append(observer.fit(t, fit.pose, None, mesh=mesh, twist=fit.twist).log_ratio)
        return float(np.mean(found))

    believed_ratio = float(np.mean([frames[t].fit.log_ratio for t in surest]))
    gains = {}
    for scale in CHECK_SCALES:
        other = scaled(observer.mesh, scale)
        # of the right size it is far worse before it is fitted, and need not be
        as_it_is = [
            observer.assess(t, frames[t].fit.pose, other, frames[t].fit.twist).log_ratio
            for t in surest
        ]
        if np.mean(as_it_is) > believed_ratio - CHECK_HOPELESS:
            gains[scale] = ratio(other) - ratio(observer.mesh)
    if max(gains.values(), default=0.0) < CHECK_GAIN:
        return []
    scale = max(gains, key=lambda scale: gains[scale])
    word = "larger" if scale > 1 else "smaller"
    return [
        f"the images fit a mesh {abs(scale - 1):.0%} {word} better (by {gains[scale]:.0f} nats a "
        "frame); check the mesh's size"
    ]


def scaled(mesh: ObjectMesh, scale: float) -> ObjectMesh:
    """The mesh ``scale`` times as large about its centre of mass."""
    centre = mesh.centre_of_mass
    return replace(mesh, vertices=centre + scale * (mesh.vertices - centre))
