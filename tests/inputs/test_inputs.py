"""Reading of files that users supply: file types and sizes, documents, arrays, quoted values."""

from __future__ import annotations

import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from intercap_core.entries import ObjectEntry
from intercap_core.inputs.arrays import read_arrays, read_pickle
from intercap_core.inputs.documents import (
    dump_yaml,
    parse_json,
    parse_yaml,
    read_json,
    read_toml,
    read_yaml,
)
from intercap_core.inputs.files import (
    UnreadableFile,
    check_file,
    path_fault,
    quoted,
    read_bytes,
    read_text,
)


def _large(path: Path) -> None:
    path.touch()
    os.truncate(path, 1 << 40)


NO_FILES = {
    "device": (lambda path: path.symlink_to("/dev/zero"), "it is a device"),
    "pipe": (os.mkfifo, "it is a pipe"),
    "folder": (Path.mkdir, "it is a folder"),
    "large": (_large, "MB, at most"),
    "nothing": (lambda path: None, "No such file"),
    "link": (lambda path: path.symlink_to("nowhere"), "No such file"),
}


@pytest.mark.parametrize("name", NO_FILES)
def test_only_regular_files_up_to_the_limit_are_read(name: str, tmp_path: Path) -> None:
    make, words = NO_FILES[name]
    path = tmp_path / "input.json"
    make(path)
    readers: list[Callable[[Path], object]] = [
        lambda path: read_bytes(path, 1000),
        lambda path: read_bytes(path, 1000, head=10),
        lambda path: check_file(path, 1000),
        lambda path: read_text(path, 1000),
        read_json,
        read_toml,
        read_arrays,
        read_pickle,
    ]
    for read in readers:
        with pytest.raises(UnreadableFile) as caught:
            read(path)
        assert str(path) in str(caught.value) and words in str(caught.value)
        assert str(path) not in caught.value.reason


def test_a_file_of_exactly_the_limit_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert read_bytes(path, 5) == b"12345" and read_bytes(path, 5, head=2) == b"12"
    with pytest.raises(UnreadableFile, match="at most"):
        read_bytes(path, 4)


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "y/" * 3000, "\udcff"])
def test_impossible_paths_are_refused(name: str) -> None:
    assert path_fault(Path(name)) is not None
    with pytest.raises(UnreadableFile):
        read_bytes(Path(name), 10)
    assert path_fault(Path("a/b.json")) is None


def test_text_is_strict_utf_8_without_its_mark(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbfone\ntwo")
    assert read_text(path, 100) == "one\ntwo"
    path.write_bytes(b"one\ntw\xff")
    with pytest.raises(UnreadableFile, match=r"UTF-8 \(line 2, byte 6\)"):
        read_text(path, 100)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1, "b": 2, "a": 3}', "'a' is given twice"),
        ("[" * 100_000, "nested too deeply"),
        ("{", "Expecting"),
    ],
)
def test_malformed_json_is_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_json(text)


def test_integers_beyond_64_bits_become_floats(tmp_path: Path) -> None:
    most = (1 << 64) - 1
    assert parse_json(f"[{most}, -{1 << 63}, 12]") == [most, -(1 << 63), 12]
    assert parse_json(f"[{most + 1}]") == [float(most + 1)]
    huge = "1" + "0" * 400
    assert parse_json(huge) == np.inf and parse_json(f"-{huge}") == -np.inf
    assert parse_json('{"k": 0.12345678901234567890123}') == {"k": 0.12345678901234567890123}
    assert parse_yaml("9" * 30) == np.inf
    (tmp_path / "a.toml").write_text(f"a = 12\nb = [{huge}]")
    assert read_toml(tmp_path / "a.toml") == {"a": 12, "b": [np.inf]}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: !!map [a]", "expected a mapping"),
        ("a: !!bool x", "does not fit its tag"),
        ("a: !!timestamp x", "does not fit its tag"),
        ("a: !!int ''", "does not fit its tag"),
        ('1: a\n"1": b', "in line 2 .*'1' is given twice"),
        ("b: 0\na: 1\na: 2", "in line 3 .*'a' is given twice"),
        ("a: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
        ("[" * 1500, "nested"),
        ("? [a]\n: b", "unhashable"),
    ],
)
def test_malformed_yaml_is_refused(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(UnreadableFile, match=words) as caught:
        read_yaml(path)
    assert str(path) in str(caught.value) and "not valid YAML" in str(caught.value)


def test_yaml_keeps_anchors_and_reads_time_codes_as_text() -> None:
    text = "base: &base {a: 1, b: 2}\nother: {<<: *base, b: 3}\nlist: [*base, *base]\n"
    content = parse_yaml(text)
    assert content["other"] == {"a": 1, "b": 3} and content["list"] == [{"a": 1, "b": 2}] * 2
    assert parse_yaml("12:30:00:10") == "12:30:00:10"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("00010", 10), ("0o10", 8), ("0x1F", 31), ("-07", -7), ("1e3", 1000.0), ("1.", 1.0),
        (".5", 0.5), ("-.inf", -np.inf), ("yes", "yes"), ("no", "no"), ("on", "on"), ("True", True),
        ("1_000", "1_000"), ("0b11", "0b11"), ("2024-01-02", "2024-01-02"), ("1:30", "1:30"),
        ("~", None), ("", None), ("=", "="), ("+", "+"), (".", "."),
    ],
)  # fmt: skip
def test_yaml_scalars_are_those_of_version_1_2(text: str, value: Any) -> None:
    read = parse_yaml(f"a: {text}\n")["a"]
    assert read == value and isinstance(read, type(value))
    assert parse_yaml(dump_yaml({"a": text, "b": read})) == {"a": text, "b": value}
    assert yaml.safe_load(dump_yaml({"a": text})) == {"a": text}  # also for readers of version 1.1


