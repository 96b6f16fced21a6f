"""Rendering of templates, and the parts that all pages share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

PREVIEW = "preview.jpg"  # small picture in the folder of a sequence's page
_TEMPLATES = Path(__file__).parent / "templates"
_POLICY = (  # a page may load nothing but itself and pictures of the site
    "default-src 'none'; img-src 'self' file: data:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'"
)


def render(template: str, context: Mapping[str, Any]) -> str:
    """Render a whole page; the values of ``context`` are escaped."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    shared = {
        "policy": _POLICY,
        "style": Markup((_TEMPLATES / "style.css").read_text(encoding="utf-8")),
        "script": Markup((_TEMPLATES / "script.js").read_text(encoding="utf-8")),
    }
    return environment.get_template(template).render({**shared, **context})


def css(colour: Sequence[float] | np.ndarray) -> str:
    """Format a colour in 0..1 for CSS."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in colour)


def tile(name: str, value: float | None, unit: str, note: str, digits: int = 1) -> dict[str, str]:
    """Return a headline figure of a page; a dash if its value is unknown."""
    known = value is not None and np.isfinite(value)
    text = f"{value:.{digits}f}{'' if unit == '°' else ' '}{unit}".rstrip() if known else "–"
    return {"name": name, "value": text, "note": note}


def span(first: int, last: int) -> str:
    """Format a range of frames."""
    return f"{first}" if first == last else f"{first}–{last}"
