"""Lists on disk."""

from __future__ import annotations

import numpy as np

from intercap_core.disk import DiskList


def test_items_are_read_back_in_any_order(tmp_path):
    items = [np.arange(number) if number % 3 else None for number in range(8)]
    listed: DiskList[np.ndarray | None] = DiskList(tmp_path)
    for item in items:
        listed.append(item)
    assert len(listed) == 8 and listed[3] is None
    assert listed[7].tolist() == list(range(7)) and listed[-1].tolist() == list(range(7))
    assert [len(item) for item in listed.select([5, 1])] == [5, 1]
    assert [None if item is None else len(item) for item in listed[2:4]] == [2, None]
    assert not list(tmp_path.iterdir())  # the file has no name
