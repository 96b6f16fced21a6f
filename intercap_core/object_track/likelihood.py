"""Log-likelihood ratio of a pose in one image, used wherever poses are compared.

For a pose x and one view it is log p(image | object at x) - log p(image | object not in view), in
nats: the sum of

- depth: each rendered pixel is measured at the object's surface, nearer (occluded) or farther
  (background), against a uniform distribution around it;
- mask: either a candidate shows the object, by the distances of its outline from the render's and
  by its label; or the detector missed the object, which is less likely the more of it is visible.

Pixels that a person or furniture hides are no evidence. Depth that equals the empty room is no
evidence for the object outside of a candidate. Pixels of one view err together, so each term counts
as at most ``VIEW_SAMPLES`` independent samples.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.camera.projection_kernels import project_point
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.shots import Rendering
from intercap_core.object_track.object_depth import rotated_normal
from intercap_core.object_track.object_silhouette import nearest, rim_pixels, transform_point
from intercap_core.object_track.reduced_mask import EMPTY, covers, cut
from intercap_core.object_track.view import FitContext, MaskCandidate, View

# Thresholds of log-likelihood ratios of all views of a frame, nats.
SEEN_LOG_RATIO = 3.0  # the images show the object; tuned
# Log-likelihood ratio that ends the search of a frame; tuned.
DECISIVE_LOG_RATIO = 25.0
CONTRADICTED_LOG_RATIO = -6.0  # the images contradict the pose; tuned
CONTOUR_SIGMA_PX = 2.0  # of a detector's contour, pixels at full resolution; tuned
DEPTH_HALF_SAMPLES_PX = 120  # pixels at which depth counts half of its samples; tuned
# Independent samples of a view's depth, outline or colours at most, since its pixels err together.
VIEW_SAMPLES = 4.0  # tuned
LOG_MISSED = float(np.log(0.1))  # how often detectors miss an object that is fully visible; tuned
SURFACE_SIGMA_M = 0.008  # of depth from the mesh: sensor, calibration, mesh
ROOM_DEPTH_M = 0.025  # three standard deviations of depth from the empty room
CLUTTER_M = 0.3  # other surfaces are measured uniformly within this range of the object
LOG_PAST = float(np.log(0.03))  # share of pixels that see past the object (flying pixels, edges)
LOG_HIDDEN = float(np.log(0.15))  # share of pixels that something other than a person hides
LABEL_LOG_RATIO = 1.0  # nats of a candidate with the object's label; minus this with another; tuned


def log_ratio(
    context: FitContext,
    view: View,
    pose: np.ndarray,
    silhouette: Rendering,
    drawn_depth: Rendering | None,
    candidate: MaskCandidate | None,
    visible_px: int,
) -> float:
    """Return the log-likelihood ratio of a pose in one view, nats.

    Args:
        context: object and settings.
        view: the view.
        pose: (4, 4) master_from_object.
        silhouette, drawn_depth: renderings of the pose in the colour and the depth image; the
            latter None without depth.
        candidate: candidate with the largest overlap, if any.
        visible_px: rendered pixels that are not occluded.
    """
    ratio = 0.0
    if drawn_depth is not None:
        ratio += _depth(context.mesh, view, pose, drawn_depth, candidate)
    if view.detected:
        ratio += _mask(view, silhouette, candidate, visible_px, context.labels)
    return ratio


def _depth(
    mesh: ObjectMesh,
    view: View,
    pose: np.ndarray,
    drawn: Rendering,
    candidate: MaskCandidate | None,
) -> float:
    """Return the depth's part of :func:`log_ratio`, nats."""
    geometry = view.geometry
    assert view.depth is not None and geometry.depth_lens is not None
    colour_from_depth = geometry.camera.colour_from_depth
    assert colour_from_depth is not None
    mask = candidate.mask if candidate is not None else EMPTY
    room = np.zeros((0, 0), np.float32)
    if view.background is not None:
        room = view.background[drawn.window]
    total, count = depth_log_ratio(
        drawn.depth, drawn.face, (drawn.x0, drawn.y0), view.depth[drawn.window], room,
        geometry.depth_lens.rays, mesh.face_normals,
        geometry.camera.depth_from_master[:3, :3] @ pose[:3, :3],
        np.asarray(colour_from_depth), geometry.lens.parameters,
        view.person.placed, mask.placed, mesh.diameter,
    )  # fmt: skip
    return VIEW_SAMPLES * total / (count + DEPTH_HALF_SAMPLES_PX)


def _mask(
    view: View,
    silhouette: Rendering,
    candidate: MaskCandidate | None,
    visible_px: int,
    labels: tuple[str, ...],
) -> float:
    """Return the mask's part of :func:`log_ratio`, nats."""
    missed = LOG_MISSED * visible_px / (visible_px + 300)  # half of it at 300 visible pixels
    if candidate is None:
        return missed
    lens, step = view.geometry.lens, view.geometry.step
    # a pixel costs at most 4.5, as three standard deviations
    cost, count = outline_cost(
        silhouette.face, (silhouette.x0, silhouette.y0), candidate.mask.placed, view.person.placed,
        lens.width, lens.height, max(CONTOUR_SIGMA_PX / step, 1.0), 4.5,
    )  # fmt: skip
    samples = VIEW_SAMPLES * count / (count + 60)  # half of them at 60 pixels
    named = 0.0
    if labels and candidate.label:
        named = LABEL_LOG_RATIO if candidate.label in labels else -LABEL_LOG_RATIO
    # a mask at the cost 2 is no evidence: such outlines occur nearby by chance
    return max(samples * (2.0 - cost) + named, missed)


