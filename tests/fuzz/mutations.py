"""Damage to files, from a seeded generator: to values, text, bytes, and to what the name means."""

from __future__ import annotations

import io
import json
import os
import random
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

NUMBERS = (
    "1e308", "-1e308", "1e-308", "NaN", "Infinity", "1e999", "1" + "0" * 400, "-1", "0", "-0.0",
    "1e9", "-1e9", "1e-9", "1e30", "50", "0.001", "1000", "9223372036854775808",
    "18446744073709551616", "-9223372036854775809", "4294967296", "2147483648", "1" * 5000, "1e5",
    "3.5",
)  # fmt: skip
OTHERS = (
    "null", "true", "false", '""', "[]", "{}", "[[]]", '"x"', '"\\ud800"', '"../../etc/passwd"',
    '"/dev/zero"', '"' + "x" * 300 + '"', '"' + "y" * 100_000 + '"', "[1, 2]", '{"a": 1, "a": 2}',
    "[" * 200 + "]" * 200, "[" * 100_000, '{"a":' * 500 + "1" + "}" * 500, "[null, NaN, 1e999]",
    '"\\u0000"', "[0]", '[["a"]]', "[" + "0," * 20_000 + "0]",
)  # fmt: skip
_LAUGHS = ", ".join(
    ["&l0 [x, x, x, x, x, x, x, x, x, x]"]
    + [f"&l{n} [{', '.join([f'*l{n - 1}'] * 10)}]" for n in range(1, 12)]
)
YAML_VALUES = (
    "&self [*self]", "&me {a: *me}", f"[{_LAUGHS}]", "!!map [a]", "!!set [a]", "!!bool x",
    "!!int ''", "!!timestamp x", "!!float ''", "!!null x", "!!python/object/apply:os.system [ls]",
    "!!binary x",
    "!!omap [a]", "!!pairs [a]", "!!str [a]", "!!seq {a: b}", "2024-13-45",
    "0001-01-01T00:00:00+23:59",
    "0x" + "f" * 400, "1:2:3", "*nowhere", "? [a]\n: b", "<<", "!!opencv-matrix {rows: 3}",
    "!!opencv-matrix {rows: 3, cols: 3, dt: d, data: [1e999, 2]}", ".inf", ".nan", "12_34", "0b1",
)  # fmt: skip
TOML_VALUES = ("inf", "nan", "1979-05-27", "'''", '"""', "[[1]]", "{a = 1}", "0xffffffffffffffffff")
_TOKEN = re.compile(r'-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?|"(?:[^"\\\n]|\\.)*"|[A-Za-z_][\w./-]*')
_ZIP_ERRORS = (
    zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, NotImplementedError,
    RuntimeError, OverflowError, IndexError,
)  # fmt: skip
_PLACE = "here a value comes"
EXTREMES = (
    b"\xff" * 8, b"\0" * 8, struct.pack("<d", 1e308), struct.pack("<d", float("nan")),
    struct.pack("<f", float("inf")), struct.pack("<i", 2**31 - 1), struct.pack("<q", 2**62),
    struct.pack(">I", 2**31), struct.pack("<I", 10**9), struct.pack("<f", 1e30), b"\x7f", b"\x80",
)  # fmt: skip


def damage(path: Path, form: str, chance: random.Random) -> str:
    """Damage a file in place, once or a few times; returns in words how."""
    if chance.random() < 0.03:
        return _misplaced(path, chance)
    words = []
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        content = path.read_bytes()
        if form in ("bytes",) or chance.random() < 0.25:
            content, told = _bytes(content, chance)
        elif form == "zip":
            content, told = _member(content, chance)
        elif form == "pickle":
            content, told = _program(content, chance)
        else:
            content, told = _text(content, form, chance)
        path.write_bytes(content)
        words.append(told)
    return ", ".join(words)


def _misplaced(path: Path, chance: random.Random) -> str:
    """Something else than a file of sensible size under its name."""
    kind = chance.choice(("endless device", "pipe", "folder", "sparse", "empty", "dangling link"))
    path.unlink()
    if kind == "endless device":
        path.symlink_to("/dev/zero")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "sparse":
        path.touch()
        os.truncate(path, 40 << 30)
    elif kind == "empty":
        path.touch()
    else:
        path.symlink_to(path.with_name("nothing there"))
    return kind


def _bytes(content: bytes, chance: random.Random) -> tuple[bytes, str]:
    data = bytearray(content)
    if not data:
        return b"\0", "a byte"
    at = chance.randrange(len(data))
    if chance.random() < 0.4:  # heads hold what readers act on
        at = min(at, chance.randrange(512))
    length = chance.choice((1, 1, 2, 4, 8, 64, 1024))
    how = chance.choice(("flip", "delete", "double", "cut", "insert", "extreme", "digit"))
    if how == "flip":
        for place in range(at, min(len(data), at + chance.choice((1, 1, 8)))):
            data[place] ^= 1 << chance.randrange(8)
    elif how == "delete":
        del data[at : at + length]
    elif how == "double":
        data[at:at] = data[at : at + length] * chance.choice((1, 1, 50))
    elif how == "cut":
        del data[at:]
    elif how == "insert":
        data[at:at] = chance.randbytes(length)
    elif how == "extreme":
        value = chance.choice(EXTREMES)
        data[at : at + len(value)] = value
    else:
        digits = [
            n for n in range(max(0, at - 2000), min(len(data), at + 2000)) if 48 <= data[n] < 58
        ]
        if digits:
            data[chance.choice(digits)] = 48 + chance.randrange(10)
    return bytes(data), f"{how} at {at}"


