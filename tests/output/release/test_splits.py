"""No group is in both parts, the test part is near the share, and the choice is stable."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from intercap_core.output.release.card import TEST, TRAIN, split

NAMES = st.text("abcdefghij0123456789_", min_size=1, max_size=6)


def _test_part(parts: dict[str, str]) -> tuple[str, ...]:
    return tuple(sorted(name for name, part in parts.items() if part == TEST))


@given(st.dictionaries(NAMES, st.integers(1, 500), min_size=2, max_size=30), st.floats(0.05, 0.6))
def test_every_group_is_in_one_part_near_the_share(frames: dict[str, int], share: float) -> None:
    parts, why = split(frames, share=share)
    assert not why and set(parts.values()) == {TRAIN, TEST} and set(parts) == set(frames)
    test = _test_part(parts)
    test_frames, total = sum(frames[name] for name in test), sum(frames.values())
    if len(test) > 1:  # the last one that was taken brought it nearer
        assert abs(test_frames - share * total) <= share * total
    assert split(dict(reversed(frames.items())), share=share) == (parts, why)


def test_ten_equal_subjects_give_two() -> None:
    parts, _ = split({f"s{i:02d}": 100 for i in range(10)}, share=0.2)
    assert len(_test_part(parts)) == 2 and len(parts) == 10


@pytest.mark.parametrize(
    ("frames", "share", "named", "test", "why"),
    [
        ({"a": 5}, 0.2, (), (), "only one"),
        ({}, 0.2, (), (), "there is no group"),
        ({"a": 5, "b": 5}, 0.0, (), (), "test part is 0"),
        ({"a": 5, "b": 500}, 0.2, (), ("a",), ""),
        ({"a": 5, "b": 5, "c": 5}, 0.2, ("b", "not_recorded"), ("b",), ""),
        ({"a": 5, "b": 5}, 0.0, ("b",), ("b",), ""),
        ({"a": 5, "b": 5}, 0.2, ("a", "b"), (), "all groups"),
        ({"a": 5, "b": 5}, 0.2, ("x",), (), "none of x"),
    ],
)
def test_splits_of_few_or_named_groups(
    frames: dict[str, int], share: float, named: tuple[str, ...], test: tuple[str, ...], why: str
) -> None:
    parts, why_not = split(frames, share=share, named=named)
    assert _test_part(parts) == test
    assert why in why_not if why else not why_not
