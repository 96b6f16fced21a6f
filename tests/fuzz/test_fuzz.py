"""A few damaged files of each kind; `make fuzz` has thousands."""

from __future__ import annotations

import pytest

from tests.fuzz.kinds import KINDS
from tests.fuzz.run import check_kind

CASES = 2


@pytest.mark.parametrize("name", KINDS)
def test_damaged_files_are_plausible_or_refused_by_name(name: str) -> None:
    assert check_kind(KINDS[name], CASES, number=2).total() >= CASES
