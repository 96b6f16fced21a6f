"""The viewer in a page, and a page of its own, with its data in a script in the same folder.

Pages opened from disk may not read files, but may load scripts. The script calls the viewer with
one argument in base64: a JSON header and the concatenated arrays, compressed.
"""

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
CODE = ("three.js", "meshes.js", "compare.js", "viewer.js")
# The script has the same origin on a server and scheme file: on disk; images are made from data.
POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'self' file: 'unsafe-inline'"
)


def style() -> str:
    """Return the CSS of the viewer."""
    return (DATA / "viewer.css").read_text(encoding="utf-8")


def element() -> str:
    """Return the HTML element of the viewer; :func:`load` comes after it."""
    return (DATA / "viewer.html").read_text(encoding="utf-8")


def load() -> str:
    """Return the HTML element that loads the script."""
    return f'<script src="{SCRIPT}" async></script>'


def write_script(
    output: Path, paths: SequencePaths, models: SequenceModels, *, truth: Path | None = None
) -> None:
    """Write the viewer with a sequence's data; see :func:`.content.gather` for the arguments."""
    content = gather(paths, models, truth=truth)
    output.write_text(script(content.header, content.arrays), encoding="utf-8")


def standalone(name: str) -> str:
    """Return a page that contains only the viewer."""
    text = (DATA / "standalone.html").read_text(encoding="utf-8")
    parts = {"POLICY": POLICY, "NAME": html.escape(name), "STYLE": style(), "VIEWER": element(),
             "LOAD": load()}  # fmt: skip
    for key, value in parts.items():
        text = text.replace(f"@{key}@", value)
    return text


DATA = Path(__file__).parent / "data"
_TYPES = {"float32": "<f4", "uint32": "<u4", "uint16": "<u2", "int16": "<i2", "uint8": "|u1"}


def script(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """Return the viewer's code and data as a classic script."""
    code = "\n".join((DATA / name).read_text(encoding="utf-8") for name in CODE)
    return f'{code}\nshowInterCap("{payload(header, arrays)}");\n'


def payload(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """Serialize header and arrays.

    Returns base64 of the compressed bytes: length of the header (uint32), header, and arrays, each
    aligned to four bytes.
    """
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
    """Parse the result of :func:`payload`, as the viewer does."""
    whole = zlib.decompress(base64.b64decode(text))
    start = 4 + int.from_bytes(whole[:4], "little")
    header = json.loads(whole[4:start])
    arrays = {}
    for name, place in header.pop("arrays").items():
        count = int(np.prod(place["shape"]))
        values = np.frombuffer(whole, _TYPES[place["type"]], count, start + place["offset"])
        arrays[name] = values.reshape(place["shape"])
    return header, arrays
