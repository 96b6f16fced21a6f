"""Log-likelihood ratio of a pose in one image, used wherever poses are compared.

For a pose x and one view it is log p(image | object at x) - log p(image | object not in view), in
nats: the sum of

- depth: each rendered pixel is measured at the object's surface, nearer (occluded) or farther
  (background), against a uniform distribution around it;
- mask: either a candidate shows the object, by the distances of its outline from the render's and
  by its label; or the detector missed the object, which is less likely the more of it is visible.

Pixels that a person hides are no evidence. Depth that equals the empty room is no evidence for the
object outside of a candidate. Pixels of one view err together, so each term counts as at most
``VIEW_SAMPLES`` independent samples.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.camera.projection_kernels import project_point
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.shots import Rendering
from intercap_core.object_track.object_silhouette import nearest, rim_pixels
from intercap_core.object_track.reduced_mask import EMPTY
from intercap_core.object_track.view import Candidate, FitContext, View

# Thresholds of log-likelihood ratios of all views of a frame, nats.
SEEN_LOG_RATIO = 3.0  # the images show the object
SEARCH_GOOD_LOG_RATIO = 25.0  # good enough to stop searching the frame; tuned on the studio
CONTRADICTED_LOG_RATIO = -6.0  # the images contradict the pose

CONTOUR_SIGMA_PX = 2.0  # of a detector's contour, pixels at full resolution; tuned on the studio
DEPTH_HALF_SAMPLES_PX = 120  # pixels at which depth counts half of its samples; tuned on the studio
VIEW_SAMPLES = 4.0  # independent samples of a view's depth, or outline, at most; tuned on studio
OUTLINE_HALF_SAMPLES_PX = 60  # pixels at which an outline counts half of them
DEPTH_LIKELY_SIGMA_M = (
    0.008  # of depth from the mesh: sensor, calibration, mesh; tuned on the studio
)
BACKGROUND_M = 0.025  # distance from the room's surface at which depth shows the room: 3 sigma
CLUTTER_RANGE_M = 0.3  # other surfaces are measured uniformly within this range of the object
LOG_SEEN_PAST = float(np.log(0.03))  # share of pixels beside the surface: flying pixels, edges
LOG_HIDDEN = float(np.log(0.15))  # share of pixels that something other than a person hides
LOG_MISSED = float(np.log(0.1))  # how often a detector misses an object that is fully visible
MISSED_HALF_PX = 300  # visible pixels at which half of LOG_MISSED counts
# Costs of an outline are means of half a squared normalised distance.
MASK_AGREES = 2.0  # cost at which a mask is no evidence: such outlines occur nearby by chance
OUTLINE_COST_MAX = 4.5  # largest cost of a pixel: three standard deviations
LABEL_LOG_RATIO = 1.0  # of a candidate with the object's label, nats; minus this with another label


def log_ratio(
    context: FitContext,
    view: View,
    pose: np.ndarray,
    silhouette: Rendering,
    drawn_depth: Rendering | None,
    candidate: Candidate | None,
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
    found = 0.0
    if drawn_depth is not None:
        found += _depth(context.mesh, view, pose, drawn_depth, candidate)
    if view.detected:
        found += _mask(view, silhouette, candidate, visible_px, context.labels)
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


@numba.njit(cache=True, nogil=True)
def depth_log_ratio(
    rendered,
    face,
    x0,
    y0,
    measured,
    background,
    rays,
    face_normals,
    rotation,
    colour_from_depth,
    colour,
    person,
    px,
    py,
    mask,
    mx,
    my,
    sigma,
    background_m,
    clutter_m,
    log_past,
    log_hidden,
):
    """Sum log p(depth | object there) - log p(depth | not there) over a rendering's pixels.

    Outside of the mask, pixels that a person explains are no evidence, and pixels that the
    background explains are no evidence for the object: a flat object fits any floor.

    Args:
        rendered, face: (h, w) of the rendering, whose first pixel is (x0, y0) of the depth image.
        measured: (H, W) depth in metres, 0 where invalid.
        background: (H, W) depth of the empty room, 0 where unknown; or (0, 0).
        rays: (H, W, 2) of the depth lens.
        face_normals, rotation: (F, 3) unit normals and (3, 3) depth camera_from_object.
        colour_from_depth, colour: (4, 4), and (13,) parameters of the colour lens.
        person, mask: masks with their first pixels (px, py), (mx, my) in the colour image.
        sigma: standard deviation of depth from the surface, metres.
        background_m, clutter_m: constants of this module.
        log_past, log_hidden: log-probabilities of background and occlusion at a pixel.

    Returns:
        The sum, and the number of pixels with a measurement.
    """
    total, count = 0.0, 0
    agrees = np.log(clutter_m / (sigma * np.sqrt(2 * np.pi)))
    to_colour = colour_from_depth
    for v in range(rendered.shape[0]):
        for u in range(rendered.shape[1]):
            f = face[v, u]
            if f < 0:
                continue
            z = np.float64(measured[y0 + v, x0 + u])
            if z <= 0:
                continue
            count += 1
            gap = z - rendered[v, u]
            rx, ry = rays[y0 + v, x0 + u, 0], rays[y0 + v, x0 + u, 1]
            nx, ny, nz = face_normals[f, 0], face_normals[f, 1], face_normals[f, 2]
            cx = rotation[0, 0] * nx + rotation[0, 1] * ny + rotation[0, 2] * nz
            cy = rotation[1, 0] * nx + rotation[1, 1] * ny + rotation[1, 2] * nz
            cz = rotation[2, 0] * nx + rotation[2, 1] * ny + rotation[2, 2] * nz
            across = gap * (cx * rx + cy * ry + cz) / sigma
            found = agrees - 0.5 * across * across
            if gap > 0 and found <= 0:
                total += max(found, log_past)
                continue
            x, y = rx * z, ry * z
            column, row = project_point(
                to_colour[0, 0] * x + to_colour[0, 1] * y + to_colour[0, 2] * z + to_colour[0, 3],
                to_colour[1, 0] * x + to_colour[1, 1] * y + to_colour[1, 2] * z + to_colour[1, 3],
                to_colour[2, 0] * x + to_colour[2, 1] * y + to_colour[2, 2] * z + to_colour[2, 3],
                colour,
            )
            x, y = int(np.rint(column)), int(np.rint(row))
            i, j = x - mx, y - my
            own = 0 <= i < mask.shape[1] and 0 <= j < mask.shape[0] and mask[j, i]
            i, j = x - px, y - py
            if own:
                total += max(found, log_hidden)
            elif not (0 <= i < person.shape[1] and 0 <= j < person.shape[0] and person[j, i]):
                known = background[y0 + v, x0 + u] if background.size else np.float32(0.0)
                if found < 0 or known <= 0 or abs(known - z) > background_m:
                    total += max(found, log_hidden)
    return total, count


@numba.njit(cache=True, nogil=True)
def outline_cost(face, x0, y0, mask, mx, my, person, px, py, width, height, sigma, most):
    """Compare the outlines of a rendering and a mask.

    Pixels where a person beside the mask or the edge of the image ends the outline do not count.
    All windows are given with their first pixels in the image.

    Args:
        face: (h, w) face number of the rendering, -1 outside.
        mask, person: masks.
        width, height: size of the image.
        sigma: standard deviation of an outline, pixels.
        most: largest cost of a pixel.

    Returns:
        Mean of min(d^2 / 2 sigma^2, most) over the pixels of both outlines, d the distance to the
            other outline; and the number of pixels.
    """
    h, w = face.shape
    margin = max(h, w) // 2 + 2
    left, top = x0 - margin, y0 - margin
    rows, columns = h + 2 * margin, w + 2 * margin
    drawn = np.zeros((rows, columns), np.bool_)
    inside, other = np.zeros((rows, columns), np.bool_), np.zeros((rows, columns), np.bool_)
    for y in range(rows):
        for x in range(columns):
            u, v = x - margin, y - margin
            if 0 <= u < w and 0 <= v < h:
                drawn[y, x] = face[v, u] >= 0
            i, j = x + left - mx, y + top - my
            if 0 <= i < mask.shape[1] and 0 <= j < mask.shape[0] and mask[j, i]:
                inside[y, x] = True
            else:
                i, j = x + left - px, y + top - py
                if 0 <= i < person.shape[1] and 0 <= j < person.shape[0]:
                    other[y, x] = person[j, i]
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
