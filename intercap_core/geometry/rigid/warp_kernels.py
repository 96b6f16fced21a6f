"""Kernels of :mod:`.render_warp`: :mod:`.raster` again, a thread each corner, shot or triangle."""

# mypy: ignore-errors
# No deferred annotations: warp reads the kernels' types, which are its own.
import warp as wp

from intercap_core.geometry.camera.projection import MIN_DEPTH_M
from intercap_core.geometry.rigid import constants

wp.config.log_level = wp.LOG_WARNING  # no banner in a job's output
wp.set_module_options({"enable_backward": False})  # compiles in a third of the time

_NEAR = wp.constant(wp.float64(constants.NEAR_M))
_MIN_DEPTH = wp.constant(wp.float64(MIN_DEPTH_M))
_BEND = wp.constant(wp.float64(constants.BEND))
_SLACK = wp.constant(wp.float64(constants.SLACK_PX))
EMPTY = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))


@wp.kernel
def place(
    vertices: wp.array(dtype=wp.vec3d),
    poses: wp.array(dtype=wp.mat44d),
    lens_of: wp.array(dtype=wp.int32),
    lenses: wp.array2d(dtype=wp.float64),
    corners: wp.array2d(dtype=wp.vec3d),
    pixels: wp.array2d(dtype=wp.vec2d),
):
    """Corners in each shot's camera frame and their pixels, as raster.place."""
    shot, i = wp.tid()
    p = wp.transform_point(poses[shot], vertices[i])
    corners[shot, i] = p
    lens = lens_of[shot]
    one, two = wp.float64(1.0), wp.float64(2.0)
    z = wp.max(p[2], _MIN_DEPTH)
    x, y = p[0] / z, p[1] / z
    stretch = wp.max(wp.sqrt(x * x + y * y) / lenses[lens, 12], one)
    x, y = x / stretch, y / stretch
    s = x * x + y * y
    above = one + s * (lenses[lens, 4] + s * (lenses[lens, 5] + s * lenses[lens, 8]))
    below = one + s * (lenses[lens, 9] + s * (lenses[lens, 10] + s * lenses[lens, 11]))
    d = above / below
    p1, p2 = lenses[lens, 6], lenses[lens, 7]
    u = x * d + two * p1 * x * y + p2 * (s + two * x * x)
    v = y * d + p1 * (s + two * y * y) + two * p2 * x * y
    pixels[shot, i] = wp.vec2d(
        lenses[lens, 0] * stretch * u + lenses[lens, 2],
        lenses[lens, 1] * stretch * v + lenses[lens, 3],
    )


@wp.kernel
def surround(
    corners: wp.array2d(dtype=wp.vec3d),
    pixels: wp.array2d(dtype=wp.vec2d),
    boxes: wp.array(dtype=wp.vec4d),
):
    """The box of each shot's pixels, left, top, right, bottom, of points that are not too near."""
    shot = wp.tid()
    left, top = wp.float64(1.0e30), wp.float64(1.0e30)
    right, bottom = wp.float64(-1.0e30), wp.float64(-1.0e30)
    for i in range(corners.shape[1]):
        if corners[shot, i][2] > _NEAR:
            pixel = pixels[shot, i]
            left = wp.min(left, pixel[0])
            top = wp.min(top, pixel[1])
            right = wp.max(right, pixel[0])
            bottom = wp.max(bottom, pixel[1])
    boxes[shot] = wp.vec4d(left, top, right, bottom)


