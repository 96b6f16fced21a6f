"""A constant is found by name, changed before anything takes it, and scaled within its kind."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.changed_constant import Constant, find_constant, in_kernels, scaled
from intercap_core.errors import UserError


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package with one room: its constants, a file that uses them, and one with a kernel."""
    root = tmp_path / "intercap_core"
    (root / "room").mkdir(parents=True)
    for folder in (root, root / "room"):
        (folder / "__init__.py").touch()
    (root / "room/constants.py").write_text(
        "NEAR_M = 0.25\nFAR_M: float = 4 * NEAR_M\nLOW, HIGH = 1.0, 3.0\nCOUNT = 3\n"
    )
    (root / "room/places.py").write_text(
        "from intercap_core.room.constants import COUNT, FAR_M\n_OWN = 5\nCOUNT_MAX = COUNT\n"
        "def reach(far=FAR_M): return far\n"
    )
    (root / "room/kernel.py").write_text(
        "import numba\nfrom intercap_core.room.constants import FAR_M\n_OWN = 6\n"
    )
    return root


def test_a_room_s_constant_is_found_by_its_short_name(package: Path) -> None:
    found = find_constant("room.NEAR_M", root=package)
    assert found == Constant("intercap_core.room.constants", "NEAR_M", "0.25")
    assert found.label == "room.NEAR_M"
    assert find_constant("room.HIGH", root=package).expression == "3.0"


@pytest.mark.parametrize(
    "name", ["room.places:OWN", "room.places:_OWN", "intercap_core.room.places:OWN"]
)
def test_another_file_s_constant_is_found_by_its_file(package: Path, name: str) -> None:
    assert find_constant(name, root=package).label == "room.places:_OWN"


def test_an_unknown_name_suggests_others(package: Path) -> None:
    with pytest.raises(UserError, match="like it are NEAR_M"):
        find_constant("room.NEAR", root=package)
    with pytest.raises(UserError, match="no room 'attic'"):
        find_constant("attic.NEAR_M", root=package)


def test_a_name_that_several_files_have_is_refused(package: Path) -> None:
    with pytest.raises(UserError, match=r"room\.kernel:_OWN or room\.places:_OWN"):
        find_constant("room.OWN", root=package)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("room.NEAR_M", "(0.25, 0.5) 2.0 3.0 3"),
        ("room.HIGH", "(3.0, 6.0) 1.0 6.0 3"),
        ("room.COUNT", "(3, 6) 1.0 3.0 6"),
    ],
)
def test_what_derives_from_it_follows(package: Path, name: str, expected: str) -> None:
    """Default arguments, other constants and names bound in other files."""
    root = Path(__file__).resolve().parents[2]
    code = (
        f"import sys; sys.path.insert(0, {str(root)!r})\n"
        "import importlib.util as u, intercap_core.errors\n"
        "from bench.changed_constant import find_constant, import_changed, scaled\n"
        "from pathlib import Path\n"
        f"import intercap_core; intercap_core.__path__.insert(0, {str(package)!r})\n"
        f"c = find_constant({name!r}, root=Path({str(package)!r}))\n"
        "told = import_changed(c, lambda v: scaled(c.name, v, 2.0))\n"
        "from intercap_core.room.places import reach, COUNT_MAX\n"
        "from intercap_core.room import constants\n"
        "print(told, reach(), constants.HIGH, COUNT_MAX)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == expected, done.stderr


def test_a_constant_that_is_imported_already_is_refused() -> None:
    from bench.changed_constant import import_changed
    from intercap_core.evaluation import contact

    assert contact.CONTACT_M == 0.0045
    with pytest.raises(UserError, match="fresh process"):
        import_changed(find_constant("evaluation.contact:CONTACT_M"), lambda value: value)


def test_kernels_that_take_it_are_noticed(package: Path) -> None:
    assert in_kernels(find_constant("room.NEAR_M", root=package), root=package)
    assert not in_kernels(find_constant("room.COUNT", root=package), root=package)
    assert in_kernels(find_constant("room.kernel:OWN", root=package), root=package)


@pytest.mark.parametrize(
    ("name", "value", "factor", "around", "expected"),
    [
        ("COUNT", 5, 0.5, 0.0, 2),
        ("COUNT", 1, 0.5, 0.0, 1),
        ("SHARE", 0.8, 2.0, 0.0, 1.0),
        ("PRICE", 1.0, 2.0, 0.0, 2.0),
        ("NEAR_M", 0.8, 2.0, 0.0, 1.6),
        ("BETTER", 1.15, 2.0, 1.0, 1.3),
        ("BOTH", (0.1, 3), 2.0, 0.0, (0.2, 6)),
        ("LIMBS_M", {"arm": 0.1}, 2.0, 0.0, {"arm": 0.2}),
    ],
)
def test_values_stay_of_their_kind(name, value, factor, around, expected) -> None:
    found = scaled(name, value, factor, around)
    assert type(found) is type(expected)
    assert found == (expected if isinstance(expected, dict | tuple) else pytest.approx(expected))


def test_arrays_are_scaled_and_words_refused() -> None:
    np.testing.assert_allclose(scaled("X_M", np.array([1.0, 2.0]), 0.5), [0.5, 1.0])
    for value in (True, "words", None):
        with pytest.raises(UserError, match="no number"):
            scaled("X", value, 2.0)
