"""What the surface's colours say of the hypotheses that shape and motion leave open.

Colours that are learnt while tracking are relative to the poses they are learnt with: where a turn
is open in all frames alike, they decide nothing, but they keep one side of the object from being
taken for the other half way. So they are learnt once for each pose that one frame leaves open, and
what follows from each counts by its evidence. Colours that the mesh brings have no such freedom.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from intercap_core.geometry.rigid.shots import Shot, Surface
from intercap_core.object_track.appearance import LIGHT, Appearance, Sighting
from intercap_core.object_track.candidates import choose
from intercap_core.object_track.constants import (
    ABSENT_LOG_RATIO,
    ASSESS_MIN_OVERLAP,
    COLOUR_EVERY_S,
    ERROR_LASTING_S,
    GAUGES,
    KEY_FRAME_S,
    LEARNING_FRAMES,
    LEARNING_FRAMES_MIN,
    PAINT_LOOKS,
    PATCHES_ACROSS,
    RIVAL_PROBABILITY,
    STEEP_COSINE,
    SURE_PROBABILITY,
    WEAK_GAUGE,
)
from intercap_core.object_track.decoder import NOT_SEEN, Decoded, given, mixed
from intercap_core.object_track.fit import Fit, seen_by
from intercap_core.object_track.hypotheses import Hypotheses
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.surface_kernel import seen_patches


class ColourDecision:
    """Decides anew where colours tell hypotheses apart; ``share`` is how many independent
    observations a frame is, ``step_s`` the seconds between two."""

    def __init__(
        self, observer: Observer, hypotheses: Hypotheses, share: float, step_s: float
    ) -> None:
        self._observer = observer
        self._hypotheses = hypotheses
        self._share = share
        self._apart = max(1, round(ERROR_LASTING_S / step_s))
        self._every = max(1, round(COLOUR_EVERY_S / step_s))
        self._keys = max(1, round(KEY_FRAME_S / step_s))
        self._size = observer.mesh.diameter / PATCHES_ACROSS
        self._seen: dict[tuple[int, int], Sighting | None] = {}
        self._pictures: tuple[int, list[np.ndarray | None]] | None = None

    def decide(
        self, emissions: Sequence[np.ndarray], steps: Sequence[np.ndarray], decoded: Decoded
    ) -> Decoded:
        """``decoded`` from these (see :func:`.decoder.decode`), and what colours add to it."""
        sure = np.array(
            [0.0 if k == NOT_SEEN else p[k]
             for p, k in zip(decoded.probability, decoded.path, strict=True)]
        )  # fmt: skip
        first = int(sure.argmax())
        if self._observer.pictures is None or not sure[first]:
            return decoded
        own = decoded.probability[first][:-1]
        absent = self._share * ABSENT_LOG_RATIO
        gauges = [int(k) for k in np.argsort(-own)[:GAUGES] if own[k] > RIVAL_PROBABILITY]
        relative = {k: given(emissions, steps, first, k, absent) for k in gauges}
        rivals = self._open(list(relative.values()))
        if not gauges or (not rivals and (self._observer.paint is None or len(gauges) == 1)):
            return decoded
        learnt = {k: self._learn(one) for k, one in relative.items()}
        if any(learnt[k] is None and own[k] > WEAK_GAUGE for k in gauges):
            return decoded
        found = []
        for k, colours in learnt.items():
            if colours is not None:
                values = self._added(emissions, colours, rivals)
                again = given(values, steps, first, k, absent)
                found.append(replace(again, evidence=again.evidence + self._painted(colours)))
        return mixed(found) if found else decoded

    def _open(self, relative: Sequence[Decoded]) -> dict[int, np.ndarray]:
        """The hypotheses of each frame whose choice is open in any of these, some frames left out
        that are near others; all of them are asked about the same."""
        found = {}
        for t in range(0, len(relative[0].path) if relative else 0, self._every):
            likely = np.array([one.probability[t][:-1] > RIVAL_PROBABILITY for one in relative])
            if any(
                own.sum() > 1 or (own.any() and one.path[t] == NOT_SEEN)
                for one, own in zip(relative, likely, strict=True)
            ):
                found[t] = np.flatnonzero(likely.any(0))
        return found

    def _learn(self, decoded: Decoded) -> Appearance | None:
        """The colours of certain frames; None where there are too few."""
        certain = [
            t
            for t in range(0, len(decoded.path), self._keys)
            if decoded.path[t] != NOT_SEEN
            and decoded.probability[t][decoded.path[t]] > SURE_PROBABILITY
        ]
        some = np.linspace(0, len(certain) - 1, min(len(certain), LEARNING_FRAMES)).round()
        seen = [self._sighting(certain[i], decoded.path[certain[i]]) for i in some.astype(int)]
        kept = [one for one in seen if one is not None]
        if len(kept) < LEARNING_FRAMES_MIN:
            return None
        views = len(self._observer.views(kept[0].frame))
        return Appearance(kept, views, self._observer.paint, self._size)

    def _painted(self, learnt: Appearance) -> float:
        """What the mesh's own colours say for the poses of the frames that were learnt from: where
        they are wrong they are so in all frames, which count as a few looks."""
        return PAINT_LOOKS * float(np.mean([learnt.paint_log_ratio(s) for s in learnt.sightings]))

    def _added(
        self,
        emissions: Sequence[np.ndarray],
        learnt: Appearance,
        rivals: Mapping[int, np.ndarray],
    ) -> list[np.ndarray]:
        """The emissions with what the learnt colours say where the choice is open."""
        values = [own.copy() for own in emissions]
        if learnt.says_something:
            for t, some in rivals.items():
                seen = {int(k): self._sighting(t, int(k)) for k in some}
                ratio = {
                    k: self._share * learnt.log_ratio(one, self._apart)
                    for k, one in seen.items()
                    if one is not None
                }
                # what was not looked at is no better for it
                values[t] += min([0.0, *ratio.values()])
                for k, found in ratio.items():
                    values[t][k] = emissions[t][k] + found
        return values

    # --- seeing --------------------------------------------------------------------------------

    def _sighting(self, t: int, k: int) -> Sighting | None:
        """What frame t shows at its hypothesis k; None where it shows nothing of it."""
        if (t, k) not in self._seen:
            self._seen[t, k] = self._look(t, self._hypotheses.fits[t][k])
        return self._seen[t, k]

    def _look(self, t: int, fit: Fit) -> Sighting | None:
        observer, mesh = self._observer, self._observer.mesh
        assert observer.pictures is not None
        if self._pictures is None or self._pictures[0] != t:
            self._pictures = (t, observer.pictures(t))
        views, pictures = observer.views(t), self._pictures[1]
        poses = seen_by(fit.pose, views, fit.twist)
        shots = [
            Shot(view.geometry.lens, view.geometry.colour_from_master @ pose)
            for view, pose in zip(views, poses, strict=True)
        ]
        parts = []
        for number, (view, shot, drawn) in enumerate(
            zip(views, shots, observer.renderer.draw(Surface.of(mesh), shots), strict=True)
        ):
            picture = pictures[number]
            candidate = choose(view, drawn, ASSESS_MIN_OVERLAP, observer.labels)
            if picture is None or candidate is None:
                continue
            patch, face, colour = seen_patches(
                drawn.depth, drawn.face, drawn.x0, drawn.y0,
                candidate.mask.mask, candidate.mask.x0, candidate.mask.y0,
                shot.lens.rays, picture, LIGHT, np.linalg.inv(shot.camera_from_mesh),
                mesh.face_normals, self._size, STEEP_COSINE,
            )  # fmt: skip
            if len(patch):
                normals = mesh.face_normals[face] @ poses[number][:3, :3].T
                parts.append((number, *_by_patch(patch, colour, normals)))
        if not parts:
            return None
        number, patch, colour, normal, pixels = zip(*parts, strict=True)
        of_view = np.repeat(number, [len(p) for p in patch])
        return Sighting(
            t,
            np.concatenate(patch),
            np.concatenate(colour),
            np.concatenate(normal),
            of_view,
            np.concatenate(pixels),
        )


def _by_patch(
    patch: np.ndarray, colour: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Patches (N,), their mean colours (N, 3), unit normals (N, 3) and pixels (N,)."""
    kept, at, pixels = np.unique(patch, return_inverse=True, return_counts=True)
    mean, normal = (
        np.stack([np.bincount(at, values[:, k], len(kept)) for k in range(3)], 1) / pixels[:, None]
        for values in (colour, normals)
    )
    return kept, mean, normal / np.linalg.norm(normal, axis=1, keepdims=True), pixels.astype(float)
