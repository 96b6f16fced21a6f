"""The sequence of states of least total cost (Viterbi, IEEE Trans. Inf. Theory 13(2):260, 1967)."""

from __future__ import annotations

import numpy as np


def cheapest_sequence(
    first: np.ndarray, steps: np.ndarray, last: np.ndarray | None = None
) -> np.ndarray:
    """States (T,) int64 that minimise first[s_0] + sum_t steps[t, s_t, s_t+1] + last[s_T-1].

    ``first`` and ``last`` (S,) are costs of the states that a sequence begins and ends in;
    ``steps`` (T - 1, S, S) of going from one state to the next, the next one's own cost included.
    Of equal costs the lowest state is taken.
    """
    total, came_from = np.asarray(first), []
    for step in steps:
        reach = total[:, None] + step
        came_from.append(reach.argmin(0))
        total = reach.min(0)
    chosen = [int((total if last is None else total + last).argmin())]
    for back in reversed(came_from):
        chosen.append(int(back[chosen[-1]]))
    return np.array(chosen[::-1])
