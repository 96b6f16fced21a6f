"""Discovers the modules of a package, so that a new file there is a new reader, layout or term."""

from __future__ import annotations

import pkgutil
from functools import cache
from importlib import import_module
from types import ModuleType


@cache
def modules_of(package: str) -> tuple[ModuleType, ...]:
    """Import all modules of a package and return them in the order of their names.

    Write the name as a literal, ``modules_of("intercap_core.joint.terms")``:
    ``pipeline.code_digest`` reads it there and counts the modules as used by the caller.
    """
    names = sorted(entry.name for entry in pkgutil.iter_modules(import_module(package).__path__))
    return tuple(import_module(f"{package}.{name}") for name in names)
