"""Pixels of a rendering against a measured depth image and a mask, as log-likelihood ratios."""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.camera.projection_kernels import project_point
from intercap_core.object_track.object_silhouette_kernel import nearest, rim


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
    """Sum over a rendering's pixels of log p(depth | object there) - log p(depth | it is not), and
    how many were measured.

    The rendering's pixel (u, v) is pixel (u + x0, v + y0) of ``measured`` (H, W), 0 where none, and
    of the empty room's ``background`` (H, W), 0 where unknown, or (0, 0); ``rays`` (H, W, 2) of its
    lens; ``rotation`` (3, 3) camera_from_object; ``person`` and the candidate's ``mask`` (h, w)
    with their first pixels in the colour image, whose lens has the parameters ``colour`` (13,). The
    surface is measured with deviation ``sigma``, anything else anywhere within ``clutter_m``; it is
    seen past with ``log_past``, hidden by what is no person with ``log_hidden``. Outside the mask,
    what a person explains is no evidence, and what the background explains within ``background_m``
    is none for the object: something flat fits into any floor.
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
    """Mean over both outlines of min(d^2 / 2 sigma^2, most), d the distance in pixels from a mask's
    outline to that of a rendering and back, and how many pixels were compared.

    Outlines that a person beside the mask or the edge of the image (``width``, ``height``) ends do
    not count. All windows with their first pixels in the image.
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
    edge, edge_starts = rim(drawn)
    border, border_starts = rim(inside)
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
