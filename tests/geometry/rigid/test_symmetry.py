"""Axioms of the symmetry groups and closed forms of the angles over them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.entries import ContinuousSymmetry, Symmetry
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.symmetry import SymmetryGroup


def _flat(rotation):
    return tuple(rigid(rotation, np.zeros(3)).ravel())


def _turn(axis, degrees):
    return Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis, float)).as_matrix()


GROUPS = {
    "none": Symmetry(),
    "two": Symmetry(discrete=(_flat(_turn((0, 0, 1), 180)),)),
    "box": Symmetry(discrete=(_flat(_turn((0, 0, 1), 180)), _flat(_turn((1, 0, 0), 180)))),
    "five": Symmetry(discrete=(_flat(_turn((0, 0, 1), 72)),)),
    "bottle": Symmetry(continuous=(ContinuousSymmetry(axis=(0, 0, 1)),)),
    "cylinder": Symmetry(
        discrete=(_flat(_turn((1, 0, 0), 180)),), continuous=(ContinuousSymmetry(axis=(0, 0, 2)),)
    ),
    "off_centre": Symmetry(
        continuous=(ContinuousSymmetry(axis=(0, 0.6, 0.8), offset=(0.1, -0.2, 0.05)),)
    ),
    "sphere": Symmetry(sphere=True),
}
ORDERS = {"none": 1, "two": 2, "box": 4, "five": 5, "bottle": 1, "cylinder": 2, "sphere": 1}


@pytest.fixture(params=GROUPS)
def group(request):
    return SymmetryGroup.from_settings(GROUPS[request.param])


@pytest.mark.parametrize("name", ORDERS)
def test_closure_has_the_groups_order(name):
    group = SymmetryGroup.from_settings(GROUPS[name])
    assert len(group.discrete) == ORDERS[name]
    products = group.discrete[:, None] @ group.discrete[None]
    nearest = np.abs(products[:, :, None] - group.discrete).max((-1, -2)).min(-1)
    assert nearest.max() < 1e-9


def test_nearest_equivalent_beats_every_sampled_element(group):
    rng = np.random.default_rng(1)
    rotation = Rotation.random(30, rng=rng).as_matrix()
    reference = Rotation.random(30, rng=rng).as_matrix()
    found = group.rotation_error_deg(rotation, reference)
    for element in group.elements(90):
        moved = rotation @ element[:3, :3]
        angle = np.degrees(Rotation.from_matrix(np.swapaxes(moved, 1, 2) @ reference).magnitude())
        assert (found <= angle + 1e-6).all()
    nearest = group.nearest_equivalent(rotation, reference)
    np.testing.assert_allclose(group.rotation_error_deg(nearest, rotation), 0, atol=1e-4)
    np.testing.assert_allclose(group.nearest_equivalent(nearest, reference), nearest, atol=1e-9)


def test_known_angles():
    bottle = SymmetryGroup.from_settings(GROUPS["bottle"])
    tilt = _turn((0.6, 0.8, 0), 17)
    assert bottle.rotation_error_deg(tilt @ _turn((0, 0, 1), 131), np.eye(3)) == pytest.approx(17)
    two = SymmetryGroup.from_settings(GROUPS["two"])
    assert two.rotation_error_deg(_turn((0, 0, 1), 170), np.eye(3)) == pytest.approx(10)
    none = SymmetryGroup.none()
    assert none.rotation_error_deg(_turn((0, 1, 0), 1e-4), np.eye(3)) == pytest.approx(1e-4)


def test_equivalent_poses_move_points_by_group_elements():
    rng = np.random.default_rng(2)
    for name in GROUPS:
        group = SymmetryGroup.from_settings(GROUPS[name])
        if group.sphere:
            continue
        for _ in range(10):
            pose, reference = rigid(
                Rotation.random(2, rng=rng).as_matrix(), rng.normal(size=(2, 3))
            )
            nearest = group.nearest_equivalent_pose(pose, reference)
            element = np.linalg.inv(pose) @ nearest
            if group.axis is not None:  # the axis stays where the discrete part puts it
                point = group.offset + 0.3 * group.axis
                images = [d @ np.append(point, 1) for d in group.discrete]
                image = element @ np.append(point, 1)
                assert min(np.abs(image - other).max() for other in images) < 1e-9
            else:
                assert np.abs(group.discrete - element).max((1, 2)).min() < 1e-9


def test_rounded_rotations_have_an_equivalent(group):
    """Integrated poses are rotations to about 1e-6."""
    rng = np.random.default_rng(3)
    pose, reference = rigid(Rotation.random(2, rng=rng).as_matrix(), np.zeros((2, 3)))
    pose[:3, :3] += 5e-6 * rng.normal(size=(3, 3))
    found = group.nearest_equivalent_pose(pose, reference)
    rotation = group.nearest_equivalent(pose[:3, :3], reference[:3, :3])
    np.testing.assert_allclose(found[:3, :3], rotation, atol=1e-4)


@pytest.mark.parametrize(
    ("symmetry", "words"),
    [
        (Symmetry(discrete=(_flat(-np.eye(3)),)), "not a rotation"),
        (Symmetry(discrete=(_flat(2 * np.eye(3)),)), "not a rotation"),
        (Symmetry(discrete=(_flat(_turn((0, 0, 1), 1.234567)),)), "more than"),
        (Symmetry(continuous=(ContinuousSymmetry(axis=(0, 0, 0)),)), "no length"),
        (Symmetry(continuous=(ContinuousSymmetry(axis=(0, 0, 1)),) * 2), "sphere: true"),
    ],
)
def test_impossible_groups_are_refused(symmetry, words):
    with pytest.raises(ValueError, match=words):
        SymmetryGroup.from_settings(symmetry)


@pytest.mark.parametrize("fold", [3, 6, 8, 12])
def test_tables_of_four_digits_give_the_exact_group(fold):
    turn = tuple(np.round(_flat(_turn((0, 0, 1), 360 / fold)), 4))
    group = SymmetryGroup.from_settings(Symmetry(discrete=(turn,)))
    assert len(group.discrete) == fold
    turns = Rotation.random(40, random_state=fold).as_matrix()
    for pose, reference in rigid(turns, np.zeros((40, 3))).reshape(20, 2, 4, 4):
        found = group.nearest_equivalent_pose(pose, reference)[:3, :3]
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-9)
        assert group.rotation_error_deg(found, pose[:3, :3]) < 0.02
