"""Stages of one camera, made once in a process."""

from __future__ import annotations

from functools import cache

from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.studio.interactions import INTERACTIONS
from intercap_core.studio.stage import StudioStage
from tests.helpers.fitted_capture import object_entry


@cache
def make_stage(interaction: str, subject: str, seed: int, frames: int = 45) -> StudioStage:
    capture = StudioCapture(interaction=interaction, subject=subject, seed=seed, frames=frames)
    name = INTERACTIONS[interaction].object_class
    entry = object_entry(name) if name else None
    return StudioStage(capture, StudioSettings(captures={}, cameras=1), entry)
