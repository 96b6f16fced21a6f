"""Body files of the right arrays whose numbers make no person."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from intercap_core.body.model import BodyModel, check_body
from intercap_core.errors import UserError

from .conftest import open_arrays, save_body

WRONG: dict[str, tuple[Callable[[dict], dict], str]] = {
    "wide": (lambda a: {"v_template": a["v_template"] * [4, 1, 1]}, "m wide"),
    "no skin": (lambda a: {"f": np.zeros_like(a["f"])}, "0 m2 of skin"),
    "joints elsewhere": (
        lambda a: {"J_regressor": a["J_regressor"] * 1.5},
        "a joint .* outside of its skin",
    ),
    "joints in one place": (
        lambda a: {"J_regressor": np.full_like(a["J_regressor"], 1 / len(a["v_template"]))},
        "joints over 0% of its skin's",
    ),
    "negative weights": (lambda a: {"weights": a["weights"] - 0.01}, "skinning weight of -0"),
    "one shape": (lambda a: {"shapedirs": a["shapedirs"] * 0}, "shapedirs"),
    "shapes in millimetres": (
        lambda a: {"shapedirs": a["shapedirs"].astype(np.float32) * 1000},
        "move the skin by up to",
    ),
    "hand without components": (lambda a: {"hands_componentsl": np.zeros((45, 45))}, "length 0"),
    "stiff hand": (lambda a: {"hands_deviationr": np.zeros(45)}, "never varies"),
    "landmarks": (lambda a: {"lmk_bary_coords": a["lmk_bary_coords"] * 3}, "lmk_bary_coords"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_makes_no_person_is_named(name: str, tmp_path: Path) -> None:
    change, words = WRONG[name]
    arrays = {k: v for k, v in open_arrays().items() if k != "posedirs"}
    path = save_body(tmp_path / "SMPLX_MALE.npz", arrays | change(arrays))
    with pytest.raises(UserError, match=words) as caught:
        check_body(BodyModel.load(path))
    assert str(path) in str(caught.value)


def test_persons_pass(body: BodyModel, full_file: Path) -> None:
    check_body(body)
    check_body(BodyModel.load(full_file))
