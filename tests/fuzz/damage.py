"""Damage to files, as hypothesis strategies: to values, text and bytes, and to the file's kind."""

from __future__ import annotations

import io
import json
import os
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

NUMBERS = (
    "1e308", "-1e308", "1e-308", "NaN", "Infinity", "1e999", "1" + "0" * 400, "-1", "0", "-0.0",
    "1e9", "-1e9", "1e-9", "1e30", "50", "0.001", "1000", "9223372036854775808", "4294967296",
    "18446744073709551616", "-9223372036854775809", "2147483648", "1e5", "3.5",
)  # fmt: skip
VALUES = (
    "null", "true", '""', "[]", "{}", "[[]]", '"x"', '"\\ud800"', '"../../etc/passwd"',
    '"/dev/zero"', '"' + "x" * 300 + '"', "[1, 2]", '{"a": 1, "a": 2}', "[null, NaN, 1e999]",
    '"\\u0000"', '[["a"]]', "[" + "0," * 2000 + "0]", "[" * 200 + "]" * 200,
)  # fmt: skip
OWN_VALUES = {
    "yaml": (
        "!!map [a]", "!!bool x", "!!int ''", "!!timestamp x", "!!python/object/apply:os.getpid []",
        "2024-13-45", "0x" + "f" * 400, "1:2:3", "*nowhere", "<<", ".inf", ".nan", "12_34",
        "!!opencv-matrix {rows: 3, cols: 3, dt: d, data: [1e999, 2]}",
    ),
    "toml": ("inf", "nan", "1979-05-27", "'''", "[[1]]", "{a = 1}", "0xffffffffffffffffff"),
}  # fmt: skip
EXTREMES = (
    b"\xff" * 8, b"\0" * 8, struct.pack("<d", 1e308), struct.pack("<d", float("nan")),
    struct.pack("<f", float("inf")), struct.pack("<i", 2**31 - 1), struct.pack("<q", 2**62),
    struct.pack(">I", 2**31), struct.pack("<I", 10**9), struct.pack("<f", 1e30), b"\x7f", b"\x80",
)  # fmt: skip
_TOKEN = re.compile(r'-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?|"(?:[^"\\\n]|\\.)*"|[A-Za-z_][\w./-]*')
_HEAD_BYTES = 512  # of a file's head, which states sizes, damaged as often as all the rest
_PLACE = "the value goes here"


def _sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 40 << 30)


REPLACEMENTS: dict[str, Callable[[Path], object]] = {
    "endless device": lambda path: path.symlink_to("/dev/zero"),
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
    "sparse file": _sparse,
    "empty file": Path.touch,
    "dangling link": lambda path: path.symlink_to("nowhere"),
}


@st.composite
def damaged(draw: st.DrawFn, content: bytes, form: str) -> bytes | str:
    """Content damaged once or a few times, or the name of a replacement of the whole file."""
    if draw(st.integers(0, 29)) == 29:
        return draw(st.sampled_from(sorted(REPLACEMENTS)))
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 4)))):
        damage = {"bytes": _bytes, "zip": _member, "json": _json}.get(form, _text)
        if form != "bytes" and draw(st.integers(0, 3)) == 3:
            damage = _bytes
        content = draw(damage(content, form))
    return content


def write(path: Path, content: bytes | str) -> None:
    """Write the result of :func:`damaged` in place of a file."""
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.unlink()
        REPLACEMENTS[content](path)


@st.composite
def _bytes(draw: st.DrawFn, content: bytes, form: str) -> bytes:
    data = bytearray(content or b"\0")
    last = len(data) - 1
    at = draw(st.one_of(st.integers(0, min(last, _HEAD_BYTES)), st.integers(0, last)))
    length = draw(st.sampled_from((1, 2, 4, 8, 64, 1024)))
    how = draw(st.sampled_from(("flip", "delete", "double", "cut", "insert", "extreme", "digit")))
    if how == "flip":
        data[at] ^= 1 << draw(st.integers(0, 7))
    elif how == "delete":
        del data[at : at + length]
    elif how == "double":
        data[at:at] = data[at : at + length] * draw(st.sampled_from((1, 50)))
    elif how == "cut":
        del data[at:]
    elif how == "insert":
        data[at:at] = draw(st.binary(min_size=length, max_size=length))
    elif how == "extreme":
        value = draw(st.sampled_from(EXTREMES))
        data[at : at + len(value)] = value
    else:
        near = range(max(0, at - 2000), min(len(data), at + 2000))
        digits = [place for place in near if 48 <= data[place] < 58]
        if digits:
            data[draw(st.sampled_from(digits))] = 48 + draw(st.integers(0, 9))
    return bytes(data)


