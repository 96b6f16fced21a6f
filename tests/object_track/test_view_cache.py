"""Frame sets are loaded once while they fit."""

import numpy as np

from intercap_core.object_track.reduced_mask import EMPTY
from intercap_core.object_track.view import View
from intercap_core.object_track.view_cache import ViewCache


def test_frames_stay_while_they_fit_and_the_least_used_go_first():
    loaded = []

    def load(t: int) -> list[View]:
        loaded.append(t)
        return [View(None, np.zeros((10, 10), np.float32), EMPTY, ()) for _ in range(2)]

    views = ViewCache(load, max_bytes=2400)  # three frames of 800 bytes
    for t in (0, 1, 2, 0, 1, 2):
        assert views(t) is views(t)
    assert loaded == [0, 1, 2]
    views(0)
    views(3)
    views(0)
    assert loaded == [0, 1, 2, 3]
    views(1)
    assert loaded == [0, 1, 2, 3, 1]


def test_a_frame_larger_than_all_memory_is_kept_while_it_is_used():
    views = ViewCache(lambda t: [View(None, np.zeros(100), EMPTY, ())], max_bytes=10)
    assert views(0) is views(0)