def _text(content: bytes, form: str, chance: random.Random) -> tuple[bytes, str]:
    text = content.decode("utf-8", "surrogateescape")
    if form == "json" and chance.random() < 0.7:
        changed = _json(text, chance)
        if changed is not None:
            return changed
    how = chance.choice(("token", "token", "token", "line", "double", "exchange", "encoding"))
    tokens = list(_TOKEN.finditer(text))
    if how == "token" and tokens:
        token = chance.choice(tokens)
        value = _value(form, chance)
        text = text[: token.start()] + value + text[token.end() :]
        told = f"{token.group()[:30]} to {value[:30]}"
    elif how == "exchange" and len(tokens) > 1:
        a, b = sorted(chance.sample(tokens, 2), key=lambda found: found.start())
        text = (
            text[: a.start()] + b.group() + text[a.end() : b.start()] + a.group() + text[b.end() :]
        )
        told = f"{a.group()[:30]} for {b.group()[:30]}"
    else:
        lines = text.split("\n")
        place = chance.randrange(len(lines))
        if how == "line":
            told = f"without line {place + 1}"
            del lines[place]
        elif how == "double":
            told = f"line {place + 1} twice"
            lines.insert(place, lines[place])
        else:
            told = f"no UTF-8 in line {place + 1}"
            lines[place] += "\udcff\udc80"
        text = "\n".join(lines)
    return text.encode("utf-8", "surrogateescape"), told


def _value(form: str, chance: random.Random) -> str:
    own: tuple[str, ...] = {"yaml": YAML_VALUES, "toml": TOML_VALUES}.get(form, ())
    pool = chance.choice((NUMBERS, NUMBERS, OTHERS, own or OTHERS))
    value = chance.choice(pool)
    return value.strip('"') if form in ("table", "text") else value


def _json(text: str, chance: random.Random) -> tuple[bytes, str] | None:
    """Change one value, or take out, repeat or rename an entry, of a JSON text."""
    try:
        root: Any = json.loads(text)
    except (ValueError, RecursionError):
        return None
    places: list[tuple[Any, Any]] = []
    stack = [root]
    while stack:
        inner = stack.pop()
        keys: Any = inner if isinstance(inner, dict) else range(len(inner))
        for key in keys:
            places.append((inner, key))
            if isinstance(inner[key], list | dict):
                stack.append(inner[key])
    if not places:
        return None
    # Deep lists of numbers outnumber everything else: half of the time another place is wanted.
    named = [place for place in places if isinstance(place[0], dict)]
    holder, key = chance.choice(named if named and chance.random() < 0.6 else places)
    how = chance.choice(("value", "value", "value", "number", "without", "repeat", "rename"))
    raw = chance.choice(chance.choice((NUMBERS, OTHERS)))
    told = f"{how} of {key!r}"
    if how == "number" and isinstance(holder[key], int | float):
        raw = repr(holder[key] * 10.0 ** chance.randrange(-12, 13) * chance.choice((1, -1)))
        holder[key] = _PLACE
    elif how == "without":
        del holder[key]
    elif how == "repeat":
        value = holder[key]
        holder[key] = [value] * chance.choice((2, 50)) if len(repr(value)) < 10_000 else [value]
    elif how == "rename" and isinstance(holder, dict):
        holder[chance.choice(("x", "", "k 1", "../a", "é" * 300))] = holder.pop(key)
    else:
        holder[key] = _PLACE
        told += f" is {raw[:30]}"
    try:
        made = json.dumps(root)
    except (ValueError, RecursionError):
        return None
    return made.replace(f'"{_PLACE}"', raw).encode(), told


def _member(content: bytes, chance: random.Random) -> tuple[bytes, str]:
    """Damage one file of a zip archive, sums put right; else the archive's own bytes."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [(info, archive.read(info)) for info in archive.infolist()]
        place = chance.randrange(len(members))
    except _ZIP_ERRORS:  # damaged before
        return _bytes(content, chance)
    made = io.BytesIO()
    told = "nothing"
    drop = chance.random() < 0.08
    with zipfile.ZipFile(made, "w") as archive:
        for index, (info, inner) in enumerate(members):
            if index == place and drop:
                told = f"without {info.filename}"
                continue
            if index == place:
                inner, told = _bytes(inner, chance)
                told += f" of {info.filename}"
            fresh = zipfile.ZipInfo(info.filename)
            fresh.compress_type = info.compress_type
            archive.writestr(fresh, inner)
    return made.getvalue(), told


def _program(content: bytes, chance: random.Random) -> tuple[bytes, str]:
    """A pickle with a bomb put in, or damaged."""
    bombs = (
        b"\x80\x04N\x94r\xff\xff\xff\x0f.",  # remembers under a large number
        b"\x80\x04]\x94" + b"".join(b"]\x94(" + b"h%c" % n * 200 + b"e" for n in range(9)) + b".",
        b"\x80\x04]\x94h\0a.",  # holds itself
        b"\x80\x05\x96" + struct.pack("<Q", 1 << 33) + b".",
        b"cnumpy\ndtype\n(X\x02\x00\x00\x00f8I0\nI1\ntR(I3\nX\x01\x00\x00\x00<NNNI-1\nI-1\nI63\ntb.",
        b"cnumpy\nndarray\n((I100000\nI100000\nttR.",
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntc_codecs\nencode\n(Vb\nVlatin1\n"
        b"tRtR(I1\n(I99999\ntcnumpy\ndtype\n(VO8\nI0\nI1\ntRI00\n(ltb.",
        b"cos\nsystem\n(S'true'\ntR.",
    )
    if chance.random() < 0.15:
        return chance.choice(bombs), "another program"
    return _bytes(content, chance)