@st.composite
def _text(draw: st.DrawFn, content: bytes, form: str) -> bytes:
    text = content.decode("utf-8", "surrogateescape")
    how = draw(st.sampled_from(("token", "token", "token", "line", "double", "exchange", "utf-8")))
    tokens = list(_TOKEN.finditer(text))
    if how == "token" and tokens:
        token = draw(st.sampled_from(tokens))
        pools = (NUMBERS, NUMBERS, VALUES, OWN_VALUES.get(form, VALUES))
        value = draw(st.sampled_from(draw(st.sampled_from(pools))))
        value = value.strip('"') if form == "text" else value
        text = text[: token.start()] + value + text[token.end() :]
    elif how == "exchange" and len(tokens) > 1:
        (a, b), (c, d) = sorted(draw(st.sampled_from(tokens)).span() for _ in range(2))
        if b <= c:
            text = text[:a] + text[c:d] + text[b:c] + text[a:b] + text[d:]
    else:
        lines = text.split("\n")
        place = draw(st.integers(0, len(lines) - 1))
        if how == "line":
            del lines[place]
        elif how == "double":
            lines.insert(place, lines[place])
        else:
            lines[place] += "\udcff\udc80"
        text = "\n".join(lines)
    return text.encode("utf-8", "surrogateescape")


@st.composite
def _json(draw: st.DrawFn, content: bytes, form: str) -> bytes:
    """One value changed, or an entry removed, repeated or renamed."""
    try:
        root = json.loads(content)
    except (ValueError, RecursionError):
        return draw(_text(content, form))
    places: list[tuple[Any, Any]] = []
    stack = [root]
    while stack:
        inner = stack.pop()
        if isinstance(inner, dict | list):
            keys: Any = inner if isinstance(inner, dict) else range(len(inner))
            places += [(inner, key) for key in keys]
            stack += [inner[key] for key in keys]
    # Lists of numbers outnumber everything else, so half of the places are named ones.
    named = [place for place in places if isinstance(place[0], dict)] or places
    if not places:
        return draw(_text(content, form))
    holder, key = draw(st.one_of(st.sampled_from(named), st.sampled_from(places)))
    how = draw(st.sampled_from(("value", "value", "value", "scale", "remove", "repeat", "rename")))
    raw = draw(st.sampled_from(draw(st.sampled_from((NUMBERS, VALUES)))))
    if how == "scale" and isinstance(holder[key], int | float) and abs(holder[key]) < 1e300:
        holder[key] *= draw(st.sampled_from((1, -1))) * 10.0 ** draw(st.integers(-12, 12))
    elif how == "remove":
        del holder[key]
    elif how == "repeat":
        holder[key] = [holder[key]] * draw(st.sampled_from((1, 2, 50)))
    elif how == "rename" and isinstance(holder, dict):
        holder[draw(st.sampled_from(("x", "", "k 1", "../a", "é" * 300)))] = holder.pop(key)
    else:
        holder[key] = _PLACE
    return json.dumps(root).replace(f'"{_PLACE}"', raw).encode()


@st.composite
def _member(draw: st.DrawFn, content: bytes, form: str) -> bytes:
    """One file of a zip archive damaged or removed, with correct checksums."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {info: archive.read(info) for info in archive.infolist()}
    except Exception:  # damaged before, which zipfile reports in many ways
        members = {}
    if not members:
        return draw(_bytes(content, form))
    chosen = draw(st.sampled_from(list(members)))
    members[chosen] = draw(st.one_of(st.none(), *[_bytes(members[chosen], form)] * 9))
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for info, inner in members.items():
            if inner is not None:
                archive.writestr(zipfile.ZipInfo(info.filename), inner, info.compress_type)
    return made.getvalue()
