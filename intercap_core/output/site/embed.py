"""How pictures and colours stand in a page, and the pages' shared frame."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from intercap_core.output.site.capture_pictures import CapturePicture
from intercap_core.output.site.closeups import CloseUp
from intercap_core.output.site.drawing import Sheet
from intercap_core.output.site.heat_pictures import HeatPicture
from intercap_core.output.site.overlays import Overlay

_TEMPLATES = Path(__file__).parent / "templates"
_POLICY = (  # what a page may load: nothing but itself
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)


def render(template: str, context: Mapping[str, Any]) -> str:
    """A whole page as text; what ``context`` holds is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    own = {
        "policy": _POLICY,
        "style": Markup((_TEMPLATES / "style.css").read_text(encoding="utf-8")),
        "script": Markup((_TEMPLATES / "script.js").read_text(encoding="utf-8")),
    }
    return environment.get_template(template).render({**own, **context})


def embedded(
    picture: HeatPicture | Overlay | CapturePicture | CloseUp | Sheet, caption: str
) -> dict[str, Any]:
    """What a template prints of a picture."""
    if isinstance(picture, CapturePicture):
        kind, data = picture.kind, picture.data
    elif isinstance(picture, Overlay | CloseUp | Sheet):
        kind, data = "jpeg", picture.jpeg
    else:
        kind, data = "png", picture.png
    return {
        "data": f"image/{kind};base64,{base64.b64encode(data).decode()}",
        "width": picture.width,
        "height": picture.height,
        "caption": caption,
    }


def css(colour: Sequence[float]) -> str:
    """A colour in 0..1 as CSS writes it."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in colour)


def tile(name: str, value: float | None, unit: str, note: str, digits: int = 1) -> dict[str, str]:
    """One of the page's first figures; a dash where it is not known."""
    known = value is not None and np.isfinite(value)
    text = f"{value:.{digits}f}{'' if unit == '°' else ' '}{unit}".rstrip() if known else "–"
    return {"name": name, "value": text, "note": note}


def span(first: int, last: int) -> str:
    """Frames ``first`` to ``last`` in words."""
    return f"{first}" if first == last else f"{first}–{last}"
