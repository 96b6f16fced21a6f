"""What an image says of a pose: one log-likelihood ratio, wherever poses are compared.

Of a pose x and one view it is log p(image | object at x) - log p(image | object not in view), in
nats, as the sum of

- depth: every rendered pixel is measured at the object's surface, nearer (something hides it) or
  farther (it is seen past), against any depth around;
- mask: a candidate is the object's, with the distances of its outline from the render's and its
  label, or the detector missed it, which it does the less the more of it is visible.

What a person hides is no evidence, and depth that is the room's own none for the object, where no
candidate holds it. Pixels of one view err together: however many there are, they
count as the samples stated in :mod:`.constants`, as in the fit (:mod:`.view_fit`).
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.shots import Rendering
from intercap_core.object_track.constants import (
    BACKGROUND_M,
    CLUTTER_RANGE_M,
    CONTOUR_SIGMA_PX,
    DEPTH_HALF_SAMPLES_PX,
    DEPTH_LIKELY_SIGMA_M,
    LABEL_LOG_RATIO,
    LOG_HIDDEN,
    LOG_MISSED,
    LOG_SEEN_PAST,
    MASK_AGREES,
    MISSED_HALF_PX,
    OUTLINE_COST_MAX,
    OUTLINE_HALF_SAMPLES_PX,
    VIEW_SAMPLES,
)
from intercap_core.object_track.likelihood_kernel import depth_log_ratio, outline_cost
from intercap_core.object_track.reduced_mask import EMPTY
from intercap_core.object_track.view import Candidate, View


def log_ratio(
    mesh: ObjectMesh,
    view: View,
    pose: np.ndarray,
    silhouette: Rendering,
    drawn_depth: Rendering | None,
    candidate: Candidate | None,
    visible_px: int,
    labels: tuple[str, ...],
) -> float:
    """The log-likelihood ratio of a pose (4, 4), whose renderings in the view are given, nats.

    ``candidate`` is the one that overlaps most, ``visible_px`` rendered pixels that nothing hides.
    """
    found = 0.0
    if drawn_depth is not None:
        found += _depth(mesh, view, pose, drawn_depth, candidate)
    if view.detected:
        found += _mask(view, silhouette, candidate, visible_px, labels)
    return found


def _depth(
    mesh: ObjectMesh,
    view: View,
    pose: np.ndarray,
    drawn: Rendering,
    candidate: Candidate | None,
) -> float:
    geometry = view.geometry
    assert view.depth is not None and geometry.depth_lens is not None
    colour_from_depth = geometry.camera.colour_from_depth
    assert colour_from_depth is not None
    person = view.person
    mask = candidate.mask if candidate is not None else EMPTY
    total, count = depth_log_ratio(
        drawn.depth, drawn.face, drawn.x0, drawn.y0, view.depth, view.background,
        geometry.depth_lens.rays, mesh.face_normals,
        geometry.depth_from_master[:3, :3] @ pose[:3, :3],
        np.asarray(colour_from_depth), geometry.lens.parameters,
        person.mask, person.x0, person.y0, mask.mask, mask.x0, mask.y0,
        DEPTH_LIKELY_SIGMA_M, BACKGROUND_M, CLUTTER_RANGE_M, LOG_SEEN_PAST, LOG_HIDDEN,
    )  # fmt: skip
    return VIEW_SAMPLES * total / (count + DEPTH_HALF_SAMPLES_PX)


def _mask(
    view: View,
    silhouette: Rendering,
    candidate: Candidate | None,
    visible_px: int,
    labels: tuple[str, ...],
) -> float:
    missed = LOG_MISSED * visible_px / (visible_px + MISSED_HALF_PX)
    if candidate is None:
        return missed
    lens, step = view.geometry.lens, view.geometry.step
    mask, person = candidate.mask, view.person
    cost, count = outline_cost(
        silhouette.face, silhouette.x0, silhouette.y0, mask.mask, mask.x0, mask.y0,
        person.mask, person.x0, person.y0, lens.width, lens.height,
        max(CONTOUR_SIGMA_PX / step, 1.0), OUTLINE_COST_MAX,
    )  # fmt: skip
    samples = VIEW_SAMPLES * count / (count + OUTLINE_HALF_SAMPLES_PX)
    named = 0.0
    if labels and candidate.label:
        named = LABEL_LOG_RATIO if candidate.label in labels else -LABEL_LOG_RATIO
    return max(samples * (MASK_AGREES - cost) + named, missed)