@numba.njit(cache=True, nogil=True)
def depth_log_ratio(
    rendered, face, corner, measured, background, rays, face_normals, rotation,
    colour_from_depth, colour, person, mask, diameter,
):  # fmt: skip
    """Sum log p(depth | object there) - log p(depth | not there) over a rendering's pixels.

    Without the object, depth is uniform over ``CLUTTER_M``. With it, a pixel shows the surface, by
    a Gaussian of ``SURFACE_SIGMA_M`` along its normal. If that is less likely, it shows background
    behind it (``LOG_PAST``) or an occluder (``LOG_HIDDEN``). Pixels outside of the mask that a
    person explains are no evidence. Neither are those that show the empty room: a flat object fits
    any floor, and furniture may hide the object. Only if the room's surface is less than a diameter
    in front of the object, it contradicts the pose, because the object does not lie in the floor.

    Args:
        rendered, face: (h, w) of the rendering, whose first pixel is ``corner`` of the depth image.
        measured: (h, w) depth in metres, 0 where invalid.
        background: (h, w) depth of the empty room, 0 where unknown; or (0, 0).
        rays: (H, W, 2) of the depth lens.
        face_normals, rotation: (F, 3) unit normals and (3, 3) depth camera_from_object.
        colour_from_depth, colour: (4, 4), and (13,) parameters of the colour lens.
        person, mask: masks of the colour image (:attr:`.reduced_mask.ReducedMask.placed`).
        diameter: of the object, metres.

    Returns:
        The sum, and the number of pixels with a measurement.
    """
    total, count = 0.0, 0
    agrees = np.log(CLUTTER_M / (SURFACE_SIGMA_M * np.sqrt(2 * np.pi)))
    for v in range(rendered.shape[0]):
        for u in range(rendered.shape[1]):
            f = face[v, u]
            if f < 0:
                continue
            z = np.float64(measured[v, u])
            if z <= 0:
                continue
            count += 1
            gap = z - rendered[v, u]
            i, j = corner[0] + u, corner[1] + v
            rx, ry = rays[j, i, 0], rays[j, i, 1]
            nx, ny, nz = rotated_normal(face_normals, f, rotation)
            across = gap * (nx * rx + ny * ry + nz) / SURFACE_SIGMA_M
            shown = agrees - 0.5 * across * across
            if gap > 0 and shown <= 0:
                total += max(shown, LOG_PAST)
                continue
            cx, cy, cz = transform_point(colour_from_depth, rx * z, ry * z, z)
            column, row = project_point(cx, cy, cz, colour)
            x, y = int(np.rint(column)), int(np.rint(row))
            if covers(mask, x, y):
                total += max(shown, LOG_HIDDEN)
            elif not covers(person, x, y):
                known = background[v, u] if background.size else np.float32(0.0)
                is_room = known > 0 and abs(known - z) <= ROOM_DEPTH_M
                if not is_room or (shown < 0 and gap > -diameter):
                    total += max(shown, LOG_HIDDEN)
    return total, count


@numba.njit(cache=True, nogil=True)
def outline_cost(face, corner, mask, person, width, height, sigma, most):
    """Compare the outlines of a rendering and a mask.

    The nearest pixel of the other outline is searched exactly for each pixel of either outline.
    Mask pixels farther from the rendering's window than half of its size are ignored. Pixels next
    to a person outside of the mask, or at the edge of the image, do not count: the outline may be
    cut off there.

    Args:
        face: (h, w) face number of the rendering, -1 outside.
        corner: first pixel (x, y) of the rendering in the image.
        mask, person: masks (:attr:`.reduced_mask.ReducedMask.placed`).
        width, height: size of the image.
        sigma: standard deviation of an outline, pixels.
        most: largest cost of a pixel.

    Returns:
        Mean of min(d^2 / 2 sigma^2, most) over the pixels of both outlines, d the distance to the
            other outline; and the number of pixels.
    """
    h, w = face.shape
    margin = max(h, w) // 2 + 2
    left, top = corner[0] - margin, corner[1] - margin
    rows, columns = h + 2 * margin, w + 2 * margin
    drawn = cut((face >= 0, margin, margin), 0, 0, rows, columns)
    inside = cut(mask, left, top, rows, columns)
    other = cut(person, left, top, rows, columns) & ~inside
    edge, edge_starts = rim_pixels(drawn)
    border, border_starts = rim_pixels(inside)
    limit = sigma * np.sqrt(2 * most)
    total, count = 0.0, 0
    for side in range(2):
        pixels = border if side == 0 else edge
        targets, starts = (edge, edge_starts) if side == 0 else (border, border_starts)
        for k in range(pixels.shape[0]):
            x, y = pixels[k, 0], pixels[k, 1]
            i, j = x + left, y + top
            if i <= 0 or j <= 0 or i >= width - 1 or j >= height - 1:
                continue
            hidden = False
            for b in range(max(y - 1, 0), min(y + 2, rows)):
                for a in range(max(x - 1, 0), min(x + 2, columns)):
                    hidden |= other[b, a]
            if hidden:
                continue
            count += 1
            index = nearest(targets, starts, x, y, limit)
            if index < 0:
                total += most
            else:
                dx, dy = targets[index, 0] - x, targets[index, 1] - y
                total += 0.5 * (dx * dx + dy * dy) / (sigma * sigma)
    return (total / count if count else 0.0), count