@wp.kernel
def draw(
    corners: wp.array2d(dtype=wp.vec3d),
    pixels: wp.array2d(dtype=wp.vec2d),
    faces: wp.array(dtype=wp.vec3i),
    cull_back: int,
    lens_of: wp.array(dtype=wp.int32),
    lenses: wp.array2d(dtype=wp.float64),
    rays: wp.array(dtype=wp.vec2),
    ray_starts: wp.array(dtype=wp.int64),
    widths: wp.array(dtype=wp.int32),
    windows: wp.array(dtype=wp.vec4i),
    starts: wp.array(dtype=wp.int64),
    keys: wp.array(dtype=wp.uint64),
):
    """One triangle of one shot, as raster.draw; a key holds the depth's bits above the face id."""
    shot, f = wp.tid()
    face, window = faces[f], windows[shot]
    a, b, c = corners[shot, face[0]], corners[shot, face[1]], corners[shot, face[2]]
    n0, n1, n2 = wp.cross(a, b), wp.cross(b, c), wp.cross(c, a)
    zero = wp.float64(0.0)
    volume = wp.dot(n0, c)
    if volume == zero or (cull_back != 0 and volume > zero):
        return
    if a[2] < _NEAR or b[2] < _NEAR or c[2] < _NEAR:
        return
    p, q, r = pixels[shot, face[0]], pixels[shot, face[1]], pixels[shot, face[2]]
    left, right = wp.min(wp.min(p[0], q[0]), r[0]), wp.max(wp.max(p[0], q[0]), r[0])
    top, bottom = wp.min(wp.min(p[1], q[1]), r[1]), wp.max(wp.max(p[1], q[1]), r[1])
    lens = lens_of[shot]
    focal = wp.min(lenses[lens, 0], lenses[lens, 1])
    extent = wp.max(right - left, bottom - top)
    slack = _SLACK + _BEND * extent * extent / focal
    one = wp.float64(1.0)
    low_u, high_u = wp.max(left - slack, wp.float64(window[0])), right + slack
    low_v, high_v = wp.max(top - slack, wp.float64(window[1])), bottom + slack
    high_u = wp.min(high_u, wp.float64(window[2]) - one)
    high_v = wp.min(high_v, wp.float64(window[3]) - one)
    if low_u > high_u or low_v > high_v:
        return
    sign = one
    if volume < zero:
        sign = -one
    normal = n0 + n1 + n2
    for v in range(int(wp.ceil(low_v)), int(high_v) + 1):
        row = starts[shot] + wp.int64((v - window[1]) * (window[2] - window[0]) - window[0])
        image_row = ray_starts[lens] + wp.int64(v) * wp.int64(widths[lens])
        for u in range(int(wp.ceil(low_u)), int(high_u) + 1):
            flat = rays[image_row + wp.int64(u)]
            ray = wp.vec3d(wp.float64(flat[0]), wp.float64(flat[1]), one)
            inside = sign * wp.dot(n0, ray) >= zero and sign * wp.dot(n1, ray) >= zero
            if inside and sign * wp.dot(n2, ray) >= zero:
                z = wp.float32(volume / wp.dot(normal, ray))
                # bits of positive floats sort as their values do
                key = (wp.uint64(wp.cast(z, wp.uint32)) << wp.uint64(32)) | wp.uint64(f)
                wp.atomic_min(keys, row + wp.int64(u), key)


@wp.kernel
def unpack(
    keys: wp.array(dtype=wp.uint64),
    depth: wp.array(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
    body: wp.array(dtype=wp.int16),
):
    """Depth, face and body of every pixel; 0, -1, -1 where nothing was hit."""
    i = wp.tid()
    key = keys[i]
    if key == EMPTY:
        depth[i] = wp.float32(0.0)
        face[i] = wp.int32(-1)
        body[i] = wp.int16(-1)
    else:
        depth[i] = wp.cast(wp.uint32(key >> wp.uint64(32)), wp.float32)
        face[i] = wp.int32(key & wp.uint64(0xFFFFFFFF))
        body[i] = wp.int16(0)


@wp.kernel
def look_for_eyes(
    tree: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    eyes: wp.array(dtype=wp.vec3),
    asked: wp.array2d(dtype=wp.uint8),
):
    """Clear ``asked`` where the mesh lies between a point and a shot's eye."""
    shot, i = wp.tid()
    if asked[shot, i] != wp.uint8(0):
        way = eyes[shot] - points[i]
        if wp.mesh_query_ray_anyhit(tree, points[i], wp.normalize(way), wp.length(way)):
            asked[shot, i] = wp.uint8(0)
