"""The viewer's part of a page, and a page of its own."""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.output.viewer.content import gather
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

SCRIPT = "viewer.js"
# The file beside the page is of the same origin where a server gives it, and of none on a disk;
# pictures are made from the data.
POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'self' file: 'unsafe-inline'"
)


def style() -> str:
    """What stands in the page's style sheet."""
    return (DATA / "viewer.css").read_text(encoding="utf-8")


def element() -> str:
    """What stands where the viewer is to be; :func:`load` comes after it."""
    return (DATA / "viewer.html").read_text(encoding="utf-8")


def load() -> str:
    """What loads the file that lies beside the page, once the page stands."""
    return f'<script src="{SCRIPT}" async></script>'


def write_script(
    output: Path,
    paths: SequencePaths,
    models: SequenceModels,
    *,
    truth: Path | None = None,
) -> None:
    """Write the viewer with a sequence's data; see :func:`.content.gather` for the arguments."""
    found = gather(paths, models, truth=truth)
    output.write_text(script(found.header, found.arrays), encoding="utf-8")


def standalone(name: str) -> str:
    """A page that is nothing but the viewer of a sequence."""
    text = (DATA / "standalone.html").read_text(encoding="utf-8")
    parts = {"POLICY": POLICY, "NAME": html.escape(name), "STYLE": style(), "VIEWER": element(),
             "LOAD": load()}  # fmt: skip
    for key, value in parts.items():
        text = text.replace(f"@{key}@", value)
    return text


DATA = Path(__file__).parent / "data"
_TYPES = {"float32": "<f4", "uint32": "<u4", "uint16": "<u2", "int16": "<i2", "uint8": "|u1"}


def script(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """The viewer's code with its data: a classic script, which fills the page's viewer."""
    code = "\n".join(
        (DATA / name).read_text(encoding="utf-8") for name in ("three.js", "viewer.js")
    )
    return f'{code}\nshowInterCap("{payload(header, arrays)}");\n'


def payload(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """Base64 of: length of the header (uint32), the header, the arrays, each from a multiple of
    four bytes on."""
    places: dict[str, dict[str, Any]] = {}
    chunks: list[bytes] = []
    length = 0
    for name, values in arrays.items():
        kind = str(values.dtype)
        data = np.ascontiguousarray(values, _TYPES[kind]).tobytes()
        places[name] = {"type": kind, "shape": list(values.shape), "offset": length}
        data += b"\0" * (-len(data) % 4)
        chunks.append(data)
        length += len(data)
    text = json.dumps({**header, "arrays": places}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    whole = b"".join([len(text).to_bytes(4, "little"), text, *chunks])
    return base64.b64encode(zlib.compress(whole, 9)).decode()


def unpacked(text: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What :func:`payload` was made from; the viewer reads it the same way."""
    whole = zlib.decompress(base64.b64decode(text))
    start = 4 + int.from_bytes(whole[:4], "little")
    header = json.loads(whole[4:start])
    arrays = {}
    for name, place in header.pop("arrays").items():
        count = int(np.prod(place["shape"]))
        values = np.frombuffer(whole, _TYPES[place["type"]], count, start + place["offset"])
        arrays[name] = values.reshape(place["shape"])
    return header, arrays
