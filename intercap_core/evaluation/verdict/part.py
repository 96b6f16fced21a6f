"""The parts of a result that are judged."""

from __future__ import annotations

from enum import StrEnum


class Part(StrEnum):
    """What is judged."""

    BODY = "body"
    HANDS = "hands"
    OBJECT = "object"
