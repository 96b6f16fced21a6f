"""Shared by the comparisons of our stages with the paper's recipes: threads and tolerances.

All times of the comparisons are CPU seconds on one thread, so that other load of the machine does
not change them.
"""

from __future__ import annotations

import os

import numpy as np

from intercap_core.geometry.solve.thread_pool import VARIABLE

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when the numerical libraries start
THREADS = int(os.environ["OMP_NUM_THREADS"])
os.environ[VARIABLE] = str(THREADS)
AS_GOOD = 1.02  # factor of our error below which a result counts as equally accurate
NEAR_BEST = 1.05  # factor of the smallest error of a recipe that counts as its best


def first_as_good(
    errors: np.ndarray, ours: float, near_best: float = NEAR_BEST
) -> tuple[int, bool]:
    """Index of the first of errors (E,) that reaches ours, else of the first near the smallest.

    The second value tells whether it reaches ours.
    """
    is_as_good = bool(errors.min() <= AS_GOOD * ours)
    limit = AS_GOOD * ours if is_as_good else near_best * errors.min()
    return int(np.argmax(errors <= limit)), is_as_good
