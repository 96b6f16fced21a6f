"""The nearest of many points, against scipy's k-d tree."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from intercap_core.geometry.rigid.point_grid import MAX_CELLS, PointGrid, sort_into_cells

RANDOM = np.random.default_rng(0)
SHAPES = {
    "one": np.ones((1, 3)),
    "the same": np.ones((40, 3)),
    "line": RANDOM.normal(size=(300, 1)) * [[0, 0.1, 0]],
    "plane": RANDOM.normal(size=(3000, 3)) * [0.3, 0, 0.3],
    "surface": 0.4
    * (lambda v: v / np.linalg.norm(v, axis=1, keepdims=True))(RANDOM.normal(size=(20000, 3))),
    "volume": RANDOM.uniform(-0.5, 0.5, (20000, 3)),
    "two far apart": np.concatenate([RANDOM.normal(size=(50, 3)), [[400.0, 300, 200]]]),
}


@pytest.mark.parametrize("cell", [0.005, 0.02, 0.3])
@pytest.mark.parametrize("name", SHAPES)
def test_distances_equal_a_k_d_tree(name: str, cell: float) -> None:
    points = SHAPES[name].astype(np.float32)
    near = points[RANDOM.integers(0, len(points), 400)] + RANDOM.normal(0, 0.01, (400, 3))
    asked = np.concatenate([near, RANDOM.uniform(-2, 2, (200, 3)), points[:50], [[90, -70, 50]]])
    found = PointGrid(points, cell).distance(asked)
    size = max(np.abs(points).max(), np.abs(asked).max())
    expected = cKDTree(points).query(asked.astype(np.float32))[0]
    assert found == pytest.approx(expected, abs=1e-7 * size)
    assert not len(PointGrid(points, cell).distance(np.zeros((0, 3))))
    _, starts, _, number, _ = sort_into_cells(points, cell)
    assert len(starts) - 1 == number.prod() <= MAX_CELLS
