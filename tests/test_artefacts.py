"""Artefacts: what is written comes back, what is broken is refused in one sentence."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from intercap_core import artefacts, schemas
from intercap_core.artefact_schema import Field, Schema
from intercap_core.artefacts import Unreadable, pack_ragged, unpack_ragged

SCHEMA = Schema(
    name="trial",
    version=3,
    stage="trial_stage",
    attributes={"sequence": "name"},
    fields={
        "points": Field(("T", "K", "3"), "float64", "points", "m", "master"),
        "good": Field(("T",), "bool", "flags"),
        "names": Field(("K",), "str", "names"),
        "extra": Field(("T",), "float32", "optional", optional=True),
        "cameras/{camera}/depth": Field(("D", "H", "W"), "uint16", "depth", "mm", codec="depth"),
        "cameras/{camera}/count": Field(("T",), "int32", "per camera"),
    },
)


def write_trial(path: Path, frames: int = 4, seed: int = 0, **changes: object) -> None:
    random = np.random.default_rng(seed)
    with artefacts.write(path, SCHEMA, settings_digest="abc", sequence="s1") as writer:
        values = {
            "points": random.normal(size=(frames, 2, 3)),
            "good": random.random(frames) > 0.5,
            "names": ["left", "röhts"],
            "cameras/k1/depth": random.integers(0, 5000, (3, 6, 8), dtype=np.uint16),
            "cameras/k2/depth": random.integers(0, 5000, (2, 4, 5), dtype=np.uint16),
            "cameras/k1/count": np.arange(frames),
            **changes,
        }
        for key, value in values.items():
            if value is not None:
                writer.put(key, value)


def test_written_datasets_are_read_back(tmp_path: Path) -> None:
    path = tmp_path / "trial.h5"
    write_trial(path)
    with artefacts.read(path, SCHEMA) as source:
        random = np.random.default_rng(0)
        np.testing.assert_array_equal(source["points"], random.normal(size=(4, 2, 3)))
        assert source.text("names") == ["left", "röhts"]
        assert source["cameras/k2/depth"].shape == (2, 4, 5)
        assert source.rows("cameras/k1/depth", 1).shape == (6, 8)
        assert source.attributes["sequence"] == "s1"
        assert source.attributes["settings_digest"] == "abc"
        assert source.attributes["complete"]
        assert "extra" not in source


def test_same_input_gives_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_trial(tmp_path / name / "trial.h5")
    write_trial(tmp_path / "c.h5", seed=1)
    first = (tmp_path / "a" / "trial.h5").read_bytes()
    assert first == (tmp_path / "b" / "trial.h5").read_bytes()
    assert first != (tmp_path / "c.h5").read_bytes()


def test_every_dataset_has_checksum_and_units(tmp_path: Path) -> None:
    path = tmp_path / "trial.h5"
    write_trial(path)
    with h5py.File(path) as file:
        found = []
        file.visititems(lambda name, item: found.append(item) if hasattr(item, "dtype") else None)
        assert len(found) == 6
        assert all(dataset.fletcher32 for dataset in found)
        assert all(dataset.attrs["units"] for dataset in found)
        assert file["points"].attrs["frame"] == b"master"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"points": np.zeros((4, 2))}, "has shape (4, 2), expected ('T', "),
        ({"points": np.zeros((4, 2, 4))}, "has 4 entries along 3"),
        ({"good": np.zeros(5, bool)}, "has 5 entries along T, expected 4"),
        ({"cameras/k1/count": np.arange(5)}, "has 5 entries along T"),
        ({"cameras/k1/count": np.zeros(4)}, "float values for an integer"),
        ({"names": None}, "missing ['names']"),
    ],
)
def test_data_that_contradicts_the_schema_is_refused(
    tmp_path: Path, changes: dict, says: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(says)):
        write_trial(tmp_path / "trial.h5", **changes)
    assert list(tmp_path.iterdir()) == []


def test_unknown_dataset_and_missing_attribute_are_refused(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="declares no dataset"):
        write_trial(tmp_path / "trial.h5", wrong=np.zeros(1))
    with (
        pytest.raises(ValueError, match="attributes off"),
        artefacts.write(tmp_path / "trial.h5", SCHEMA) as writer,
    ):
        writer.put("names", ["a"])


def test_an_error_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "trial.h5"
    write_trial(path)
    before = path.read_bytes()
    with (
        pytest.raises(RuntimeError),
        artefacts.write(path, SCHEMA, sequence="s1") as writer,
    ):
        writer.put("good", [True])
        raise RuntimeError("killed")
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["trial.h5"]


def break_payload(path: Path) -> None:
    """Flip a byte inside the points' chunk."""
    with h5py.File(path) as file:
        offset = file["points"].id.get_chunk_info(0).byte_offset
    data = bytearray(path.read_bytes())
    data[offset + 5] ^= 0xFF
    path.write_bytes(bytes(data))


def edit(change):
    def apply(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file)

    return apply


def put_instead(file: h5py.File, key: str, *, group: bool) -> None:
    """A group, or a dataset without a shape."""
    del file[key]
    if group:
        file.create_group(key)
    else:
        file[key] = h5py.Empty("bool")


