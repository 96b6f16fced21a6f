"""Which settings a dataset was made with, as far as they are not the program's own."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

from intercap_core.config import Config

# what is of one machine, or told elsewhere: where files are, the card, what the studio is to make
_LEFT_OUT = {
    "dataset", "exclude", "sequences", "subjects", "objects", "annotations", "results",
    "body_models", "card", "studio",
}  # fmt: skip


def changed(config: Config) -> list[tuple[str, str, str]]:
    """Name, value and default of each setting that has another value than its default."""
    own = config.model_dump(exclude=_LEFT_OUT)
    defaults = Config(dataset="any").model_dump(exclude=_LEFT_OUT)
    return [
        (name, _text(value), _text(_at(defaults, name)))
        for name, value in _leaves(own)
        if value != _at(defaults, name)
    ]


def _leaves(values: dict[str, Any], above: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in values.items():
        name = f"{above}{key}"
        if isinstance(value, dict) and value:
            found += _leaves(value, f"{name}.")
        else:
            found.append((name, value))
    return found


def _at(values: Any, name: str) -> Any:
    """What stands under a dotted name; None where nothing does."""
    for key in name.split("."):
        values = values.get(key) if isinstance(values, dict) else None
    return values


def _text(value: Any) -> str:
    if isinstance(value, PurePath):  # of files the name alone: folders are of one machine
        return value.name
    if isinstance(value, list | tuple | set):
        return ", ".join(map(_text, value))
    return "–" if value is None else str(value)
