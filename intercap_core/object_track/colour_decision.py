"""Decision by the surface's colours between hypotheses that shape and motion leave ambiguous.

Colours are learnt with the poses of the track. If a turn is ambiguous in all frames, the learnt
colours turn along and cannot decide it. They decide whether two frames show the same side of the
object. Colours of the mesh itself are absolute. The method:

1. The reference frame is the one with the most probable hypothesis.
2. For each of its likely hypotheses: decode the recording given that this hypothesis is true, learn
   the colours in certain frames, add their log-likelihood ratios in ambiguous frames, and decode
   again.
3. Average the results, weighted by their evidence. The mesh's own colours add to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from intercap_core.geometry.rigid.shots import Shot, Surface
from intercap_core.object_track.appearance import LIGHT, Appearance, SurfaceColours, seen_patches
from intercap_core.object_track.decoder import HIDDEN, Decoded, MarkovModel, mix_decisions
from intercap_core.object_track.evidence import ERROR_LASTING_S
from intercap_core.object_track.fit import FittedPose, seen_by
from intercap_core.object_track.hypotheses import RIVAL_PROBABILITY, Hypotheses
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.proposals import KEY_FRAME_S
from intercap_core.object_track.view_report import choose_candidate


class ColourDecision:
    """Decides again between hypotheses that colours distinguish."""

    def __init__(self, observer: Observer, hypotheses: Hypotheses) -> None:
        self._observer = observer
        self._hypotheses = hypotheses
        # metres: patches of a cup are 1 cm, two pixels at 3 m; tuned on the studio
        self._patch_size = observer.mesh.diameter / 12
        self._seen: dict[tuple[int, int], SurfaceColours | None] = {}
        self._pictures: tuple[int, list[np.ndarray | None]] | None = None

    def decide(self, model: MarkovModel, decoded: Decoded) -> Decoded:
        """Return the decision with the evidence of colours, or ``decoded`` if they cannot help.

        ``decoded`` is the result of the ``model``, which has no colours.
        """
        sure = decoded.certainty
        first = int(sure.argmax())
        if self._observer.pictures is None or not sure[first]:
            return decoded
        own = decoded.probability[first][:-1]
        # gauges: up to three likely hypotheses of the reference frame
        gauges = [int(k) for k in np.argsort(-own)[:3] if own[k] > RIVAL_PROBABILITY]
        relative = {k: model.decode_given(first, k) for k in gauges}
        rivals = self._ambiguous(list(relative.values()))
        if not gauges or (not rivals and (self._observer.paint is None or len(gauges) == 1)):
            return decoded
        learnt = {k: self._learn(result) for k, result in relative.items()}
        # an unlikely pose may have too few certain frames to learn from
        if any(learnt[k] is None and own[k] > 0.05 for k in gauges):
            return decoded
        known = {k: colours for k, colours in learnt.items() if colours is not None}
        every = self._add_colours(model.emissions, list(known.values()), rivals)
        results = []
        for (k, colours), values in zip(known.items(), every, strict=True):
            again = replace(model, emissions=values).decode_given(first, k)
            # wrong colours are wrong in all frames, so all frames count as three observations
            paint = 3 * float(np.mean([colours.paint_log_ratio(s) for s in colours.sightings]))
            results.append(replace(again, evidence=again.evidence + paint))
        return mix_decisions(results) if results else decoded

    def _ambiguous(self, relative: Sequence[Decoded]) -> dict[int, np.ndarray]:
        """Return the hypotheses to compare, by frame, for frames that any result leaves ambiguous.

        Only one frame in 1/15 s is tested. The same hypotheses are compared in all results.
        """
        every = self._observer.frames_in(1 / 15)  # nearer frames show the same colours
        rivals = {}
        for t in range(0, len(relative[0].path) if relative else 0, every):
            likely = np.array(
                [result.probability[t][:-1] > RIVAL_PROBABILITY for result in relative]
            )
            if any(
                own.sum() > 1 or (own.any() and result.path[t] == HIDDEN)
                for result, own in zip(relative, likely, strict=True)
            ):
                rivals[t] = np.flatnonzero(likely.any(0))
        return rivals

    def _learn(self, decoded: Decoded) -> Appearance | None:
        """Learn the colours of certain frames; None if there are too few."""
        sure, every = decoded.certainty, self._observer.frames_in(KEY_FRAME_S)
        certain = [t for t in range(0, len(sure), every) if sure[t] > 0.8]
        some = np.linspace(0, len(certain) - 1, min(len(certain), 12)).round()
        seen = [self._colours(certain[i], decoded.path[certain[i]]) for i in some.astype(int)]
        kept = [colours for colours in seen if colours is not None]
        if len(kept) < 3:
            return None
        views = len(self._observer.views(kept[0].frame))
        return Appearance(kept, views, self._observer.paint, self._patch_size)

    def _add_colours(
        self,
        emissions: Sequence[np.ndarray],
        learnt: Sequence[Appearance],
        rivals: Mapping[int, np.ndarray],
    ) -> list[list[np.ndarray]]:
        """Return the emissions with the evidence of each of the ``learnt`` colours.

        Only those of ambiguous frames change.
        """
        apart = self._observer.frames_in(ERROR_LASTING_S)
        result = [[own.copy() for own in emissions] for _ in learnt]
        if not any(one.is_coloured for one in learnt):
            return result
        for t, some in rivals.items():
            # measured for all of ``learnt`` at once and not kept: 100 kB a hypothesis
            seen = {int(k): self._measure(t, self._hypotheses.fits[t][k]) for k in some}
            for one, values in zip(learnt, result, strict=True):
                if not one.is_coloured:
                    continue
                ratios = {
                    k: self._observer.share * one.log_ratio(colours, apart)
                    for k, colours in seen.items()
                    if colours is not None
                }
                # hypotheses that were not compared get the worst ratio, at most 0
                values[t] += min([0.0, *ratios.values()])
                for k, ratio in ratios.items():
                    values[t][k] = emissions[t][k] + ratio
        return result

    def _colours(self, t: int, k: int) -> SurfaceColours | None:
        """Return the colours of frame t at its hypothesis k, cached; None if nothing is visible."""
        if (t, k) not in self._seen:
            self._seen[t, k] = self._measure(t, self._hypotheses.fits[t][k])
        return self._seen[t, k]

    def _measure(self, t: int, fit: FittedPose) -> SurfaceColours | None:
        """Return the colours of frame t at a pose, from all views; None if nothing is visible."""
        observer, mesh = self._observer, self._observer.mesh
        assert observer.pictures is not None
        if self._pictures is None or self._pictures[0] != t:
            self._pictures = (t, observer.pictures(t))
        views, pictures = observer.views(t), self._pictures[1]
        poses = seen_by(fit.pose, views, fit.twist)
        shots = [
            Shot(view.geometry.lens, view.geometry.camera.colour_from_master @ pose)
            for view, pose in zip(views, poses, strict=True)
        ]
        renderings = observer.context.renderer.draw(Surface.of(mesh), shots)
        steep_cosine = 0.3  # between surface and ray; below, a pixel mixes patches
        parts = []
        for number, (view, shot, drawn) in enumerate(zip(views, shots, renderings, strict=True)):
            picture = pictures[number]
            candidate = choose_candidate(view, drawn, observer.labels)
            if picture is None or candidate is None:
                continue
            patch, face, colour = seen_patches(
                drawn.depth, drawn.face, (drawn.x0, drawn.y0), candidate.mask.placed,
                shot.lens.rays, picture, LIGHT, np.linalg.inv(shot.camera_from_mesh),
                mesh.face_normals, self._patch_size, steep_cosine,
            )  # fmt: skip
            if len(patch):
                normals = mesh.face_normals[face] @ poses[number][:3, :3].T
                parts.append((number, *_average_by_patch(patch, colour, normals)))
        if not parts:
            return None
        number, patch, colour, normal, pixels = zip(*parts, strict=True)
        of_view = np.repeat(number, [len(p) for p in patch])
        patch, colour, normal, pixels = map(np.concatenate, (patch, colour, normal, pixels))
        return SurfaceColours(t, patch, colour, normal, of_view, pixels)


def _average_by_patch(
    patch: np.ndarray, colour: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return patches (N,), their mean colours (N, 3), unit normals (N, 3) and pixels (N,)."""
    kept, at, pixels = np.unique(patch, return_inverse=True, return_counts=True)
    mean, normal = (
        np.stack([np.bincount(at, values[:, k], len(kept)) for k in range(3)], 1) / pixels[:, None]
        for values in (colour, normals)
    )
    return kept, mean, normal / np.linalg.norm(normal, axis=1, keepdims=True), pixels.astype(float)