def declare_rows(key: str, *shape: int) -> Callable[[Path], None]:
    """Replace a dataset by a larger one, whose values are all the fill value."""

    def apply(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            before = file[key]
            kind, chunk = before.dtype, before.chunks
            del file[key]
            file.create_dataset(key, shape, kind, chunks=chunk)

    return apply


def replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda path: path.unlink(), "there is no such file"),
        (lambda path: path.write_bytes(path.read_bytes()[:900]), "damaged or half-written"),
        (lambda path: path.write_bytes(b""), "damaged or half-written"),
        (break_payload, "its checksum does not match"),
        (edit(lambda file: file.attrs.__delitem__("complete")), "never finished"),
        (edit(lambda file: file.attrs.__setitem__("schema", "joint")), "holds schema 'joint'"),
        (edit(lambda file: file.attrs.__setitem__("schema_version", 2)), "version 2"),
        (edit(lambda file: file.attrs.__delitem__("sequence")), "attribute 'sequence' is missing"),
        (edit(lambda file: file.__delitem__("names")), "dataset 'names' is missing"),
        (replace_by_folder, "is a folder"),
        (edit(lambda file: file.attrs.__setitem__("schema_version", "abc")), "'abc', expected a"),
        (edit(lambda file: file.attrs.__setitem__("schema_version", [3, 3])), "a whole number"),
        (edit(lambda file: file.attrs.__setitem__("schema", [1.0, 2.0])), "holds schema"),
        (edit(lambda file: file.attrs.__setitem__("complete", "no")), "never finished"),
        (declare_rows("extra", 1 << 40), "dataset 'extra' has shape (1099511627776,), but too few"),
        (declare_rows("cameras/k1/depth", 1 << 40, 6, 8), "(1099511627776, 6, 8), but too few"),
        (edit(lambda file: put_instead(file, "good", group=True)), "'good' holds no values"),
        (edit(lambda file: put_instead(file, "good", group=False)), "'good' holds no values"),
    ],
)
def test_broken_artefact_is_one_error_line(tmp_path: Path, damage, says: str) -> None:
    path = tmp_path / "trial.h5"
    write_trial(path, extra=np.zeros(4, np.float32))
    damage(path)
    with pytest.raises(Unreadable) as raised, artefacts.read(path, SCHEMA) as source:
        for key in source.keys():  # noqa: SIM118 (an Artefact is not a mapping)
            source[key]
    message = str(raised.value)
    assert says in message
    assert str(path) in message
    assert "re-run stage 'trial_stage'" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (replace_by_folder, "is a folder"),
        (lambda path: path.unlink(), "there is no such file"),
        (lambda path: path.write_bytes(path.read_bytes()[:900]), "cut or damaged"),
        (lambda path: path.write_bytes(b""), "cut or damaged"),
        (edit(lambda file: file.attrs.__delitem__("schema")), "not an artefact"),
    ],
)
def test_file_with_unknown_schema_is_refused(tmp_path: Path, damage, says: str) -> None:
    path = tmp_path / "trial.h5"
    write_trial(path)
    damage(path)
    with pytest.raises(Unreadable, match=says) as raised:
        artefacts.schema_name(path)
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)


def test_rows_are_streamed(tmp_path: Path) -> None:
    path = tmp_path / "trial.h5"
    depth = np.random.default_rng(0).integers(0, 9, (5, 6, 8), dtype=np.uint16)
    with artefacts.write(path, SCHEMA, sequence="s1") as writer:
        writer.put("points", np.zeros((1, 1, 3)))
        writer.put("good", [True])
        writer.put("names", ["a"])
        stream = writer.stream("cameras/k1/depth", (6, 8))
        stream.append(depth[:2])
        stream.append(depth[2:])
        assert len(stream) == 5
    with artefacts.read(path, SCHEMA) as source:
        np.testing.assert_array_equal(source["cameras/k1/depth"], depth)
        assert "cameras/k1" not in source
        with pytest.raises(Unreadable, match="dataset 'cameras/k1' is missing"):
            source["cameras/k1"]


def test_a_damaged_optional_dataset_is_not_an_absent_one(tmp_path: Path) -> None:
    path = tmp_path / "trial.h5"
    with artefacts.write(path, SCHEMA, sequence="s1") as writer:
        writer.put("points", np.zeros((1, 1, 3)))
        writer.put("good", [True])
        writer.put("names", ["a"])
        writer.put("cameras/k1/depth", np.zeros((2, 6, 8), np.uint16))
    with h5py.File(path) as file:
        header = h5py.h5o.get_info(file["cameras/k1/depth"].id).addr
    content = bytearray(path.read_bytes())
    content[header : header + 16] = b"\xff" * 16
    path.write_bytes(content)
    with (
        pytest.raises(Unreadable, match="depth' is dam"),
        artefacts.read(path, SCHEMA) as source,
    ):
        assert "cameras/k1/depth" in source


@settings(max_examples=25, deadline=None)
@given(st.lists(st.binary(max_size=40), max_size=12))
def test_ragged_bytes_round_trip(items: list[bytes]) -> None:
    assert unpack_ragged(*pack_ragged(items)) == items


@settings(max_examples=25, deadline=None)
@given(hnp.arrays(np.float64, hnp.array_shapes(min_dims=1, max_dims=1, max_side=20)))
def test_float_bits_survive(tmp_path_factory: pytest.TempPathFactory, values: np.ndarray) -> None:
    schema = Schema("bits", 1, "bits", {"x": Field(("N",), "float64", "x")})
    path = tmp_path_factory.mktemp("bits") / "x.h5"
    with artefacts.write(path, schema) as writer:
        writer.put("x", values)
    with artefacts.read(path, schema) as source:
        assert source["x"].tobytes() == values.tobytes()


def test_every_declared_schema_is_sound() -> None:
    found = [value for value in vars(schemas).values() if isinstance(value, Schema)]
    assert len({schema.name for schema in found}) == len(found) >= 9
    for schema in found:
        for key, declared in schema.fields.items():
            assert schema.field_of(key.replace("{camera}", "k1")) is declared
            assert declared.doc
            assert declared.dtype == "str" or np.dtype(declared.dtype)
