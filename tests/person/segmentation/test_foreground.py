"""The parts of the segmentation without a detector, each against something independent."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from intercap_core.geometry.camera import masks
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.person.segmentation.candidate_masks import ColourCells, encode_window
from intercap_core.person.segmentation.colour_candidates import (
    draw_volume,
    find_foreground,
    median_background,
)
from intercap_core.person.segmentation.foreground import (
    DepthBackground,
    DepthView,
    without_free_space,
)
from intercap_core.person.segmentation.person_volume import FAR, build_bones, distance_outside
from intercap_core.person.segmentation.static_objects import (
    OccupiedCells,
    components,
    find_static_objects,
)
from tests.helpers.synthetic_capture import FURNITURE, ring, room_depth, to_millimetres
from tests.helpers.synthetic_people import stick_person

RIG, UP = ring()
LOW, HIGH = np.array([-2.0, -2.0, 0.025]), np.array([2.0, 2.0, 2.3])

# --- cells ---------------------------------------------------------------------------------------


def test_components_are_those_of_a_dense_grid():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (600, 3)).astype(np.float32)
    cells = np.floor(points / 0.06).astype(int)
    grid = np.zeros(cells.max(0) - cells.min(0) + 1, bool)
    at = tuple((cells - cells.min(0)).T)
    grid[at] = True
    dense, count = ndimage.label(grid, np.ones((3, 3, 3)))
    groups = components(points, 0.06, 1)
    assert len(groups) == count and sum(map(len, groups)) == len(points)
    assert all(len(np.unique(dense[at][group])) == 1 for group in groups)
    sizes = [len(np.unique(cells[group], axis=0)) for group in groups]
    assert sizes == sorted(sizes, reverse=True)
    assert all((np.diff(group) > 0).all() for group in groups)
    large = components(points, 0.06, 5)
    assert [len(group) for group in large] == [len(g) for g in groups if len(g) >= 5]
    assert components(points[:0], 0.06, 1) == []


def test_occupied_cells_include_face_neighbours():
    points = np.array([[0.05, 0.05, 0.05], [-0.95, 0.05, 0.05]])
    around = [[0.05, 0.05, 0.05], [0.15, 0.05, 0.05], [0.05, -0.05, 0.05], [-0.85, 0.05, 0.05]]
    apart = [[0.15, 0.15, 0.05], [0.25, 0.05, 0.05]]
    cells = OccupiedCells(points, 0.1, 1)
    assert cells.holds(np.array(around)).all() and not cells.holds(np.array(apart)).any()
    assert not OccupiedCells(points[:0], 0.1, 1).holds(np.array(around)).any()


# --- the person ----------------------------------------------------------------------------------


def test_distance_outside_is_that_to_a_cone_in_margins():
    bone = np.array([[0, 0, 0, 0, 0, 1, 0.1, 0.2, 0.05]], np.float32)
    points = np.array([[0.3, 0, 0.5], [0, 0.1, 0], [0, 0, 1.4], [0, 0, 0.5], [9, 0, 0]], np.float32)
    expected = [(0.3 - 0.15) / 0.05, 0.0, (0.4 - 0.2) / 0.05, -0.15 / 0.05, FAR]
    np.testing.assert_allclose(distance_outside(points, bone), expected, atol=1e-4)


def test_distance_outside_considers_every_bone():
    bones = build_bones(stick_person())
    points = np.random.default_rng(1).uniform([-1, -1, 0], [1, 1, 2], (3000, 3)).astype(np.float32)
    start, along = bones[:, :3], bones[:, 3:6] - bones[:, :3]
    share = np.einsum("nbj,bj->nb", points[:, None] - start, along)
    share = np.clip(share / np.maximum((along**2).sum(1), 1e-10), 0, 1)
    away = np.linalg.norm(points[:, None] - start - share[..., None] * along, axis=-1)
    radius = bones[:, 6] + share * (bones[:, 7] - bones[:, 6])
    brute = np.minimum(((away - radius) / bones[:, 8]).min(1), FAR)
    np.testing.assert_allclose(distance_outside(points, bones), brute, atol=2e-3)


def test_bones_without_an_end_are_left_out():
    joints = np.full((135, 3), np.nan)
    assert build_bones(joints).shape == (0, 9)
    assert (distance_outside(np.zeros((3, 3), np.float32), build_bones(joints)) == FAR).all()
    blind = stick_person()
    blind[25:67] = np.nan
    assert 0 < len(build_bones(blind)) < len(build_bones(stick_person()))


# --- depth ---------------------------------------------------------------------------------------


def depth_views() -> list[DepthView]:
    return [DepthView(camera, 0.0, UP @ camera.master_from_depth) for camera in RIG]


def test_points_and_reach_of_a_view():
    view = depth_views()[1]
    room = room_depth(RIG[1], UP, FURNITURE)
    image = np.rint(1000 * room).astype(np.uint16)
    index = np.flatnonzero(image)
    points, _ = view.points(image, index)
    assert np.abs(points[points[:, 2] < 0.2, 2]).min() < 0.002  # the floor
    reach = view.reach_mm(LOW, HIGH).ravel()[index]
    inside = ((points > LOW + 0.02) & (points < HIGH - 0.02)).all(1)
    assert (image.ravel()[index][inside] <= reach[inside]).all()


def test_object_that_leaves_is_no_background():
    steady = np.full((40, 60), 3000, np.uint16)
    item = steady.copy()
    item[10:30, 20:40] = 2000
    empty = steady.copy()
    empty[10:30, 20:40] = 0
    reach, inner = np.full(steady.shape, 5000, np.uint16), np.s_[12:28, 22:38]
    background = DepthBackground.of(item, [item] * 20 + [empty] * 4, reach)
    assert (background.depth[inner] == 0).all() and background.depth[0, 0] == 3000
    foreground = np.zeros(steady.shape, bool)
    foreground.ravel()[background.before(item)] = True
    assert foreground[inner].all() and foreground.sum() <= 400
    assert background.shows(item)[:8].all() and not background.shows(item)[inner].any()
    kept = DepthBackground.of(item, [item] * 24, reach)
    assert (kept.depth == item).all() and not len(kept.before(item))


def test_pixels_that_float_at_an_edge_are_left_out():
    image = np.full((20, 20), 3000, np.uint16)
    image[:, 10:] = 2000
    image[5, 9] = 2400
    far = np.full_like(image, 4000)
    index = DepthBackground(np.zeros_like(image), far, far).before(image)
    assert 5 * 20 + 9 not in index and 5 * 20 + 10 in index and len(index) == 399


def test_free_space_of_another_camera_is_no_background():
    """A box in the background of the first camera only: the others saw the floor there."""
    rng = np.random.default_rng(2)
    box = np.array([[[-0.2, -0.2, 0.3], [0.2, 0.2, 0.8]]])
    views, backgrounds = depth_views(), []
    for c, view in enumerate(views):
        boxes = np.concatenate([FURNITURE, box]) if c == 0 else FURNITURE
        image = to_millimetres(room_depth(RIG[c], UP, boxes), rng)
        reach = view.reach_mm(LOW, HIGH)
        backgrounds.append(DepthBackground.of(image, [image] * 3, reach))
    points, _ = views[0].points(backgrounds[0].depth, np.arange(backgrounds[0].depth.size))
    on_box = ((points > box[0, 0] - 0.02) & (points < box[0, 1] + 0.02)).all(1)
    first, *others = without_free_space(views, backgrounds, LOW, HIGH)
    unknown = on_box & (first.depth.ravel() == 0)
    assert unknown.sum() > 0.85 * on_box.sum() > 255
    assert (first.limit.ravel()[unknown] > 0).all()
    for old, new in zip(backgrounds[1:], others, strict=True):
        assert ((old.depth > 0) & (new.depth == 0)).mean() < 0.01


def test_static_objects_near_the_person_and_on_a_table():
    """A mug on a table and a stool, but no furniture that nobody comes near."""
    rng = np.random.default_rng(2)
    table = np.array([[-0.3, -0.3, 0.0], [0.3, 0.3, 0.7]])
    mug = np.array([[-0.05, -0.05, 0.7], [0.07, 0.07, 0.82]])
    stool = np.array([[0.3, 0.7, 0.0], [0.6, 1.0, 0.4]])
    far = np.array([[-1.9, -1.9, 0.0], [-1.5, -1.5, 0.5]])
    views = depth_views()
    backgrounds = []
    for camera, view in zip(RIG, views, strict=True):
        room = room_depth(camera, UP, np.stack([table, mug, stool, far]))
        image = to_millimetres(room, rng)
        backgrounds.append(DepthBackground.of(image, [image], view.reach_mm(LOW, HIGH)))
    person = stick_person() + np.array([0.0, 0.55, 0.0])
    objects, surface = find_static_objects(views, backgrounds, LOW, HIGH, person)
    sizes = [item.extent_m for item in objects]
    assert len(objects) == 3
    for box, kind in ((table, (False, True)), (mug, (True, False)), (stool, (False, False))):
        size = np.linalg.norm(box[1] - box[0])
        item = objects[int(np.argmin(np.abs(np.array(sizes) - size)))]
        assert abs(item.extent_m - size) < 0.12 * size + 0.05
        assert (item.on_top, item.carries) == kind
        assert sum(len(pixels) > 0 for pixels in item.pixels) >= 4
    assert surface.holds(np.array([[0.0, 0.3, 0.35], [0.0, 0.0, 1.5]])).tolist() == [True, False]


# --- masks ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1, 2, 3])
def test_a_window_of_cells_is_encoded_as_the_whole_image(scale):
    rng = np.random.default_rng(scale)
    height, width = 47, 61
    for _ in range(20):
        left, top = rng.integers(0, 15, 2)
        window = (rng.random((rng.integers(1, 12), rng.integers(1, 12))) < 0.5).astype(np.uint8)
        whole = np.zeros((120, 120), bool)
        large = window.repeat(scale, 0).repeat(scale, 1) > 0
        y, x = top * scale, left * scale
        whole[y : y + large.shape[0], x : x + large.shape[1]] = large
        rle = encode_window(window, int(left), int(top), scale, width, height)
        np.testing.assert_array_equal(masks.decode(rle, height, width), whole[:height, :width])


def test_projection_resolves_occlusion_and_closes_holes():
    camera = RIG[0]
    near, far = np.zeros((2, camera.depth.height, camera.depth.width), np.uint16)
    near[80:100, 80:120], far[70:110, 70:130] = 1500, 2500
    view = depth_views()[0]
    local = np.concatenate([view.points(i, np.flatnonzero(i))[1] for i in (near, far)])
    first = np.arange(len(local)) < (near > 0).sum()
    projected = ColourCells.of(local, camera).visible()
    front = masks.decode(projected.rle(first, ~first), 1080, 1920)
    back = masks.decode(projected.rle(~first, first), 1080, 1920)
    assert front.any() and back.sum() > front.sum() and not (front & back).any()
    rows, columns = np.flatnonzero(front.any(1)), np.flatnonzero(front.any(0))
    assert front[rows[0] : rows[-1], columns[0] : columns[-1]].mean() > 0.85  # no holes


# --- colour --------------------------------------------------------------------------------------


def coloured_room(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(60, 180, (6, 8, 3)).repeat(20, 0).repeat(20, 1).astype(np.float32)


def test_median_without_the_person_and_with_changing_exposure():
    rng = np.random.default_rng(0)
    room = coloured_room(rng)
    images, people = [], []
    for k in range(9):
        image = room * (0.8 + 0.05 * k) + rng.normal(0, 2, room.shape)
        where = np.zeros(room.shape[:2], bool)
        where[40:90, 40:80] = k < 6  # stands there for most of the time
        image[where] = 20
        images.append(np.clip(image, 0, 255).astype(np.uint8))
        people.append(where)
    median, known = median_background(np.stack(images), np.stack(people))
    assert known.all()
    assert np.median(np.abs(median / images[0][0, 0].mean() - room / room[0, 0].mean())) < 0.05
    assert np.abs(median - 0.8 * room).max() < 12


def test_object_is_foreground_but_shadow_and_exposure_are_not():
    rng = np.random.default_rng(1)
    room = coloured_room(rng)
    known = np.ones(room.shape[:2], bool)
    known[:, :20] = False
    image = 1.25 * room
    image[60:100, 20:60] *= 0.7
    image[20:50, 90:120] = (200, 40, 40)
    image[60:90, :15] = (200, 40, 40)  # where nothing is known of the background
    foreground = find_foreground(np.clip(image, 0, 255).astype(np.uint8), room, known)
    assert foreground[22:48, 92:118].mean() > 0.9
    foreground[20:50, 90:120] = False
    assert foreground.mean() < 0.01


def test_drawn_volume_covers_points_within_the_body():
    camera = RIG[2]
    bones = build_bones(apply(invert(UP), stick_person()))
    mask = draw_volume(bones, camera, (540, 960), 0.0)
    points = np.random.default_rng(4).uniform([-0.4, -0.5, 0], [0.4, 0.5, 1.8], (4000, 3))
    in_master = apply(invert(UP), points)
    away = distance_outside(in_master.astype(np.float32), bones)
    pixel = np.rint(camera.colour.project(apply(camera.colour_from_master, in_master)) / 2)
    column, row = np.clip(pixel.astype(int), 0, (959, 539)).T
    assert mask[row[away < -0.5], column[away < -0.5]].mean() > 0.97
    assert mask.mean() < 0.1
    assert not draw_volume(bones[:0], camera, (540, 960), 0.0).any()
    behind = bones.copy()
    behind[:, [2, 5]] -= 20
    assert not draw_volume(behind, camera, (540, 960), 0.0).all()
