"""Fixtures of the studio's tests."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest

from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.entries import ObjectEntry
from intercap_core.studio.interactions import INTERACTIONS
from intercap_core.studio.stage import StudioStage
from tests.helpers.fitted_capture import object_entry as catalogue_entry

MakeStage = Callable[..., StudioStage]


@pytest.fixture(scope="session")
def object_entry() -> Callable[[str], ObjectEntry]:
    """Entries of config/objects.yaml by name."""
    return catalogue_entry


@pytest.fixture(scope="session")
def make_stage() -> MakeStage:
    """Stage of one camera for an interaction, subject and seed; made once in a process."""

    @cache
    def make(interaction: str, subject: str, seed: int, frames: int = 45) -> StudioStage:
        capture = StudioCapture(interaction=interaction, subject=subject, seed=seed, frames=frames)
        name = INTERACTIONS[interaction].object_class
        entry = catalogue_entry(name) if name else None
        return StudioStage(capture, StudioSettings(captures={}, cameras=1), entry)

    return make
