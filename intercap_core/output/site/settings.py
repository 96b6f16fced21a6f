"""Settings of a dataset that differ from their defaults."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

from intercap_core.config import Config

# places of files, sections that other parts of the page show, and settings of the run alone
_LEFT_OUT = {
    "dataset", "exclude", "sequences", "subjects", "objects", "annotations", "results",
    "body_models", "card", "studio", "cluster", "one_process",
}  # fmt: skip


def changed(config: Config) -> list[tuple[str, str, str]]:
    """Return name, value and default of each setting that differs from its default."""
    defaults = _leaves(Config(dataset="any").model_dump(exclude=_LEFT_OUT))
    return [
        (name, _text(value), _text(defaults.get(name)))
        for name, value in _leaves(config.model_dump(exclude=_LEFT_OUT)).items()
        if value != defaults.get(name)
    ]


def _leaves(values: dict[str, Any], above: str = "") -> dict[str, Any]:
    """Return the values by dotted name."""
    leaves: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{above}{key}"
        leaves |= _leaves(value, f"{name}.") if isinstance(value, dict) and value else {name: value}
    return leaves


def _text(value: Any) -> str:
    if isinstance(value, PurePath):  # without its folder, which depends on the machine
        return value.name
    if isinstance(value, list | tuple | set):
        return ", ".join(map(_text, value))
    return "–" if value is None else str(value)
