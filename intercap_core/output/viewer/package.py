"""Arrays and words as one script that a page from disk can load beside it.

A page from disk may not read its neighbours, but it may load them as scripts. The payload is a
header in JSON and the arrays end to end, deflated, in base64, as the one argument of a call.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

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


def quantised(points: np.ndarray) -> tuple[np.ndarray, list[float], float]:
    """Points (..., 3) as uint16 steps above a corner, the corner (3,) and the step, metres."""
    flat = points.reshape(-1, 3)
    low = flat.min(0) if len(flat) else np.zeros(3)
    extent = float((flat.max(0) - low).max()) if len(flat) else 1.0
    step = max(extent, 1e-6) / 65535
    return np.rint((points - low) / step).astype(np.uint16), low.tolist(), step
