"""Fixtures of the studio's tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from intercap_core.config import ObjectEntry

CONFIG = Path(__file__).resolve().parents[2] / "config"


@pytest.fixture(scope="session")
def object_entry() -> Callable[[str], ObjectEntry]:
    """Entries of config/objects.yaml by name."""

    def entry(name: str) -> ObjectEntry:
        found = yaml.safe_load((CONFIG / "objects.yaml").read_text())[name]
        return ObjectEntry(name=name, mesh=CONFIG / found["mesh"], labels=found["labels"])

    return entry
