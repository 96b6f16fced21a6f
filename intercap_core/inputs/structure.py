"""How deep and how large parsed values are, before anything walks through them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from itertools import chain
from typing import Any

MAX_DEPTH = 32  # of lists and objects within each other; COCO has 5, nerfstudio 4
MAX_VALUES = 1 << 27  # as met on the way through: one that is shared counts at every place


class TooMuch(ValueError):
    """The value is deeper or larger than its bounds, or holds itself; says which."""


def check_structure(value: Any, *, depth: int = MAX_DEPTH, values: int = MAX_VALUES) -> None:
    """Raise :class:`TooMuch` for lists, tuples, sets and dicts beyond a depth or a number of
    values, counted as one who walks through them would, also where few are held many times."""
    sizes: dict[int, tuple[int, int]] = {}  # of finished containers: values and depth
    open_: set[int] = set()
    stack: list[tuple[Any, list[Any] | None]] = [(value, None)]
    while stack:
        container, inner = stack.pop()
        key = id(container)
        if inner is None:
            if key in sizes or type(container) not in _CONTAINERS:
                continue
            if key in open_:
                raise TooMuch("it holds itself")
            if len(open_) >= depth:
                raise TooMuch(f"it is nested more than {depth} deep")
            open_.add(key)
            inner = [child for child in _children(container) if type(child) in _CONTAINERS]
            stack.append((container, inner))
            stack.extend((child, None) for child in inner)
            if any(id(child) in open_ for child in inner):
                raise TooMuch("it holds itself")
        else:
            found = [sizes[id(child)] for child in inner]
            size = len(container) + sum(size for size, _ in found)
            deep = 1 + max((deep for _, deep in found), default=0)
            if size > values or deep > depth:
                raise TooMuch(
                    f"it is nested more than {depth} deep"
                    if deep > depth
                    else f"it holds more than {values} values"
                )
            sizes[key] = size, deep
            open_.discard(key)


_CONTAINERS = frozenset({list, tuple, dict, OrderedDict, set, frozenset})


def _children(container: Any) -> Iterable[Any]:
    return chain(container.values(), container) if isinstance(container, dict) else container
