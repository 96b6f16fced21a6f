"""Derivatives are compared in double precision."""

from __future__ import annotations

import pytest

from intercap_core.body.model import BodyModel


@pytest.fixture(scope="session")
def model(body64: BodyModel) -> BodyModel:
    return body64
