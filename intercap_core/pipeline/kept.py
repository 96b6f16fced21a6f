"""What is kept beside results to save reading: JSON that may be lost or damaged without harm."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Any

from intercap_core.artefacts import part_of


def read_kept(path: Path) -> dict[str, list[str]]:
    """Pairs of texts by name; those that are none, and a file that cannot be read, are left out."""
    told: Any = None
    with contextlib.suppress(OSError, ValueError, RecursionError):
        told = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(told, dict):
        return {}
    return {name: pair for name, pair in told.items() if _is_pair(pair)}


def keep(path: Path, pairs: dict[str, list[str]]) -> None:
    """Write them whole or not at all; where nothing can be written, results can be looked at."""
    part = part_of(path)
    with contextlib.suppress(OSError):
        try:
            part.write_text(json.dumps(pairs, indent=0, sort_keys=True), encoding="utf-8")
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def _is_pair(pair: Any) -> bool:
    return isinstance(pair, list) and len(pair) == 2 and all(isinstance(one, str) for one in pair)
