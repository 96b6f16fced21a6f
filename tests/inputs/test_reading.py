"""Bounded reads: what is read is a regular file of bounded size, depth, and number of values."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.inputs import safe_pickle
from intercap_core.inputs.arrays import read_arrays
from intercap_core.inputs.files import Unreadable, check_file, path_fault, read_bytes, read_text
from intercap_core.inputs.json_files import parse_json, read_json, read_toml
from intercap_core.inputs.quotes import quoted
from intercap_core.inputs.structure import TooMuch, check_structure
from intercap_core.inputs.yaml_files import parse_yaml, read_yaml


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _large(path: Path) -> None:
    path.touch()
    os.truncate(path, 1 << 40)


NO_FILES = {
    "device": (_device, "it is a device"),
    "pipe": (os.mkfifo, "it is a pipe"),
    "folder": (Path.mkdir, "it is a folder"),
    "large": (_large, "MB, at most"),
    "nothing": (lambda path: None, "No such file"),
    "link": (lambda path: path.symlink_to("nowhere"), "No such file"),
}


@pytest.mark.parametrize("name", NO_FILES)
def test_only_regular_files_of_bounded_size_are_read(name: str, tmp_path: Path) -> None:
    make, words = NO_FILES[name]
    path = tmp_path / "input.json"
    make(path)
    readers: list[Callable[[Path], object]] = [
        lambda path: read_bytes(path, 1000),
        lambda path: read_bytes(path, 1000, head=10),
        lambda path: check_file(path, 1000),
        lambda path: read_text(path, 1000),
        lambda path: read_json(path, 1000),
        lambda path: read_toml(path, 1000),
        read_arrays,
    ]
    for read in readers:
        with pytest.raises(Unreadable) as caught:
            read(path)
        assert str(path) in str(caught.value) and words in str(caught.value)
        assert str(path) not in caught.value.reason


def test_a_file_of_exactly_the_limit_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert read_bytes(path, 5) == b"12345" and read_bytes(path, 5, head=2) == b"12"
    with pytest.raises(Unreadable, match="at most"):
        read_bytes(path, 4)


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "y/" * 3000, "\udcff"])
def test_names_that_no_file_has(name: str) -> None:
    assert path_fault(Path(name)) is not None
    with pytest.raises(Unreadable):
        read_bytes(Path(name), 10)
    assert path_fault(Path("a/b.json")) is None


def test_text_is_strict_and_its_mark_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbfone\ntwo")
    assert read_text(path, 100) == "one\ntwo"
    path.write_bytes(b"one\ntw\xff")
    with pytest.raises(Unreadable, match=r"UTF-8 \(line 2, byte 6\)"):
        read_text(path, 100)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1, "a": 2}', "'a' is given twice"),
        ("[" * 100_000, "nested too deeply"),
        ("[" * 40 + "]" * 40, "more than 32 deep"),
        ("1" * 5000, "5000 digits"),
        ("{", "Expecting"),
    ],
)
def test_json_that_is_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_json(text)


def test_whole_numbers_are_those_of_64_bits() -> None:
    most = (1 << 64) - 1
    assert parse_json(f"[{most}, -{1 << 63}, 12]") == [most, -(1 << 63), 12]
    assert parse_json(f"[{most + 1}]") == [float(most + 1)]
    assert parse_json("1" + "0" * 400) == np.inf and parse_json("-1" + "0" * 400) == -np.inf
    assert parse_json('{"k": 0.12345678901234567890123}') == {"k": 0.12345678901234567890123}


LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (LAUGHS, "values, aliases written out"),
        ("a: &a [1, *a]", "holds itself"),
        ("a: &a {<<: *a}", "holds itself"),
        ("a: !!map [a]", "no map"),
        ("a: !!set [a]", "the tag set is not used"),
        ("a: !!bool x", "no bool"),
        ("a: !!timestamp x", "no timestamp"),
        ("a: !!int ''", "no int"),
        ("a: !!float ''", "no float"),
        ("a: !!str [a]", "no str"),
        ("a: 2024-13-45", "month"),
        ("a: 1\na: 2", "'a' is given twice"),
        ("a: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
        ("[" * 5000, "nested"),
        ("? [a]\n: b", "unhashable"),
    ],
)
def test_yaml_that_is_refused(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match=words) as caught:
        read_yaml(path)
    assert str(path) in str(caught.value) and "not valid YAML" in str(caught.value)


def test_yaml_keeps_anchors_that_are_of_use() -> None:
    text = "base: &base {a: 1, b: 2}\nother: {<<: *base, b: 3}\nlist: [*base, *base]\n"
    found = parse_yaml(text)
    assert found["other"] == {"a": 1, "b": 3} and found["list"] == [{"a": 1, "b": 2}] * 2
    assert parse_yaml("9" * 30) == np.inf and parse_yaml("12:30:00:10") == "12:30:00:10"


def test_structures_are_counted_as_they_are_walked_through() -> None:
    shared: list[object] = [0] * 1000
    check_structure([shared] * 5, values=6000)
    with pytest.raises(TooMuch, match="more than 5000 values"):
        check_structure([shared] * 5, values=5000)
    shared[0] = {"inner": (shared,)}
    with pytest.raises(TooMuch, match="holds itself"):
        check_structure(shared)


def _npz(path: Path, name: str, content: bytes) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)


def _head(shape: str, descr: str = "<f8") -> bytes:
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (_head("(1000000000000,)"), "needs 8000000000000 bytes"),
        (_head("(2,)") + bytes(15), "needs 16 bytes, it has 15"),
        (_head("(1,)", "|O") + bytes(8), "expected numbers"),
        (_head("(-1,)"), "shape"),
        (_head("(" * 60 + ")" * 60), "no readable array"),
        (b"text", "no readable array"),
        (_head("(1 << 40)"), "no readable array"),
    ],
)
def test_arrays_whose_heads_lie(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    _npz(path, "values.npy", content)
    with pytest.raises(Unreadable, match=words) as caught:
        read_arrays(path)
    assert "'values'" in str(caught.value)


@pytest.mark.parametrize("order", "<>")
def test_text_of_numbers_that_are_no_characters(order: str, tmp_path: Path) -> None:
    letters = np.array([65, 0x110000], f"{order}u4").tobytes()
    _npz(tmp_path / "a.npz", "values.npy", _head("(2,)", f"{order}U1") + letters)
    with pytest.raises(Unreadable, match=r"'values' \(it holds text that is none"):
        read_arrays(tmp_path / "a.npz")
    good = np.array([65, 0x10FFFF], f"{order}u4").tobytes()
    _npz(tmp_path / "a.npz", "values.npy", _head("(2,)", f"{order}U1") + good)
    assert read_arrays(tmp_path / "a.npz")["values"].tolist() == ["A", "\U0010ffff"]
    program = pickle.dumps(np.array(["A", "B"], f"{order}U1"), protocol=2)
    wrong = np.array([66, 0x110000], f"{order}u4").tobytes().decode("latin1").encode()
    (tmp_path / "a.pkl").write_bytes(
        program.replace(np.array([65, 66], f"{order}u4").tobytes(), wrong)
    )
    with pytest.raises(UserError, match=r"a\.pkl: .*text that is none"):
        safe_pickle.load(tmp_path / "a.pkl")


def test_archives_that_unpack_to_too_much(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, zeros=np.zeros(1 << 20))
    assert path.stat().st_size < 20_000
    with pytest.raises(Unreadable, match="unpacks to 8 MB, at most 1"):
        read_arrays(path, limit=1 << 20)
    assert read_arrays(path)["zeros"].shape == (1 << 20,)


def test_arrays_come_as_numpy_reads_them(tmp_path: Path) -> None:
    values = {
        "a": np.arange(6, dtype=">i4").reshape(2, 3),
        "b": np.asfortranarray(np.random.default_rng(0).normal(size=(3, 2))),
        "text": np.array(["x", "yz"]),
        "none": np.zeros((0, 3), np.float32),
        "one": np.float64(2.5),
    }
    np.savez(tmp_path / "a.npz", **values)
    found = read_arrays(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as expected:
        assert list(found) == expected.files
        for name in expected.files:
            assert found[name].dtype == expected[name].dtype
            np.testing.assert_array_equal(found[name], expected[name])
    assert list(read_arrays(tmp_path / "a.npz", ["b"])) == ["b"]


_ITSELF: list[object] = []
_ITSELF.append(_ITSELF)
_SHARED: list[object] = [0] * 100
for _ in range(9):
    _SHARED = [_SHARED] * 100


class _Forged:
    """A dtype's state that numpy believes, and reads names of fields where there are none."""

    def __reduce__(self) -> tuple:
        return np.dtype, ("f8", False, True), (3, "<", None, ("a",), None, -1, -1, 63)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\x80\x04Nr\xff\xff\xff\x0f.", "remembers more values than it has"),
        (b"\x80\x05\x96" + struct.pack("<Q", 1 << 40) + b".", "expected"),
        (pickle.dumps(_ITSELF), "holds itself"),
        (pickle.dumps(_SHARED), "values"),
        (pickle.dumps([_Forged()]), "fields"),
        (pickle.dumps(np.zeros(2, [("a", "f8")])), "an array of|fields"),
        (
            b"cnumpy.core.multiarray\nscalar\n(cnumpy\ndtype\n(X\x06\x00\x00\x00S99999I0\nI1\ntRtR.",
            "holds an array of",
        ),
    ],
)
def test_pickles_that_take_memory_or_crash(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "bomb.pkl"
    path.write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        safe_pickle.load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_arrays_of_pickles_are_numpys_own(protocol: int, tmp_path: Path) -> None:
    values = {
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "big": np.arange(3, dtype=">u2"),
        "flags": np.array([True, False]),
        "text": np.array(["a", "bc"]),
        "objects": np.array([[1, 2], None, "x"], object),
        "empty": np.zeros((0, 3)),
        "inner": [(np.int32(7), np.ones(2, np.float32))],
    }
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(values, protocol=protocol))
    found = safe_pickle.load(path)
    for name in ("fortran", "big", "flags", "text", "empty"):
        assert type(found[name]) is np.ndarray
        native = found[name].dtype.newbyteorder("=")  # numpy turns some around, by protocol
        assert native == values[name].dtype.newbyteorder("=")
        np.testing.assert_array_equal(found[name], values[name])
    assert found["objects"].tolist() == [[1, 2], None, "x"]
    assert type(found["inner"][0][1]) is np.ndarray and found["inner"][0][0] == 7
    pickle.dumps(found)


@pytest.mark.parametrize(
    "value",
    [10**5000, "x" * 10_000, [[0] * 1000] * 1000, {"k" * 900: 1}, "\udcff", float("nan")],
    ids=["number", "text", "lists", "key", "surrogate", "nan"],
)
def test_quotes_are_short_and_printable(value: object) -> None:
    text = quoted(value)
    assert 0 < len(text) <= 240 and text.encode() and "\n" not in text


def test_deep_values_are_quoted_without_end() -> None:
    deep: list[object] = []
    for _ in range(100_000):
        deep = [deep]
    assert len(quoted(deep)) < 100
    assert json.loads(json.dumps(quoted(io.BytesIO())))
