"""What one frame's depth and masks say of each sample of the skin, camera by camera: E_D.

Points of the person meet the surface (:mod:`intercap_core.body_fit.body_cloud`), vertices that a
camera looks past stick out (:mod:`.free_space`), and rims of masks touch (:mod:`.outlines`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body_fit import body_cloud
from intercap_core.body_fit.body_cloud import Matches
from intercap_core.body_fit.body_samples import Samples
from intercap_core.body_fit.body_surface import Surface
from intercap_core.body_fit.constants import CLOUD_HUBER_M, FREE_SPACE_TRUST, OUTLINE_TRUST
from intercap_core.body_fit.free_space import seen_through
from intercap_core.body_fit.observations import PersonCloud
from intercap_core.body_fit.outlines import RimSamples, touching
from intercap_core.geometry.camera.rig import Rig


class Skin(NamedTuple):
    """A posed body: vertices and normals (R,3) of the surface, ``where`` (S,3) its samples are, and
    how far they move until each camera exposes, ``late`` (C,S,3) or None; metres, master frame."""

    vertices: Tensor
    normals: Tensor
    where: Tensor
    late: Tensor | None


class FrameMatches(NamedTuple):
    """By camera and sample: mean distance (C,S), metres, and effective number of points (C,S), 0 =
    none. ``residual``: median distance of the depth's points; measured (S,): who had some."""

    distance: Tensor
    points: Tensor
    residual: Tensor
    measured: Tensor


@dataclass(frozen=True, eq=False)
class Matcher:
    """Of a ``surface`` whose samples are ``sample`` (S,) with patches (S,20), places among its
    vertices; ``rims``: those that masks tell of."""

    surface: Surface
    sample: Tensor
    patch: Tensor
    rims: RimSamples

    @classmethod
    def of(cls, samples: Samples, surface: Surface, device: torch.device) -> Matcher:
        """For the samples of a surface."""
        sample, patch = (
            torch.as_tensor(places, device=device) for places in (surface.sample, surface.patch)
        )
        return cls(surface, sample, patch, RimSamples.of(samples, surface))

    def match(
        self,
        cloud: PersonCloud,
        rig: Rig,
        depth_bias: np.ndarray,
        skin: Skin,
        expected: Tensor,
        reach: float,
    ) -> FrameMatches:
        """One frame's ``cloud`` through cameras with ``depth_bias`` (C,), metres.

        ``expected`` (C*S,) thickness of what is worn; nothing counts beyond ``reach`` metres.
        """
        points = self._points(cloud, skin, reach)
        parts = [
            # gathered by camera and sample: those that several cameras see tell their offsets
            (points._replace(sample=self._row(cloud.view, points.sample)), cloud.trust),
            self._sticking_out(cloud, rig, depth_bias, skin),
            self._on_rims(cloud, rig, skin, reach),
        ]
        every = Matches(*map(torch.cat, zip(*(matches for matches, _ in parts), strict=True)))
        trust = torch.cat([trust for _, trust in parts])
        distance, number = body_cloud.gather(
            every, trust, expected, len(expected), huber=CLOUD_HUBER_M
        )
        measured = torch.zeros_like(self.sample, dtype=torch.bool)
        measured[points.sample[points.valid]] = True
        return FrameMatches(
            distance.reshape(len(rig), -1),
            number.reshape(len(rig), -1),
            points.distance[points.valid].abs().nanmedian(),
            measured,
        )

    def _row(self, view: Tensor | int, sample: Tensor) -> Tensor:
        return view * len(self.sample) + sample

    def _points(self, cloud: PersonCloud, skin: Skin, reach: float) -> Matches:
        """The depth's points, by sample."""
        if skin.vertices.device.type == "cpu":
            found = body_cloud.match_compiled(
                cloud.points, cloud.normals, skin.vertices, skin.normals, self.surface, reach
            )
        else:
            found = body_cloud.match(
                cloud.points, cloud.normals, skin.vertices, skin.normals, self.sample, self.patch,
                reach,
            )  # fmt: skip
        if skin.late is None:
            return found
        outward = skin.normals[self.sample[found.sample]]
        moved = (skin.late[cloud.view, found.sample] * outward).sum(1)
        return found._replace(distance=found.distance - moved)

    def _sticking_out(
        self, cloud: PersonCloud, rig: Rig, depth_bias: np.ndarray, skin: Skin
    ) -> tuple[Matches, Tensor]:
        """Samples that a camera looks past, by camera and sample, and their trust."""
        outward = skin.normals[self.sample].cpu().numpy()
        found = []
        for window in cloud.windows:
            view = window.view
            late = skin.where if skin.late is None else skin.where + skin.late[view]
            out, inside = seen_through(
                window, rig[view], float(depth_bias[view]), late.cpu().numpy(), outward
            )
            found.append((view, out, -inside))
        return self._certain(found, skin, FREE_SPACE_TRUST)

    def _on_rims(
        self, cloud: PersonCloud, rig: Rig, skin: Skin, reach: float
    ) -> tuple[Matches, Tensor]:
        """Samples that the rims of masks touch, by camera and sample, and their trust."""
        vertices, normals = skin.vertices.cpu().numpy(), skin.normals.cpu().numpy()
        found = []
        for rim in cloud.outlines:
            late = None if skin.late is None else skin.late[rim.view].cpu().numpy()
            pose = rig[rim.view].master_from_colour
            at, apart = touching(rim, pose, vertices, normals, self.rims, reach, late)
            found.append((rim.view, at, apart))
        return self._certain(found, skin, OUTLINE_TRUST)

    def _certain(
        self, found: list[tuple[int, np.ndarray, np.ndarray]], skin: Skin, trust: float
    ) -> tuple[Matches, Tensor]:
        """Matches of samples (M,) at distances (M,), view by view, each trusted so much."""
        where = skin.where
        sample, distance = [self.sample[:0]], [where[:0, 0]]
        for view, at, apart in found:
            sample.append(self._row(view, torch.as_tensor(at, device=where.device)))
            distance.append(torch.as_tensor(apart, dtype=where.dtype, device=where.device))
        every = torch.cat(sample)
        matches = Matches(every, torch.cat(distance), torch.ones_like(every, dtype=torch.bool))
        return matches, where.new_full((len(every),), trust)