def test_scalars_as_keys_and_names_are_text() -> None:
    keys = ["1", "02", "0.50", "1e3", "true", "False", "null", "~", ".inf"]
    assert list(parse_yaml(f"{{{', '.join(f'{key}: a' for key in keys)}}}")) == keys
    for text in ("02", "1e3", "0.50", "1.", ".5"):
        assert str(parse_yaml(text)) == text and parse_yaml(text) == float(text)
    entry = ObjectEntry.model_validate(
        {"name": "box", "mesh": "a.ply"} | parse_yaml("labels: [1e3]")
    )
    assert entry.labels == ("1e3",)


def _npz(path: Path, content: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("values.npy", content)
    return path


def _head(shape: str, descr: str = "<f8") -> bytes:
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (_head("(1000000000000,)"), "Unable to allocate"),
        (_head("(2,)") + bytes(15), "expected 16 bytes got 15"),
        (_head("(1,)", "|O") + bytes(8), "Object arrays cannot be loaded"),
        (_head("(-1,)"), "negative dimensions"),
        (_head("(" * 60 + ")" * 60), "no readable array"),
        (b"text", "no readable array"),
    ],
)
def test_arrays_with_a_wrong_head_are_refused(content: bytes, words: str, tmp_path: Path) -> None:
    with pytest.raises(UnreadableFile, match=words) as caught:
        read_arrays(_npz(tmp_path / "a.npz", content))
    assert "'values'" in str(caught.value)


def test_the_unpacked_size_of_an_archive_is_limited(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, zeros=np.zeros(1 << 20))
    with pytest.raises(UnreadableFile, match="to 8 MB, at most 1"):
        read_arrays(path, limit=1 << 20)
    assert read_arrays(path)["zeros"].shape == (1 << 20,)


def test_an_archive_unpacks_to_at_most_a_hundred_times_its_size(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("values.npy", _head("(10000000,)") + bytes(80_000_000))
    with pytest.raises(UnreadableFile, match=r"unpacks from .* bytes to 80 MB, at most 67"):
        read_arrays(path)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_methods_that_unpack_without_a_limit_are_refused(method: int, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("values.npy", _head("(1000,)") + bytes(8000))
    with pytest.raises(UnreadableFile, match="expected deflate"):
        read_arrays(path)


def test_arrays_are_read_as_numpy_reads_them(tmp_path: Path) -> None:
    values = {
        "a": np.arange(6, dtype=">i4").reshape(2, 3),
        "b": np.asfortranarray(np.random.default_rng(0).normal(size=(3, 2))),
        "text": np.array(["x", "yz"]),
        "none": np.zeros((0, 3), np.float32),
        "one": np.float64(2.5),
    }
    np.savez(tmp_path / "a.npz", **values)
    arrays = read_arrays(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as expected:
        assert list(arrays) == expected.files
        for name in expected.files:
            assert arrays[name].dtype == expected[name].dtype
            np.testing.assert_array_equal(arrays[name], expected[name])
    assert list(read_arrays(tmp_path / "a.npz", ["b"])) == ["b"]


class _Command:
    def __reduce__(self) -> tuple:
        return os.system, ("true",)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (pickle.dumps([_Command()]), "asks for posix.system"),
        (pickle.dumps(np.arange(9.0))[:-20], "not a pickle of numpy arrays"),
        (b"text", "not a pickle of numpy arrays"),
        (
            b"\x80\x02c_codecs\nencode\nX\x01\x00\x00\x00bX\x06\x00\x00\x00latin0\x86R.",
            "unknown encoding",
        ),
    ],
)
def test_pickles_of_other_objects_are_refused(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(content)
    with pytest.raises(UnreadableFile, match=words) as caught:
        read_pickle(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_pickles_of_arrays_and_plain_values_are_read(protocol: int, tmp_path: Path) -> None:
    values = {
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "big": np.arange(3, dtype=">u2"),
        "text": np.array(["a", "bc"]),
        "objects": np.array([[1, 2], None, "x"], object),
        "empty": np.zeros((0, 3)),
    }
    inner = {"inner": [(np.int32(7), np.ones(2, np.float32))], "set": {3}, "bytes": b"\xff\0"}
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(values | inner, protocol=protocol))
    content = read_pickle(path)
    for name, value in values.items():
        native = content[name].dtype.newbyteorder("=")  # numpy turns some around, by protocol
        assert native == value.dtype.newbyteorder("=")
        np.testing.assert_array_equal(content[name], value)
    assert content["set"] == {3} and content["bytes"] == b"\xff\0"
    assert content["inner"][0][0] == 7 and content["inner"][0][1].tolist() == [1, 1]


@pytest.mark.parametrize(
    "value",
    [10**5000, "x" * 10_000, [[0] * 1000] * 1000, {"k" * 900: 1}, "\udcff", float("nan")],
    ids=["number", "text", "lists", "key", "surrogate", "nan"],
)
def test_quoted_values_are_short_and_printable(value: object) -> None:
    text = quoted(value)
    assert 0 < len(text) <= 240 and text.encode() and "\n" not in text


def test_nested_values_are_quoted_to_a_limited_depth() -> None:
    deep: list[object] = []
    for _ in range(100_000):
        deep = [deep]
    assert len(quoted(deep)) < 100
