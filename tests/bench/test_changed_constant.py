"""Constants of a package are found, changed before other modules import them, and scaled."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.changed_constant import find_constants, import_changed, scaled
from intercap_core.errors import UserError


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of two modules, one of which derives values from the other's constants."""
    root = tmp_path / "intercap_core"
    (root / "room/inner").mkdir(parents=True)
    for folder in (root, root / "room"):
        (folder / "__init__.py").touch()
    (root / "room/places.py").write_text(
        "NEAR_M = 0.25\nFAR_M: float = 4 * NEAR_M\nLOW, HIGH = 1.0, 3.0\nWORD = 'a'\n"
        "LIMBS_M = {'arm': 0.6}\nsmall = 3\nOTHER = NEAR_M\n"
    )
    (root / "room/users.py").write_text(
        "from intercap_core.room.places import FAR_M, HIGH\n_OWN = 5\n"
        "def reach(far=FAR_M): return far\n"
    )
    (root / "room/inner/deep.py").write_text("_OWN = 6\n")
    return root


@pytest.mark.parametrize(
    ("selector", "expected"),
    [
        ("room.places", ["NEAR_M", "FAR_M", "LOW", "HIGH", "LIMBS_M"]),
        ("room.HIGH", ["HIGH"]),
        ("intercap_core.room.users:OWN", ["_OWN"]),
        ("room.OWN", ["_OWN", "_OWN"]),
    ],
)
def test_constants_are_found_by_package_module_and_name(
    package: Path, selector: str, expected: list[str]
) -> None:
    found = find_constants(selector, root=package)
    assert [constant.name for constant in found] == expected
    assert find_constants(found[0].label, root=package) == found[:1]


def test_unknown_constants_and_modules_are_refused(package: Path) -> None:
    with pytest.raises(UserError, match="similar names are NEAR_M"):
        find_constants("room.places:NEAR", root=package)
    with pytest.raises(UserError, match="no module 'attic'"):
        find_constants("attic.NEAR_M", root=package)


@pytest.mark.parametrize(
    ("name", "expected"), [("NEAR_M", "(0.25, 0.5) 2.0 3.0"), ("HIGH", "(3.0, 6.0) 1.0 6.0")]
)
def test_derived_values_use_the_changed_constant(package: Path, name: str, expected: str) -> None:
    root = Path(__file__).resolve().parents[2]
    code = (
        f"import sys; sys.path.insert(0, {str(root)!r})\n"
        "from bench.changed_constant import Constant, import_changed, scaled\n"
        f"import intercap_core; intercap_core.__path__.insert(0, {str(package)!r})\n"
        f"constant = Constant('intercap_core.room.places', {name!r})\n"
        "values = import_changed(constant, lambda v: scaled(constant.name, v, 2.0))\n"
        "from intercap_core.room.users import HIGH, reach\n"
        "print(values, reach(), HIGH)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == expected, done.stderr


def test_an_imported_module_cannot_be_changed() -> None:
    import intercap_core.evaluation.contact

    assert intercap_core.evaluation.contact
    (constant,) = find_constants("evaluation.contact:CONTACT_M")
    with pytest.raises(UserError, match="new process"):
        import_changed(constant, lambda value: value)


@pytest.mark.parametrize(
    ("name", "value", "factor", "expected"),
    [
        ("COUNT", 5, 0.5, 2),
        ("COUNT", 1, 0.5, 1),
        ("SHARE", 0.8, 2.0, 1.0),
        ("PRICE", 1.0, 2.0, 2.0),
        ("NEAR_M", 0.8, 2.0, 1.6),
        ("BOTH", (0.1, 3), 2.0, (0.2, 6)),
        ("LIMBS_M", {"arm": 0.1}, 2.0, {"arm": 0.2}),
    ],
)
def test_scaling_keeps_integers_and_shares(name, value, factor, expected) -> None:
    found = scaled(name, value, factor)
    assert type(found) is type(expected)
    assert found == (expected if isinstance(expected, dict | tuple) else pytest.approx(expected))


def test_scaling_accepts_arrays_and_refuses_words() -> None:
    np.testing.assert_allclose(scaled("X_M", np.array([1.0, 2.0]), 0.5), [0.5, 1.0])
    for value in (True, "words", None):
        with pytest.raises(UserError, match="not a number"):
            scaled("X", value, 2.0)
