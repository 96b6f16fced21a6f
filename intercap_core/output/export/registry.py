"""All file formats of the export: those that the modules of this package declare."""

from __future__ import annotations

from functools import cache

from intercap_core.output.export.format import ExportFormat
from intercap_core.plugins import modules_of


@cache
def formats() -> dict[str, ExportFormat]:
    """Return the formats by name, in alphabetical order."""
    declared = [
        format_
        for module in modules_of("intercap_core.output.export")
        for format_ in getattr(module, "FORMATS", ())
    ]
    return {format_.name: format_ for format_ in sorted(declared, key=lambda f: f.name)}
