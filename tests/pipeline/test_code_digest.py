"""Code digests: an edit anywhere that a stage reaches changes its digest, nothing else does."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from intercap_core.pipeline.code_digest import ROOT, code_digest, modules_reached
from intercap_core.stage_list import SEQUENCE_STAGES

FITS = SEQUENCE_STAGES[: SEQUENCE_STAGES.index("metrics")]
FILES = {
    "__init__.py": "",
    "config.py": "from pydantic import BaseModel\nclass A(BaseModel):\n    x: int = 1\n"
    "class B(BaseModel):\n    a: A\nclass C(BaseModel):\n    y: int = 1\n",
    "schemas.py": "_SHARED = 1\nONE = {'a': _SHARED}\nTWO = 2\n",
    "project.py": "from intercap_core.config import C\ndef digest(x):\n    return x\n"
    "def load():\n    return C\n",
    "energy/__init__.py": "",
    "energy/contact.py": "WEIGHT = 1\n",
    "energy/ground.py": "WEIGHT = 2\n",
    "solve/__init__.py": "from intercap_core.solve import banded\n",
    "solve/banded.py": "import numpy as np\n",
    "body/__init__.py": "",
    "body/model.py": "from intercap_core.body import maps\n",
    "body/maps.py": "",
    "body/data/body.npz": "data",
    "stages/__init__.py": "",
    "stages/joint.py": (
        '"""Doc."""\nfrom intercap_core.config import B\nfrom intercap_core.schemas import ONE\n'
        "from intercap_core.project import digest\n"
        "def run():\n    from intercap_core.energy import contact\n"
        "    import intercap_core.body.model\n    return contact, digest\n"
    ),
    "stages/scene.py": "from intercap_core.energy.ground import WEIGHT\n"
    "from intercap_core import solve\n",
}


@pytest.fixture
def package(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        path = tmp_path / "intercap_core" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "intercap_core"


def reached(package: Path, stage: str) -> set[str]:
    return {
        name.removeprefix("intercap_core").lstrip(".")
        for name in modules_reached(stage, root=package)
    }


def test_imports_are_walked(package: Path) -> None:
    assert reached(package, "stages.joint") == {
        *("", "config", "schemas", "project", "energy", "energy.contact"),
        *("body", "body.model", "body.maps"),
        *("stages", "stages.joint"),
    }
    assert reached(package, "stages.scene") == {
        *("", "energy", "energy.ground", "solve", "solve.banded", "stages", "stages.scene"),
    }


def test_discovered_modules_are_reached(package: Path) -> None:
    (package / "stages/scene.py").write_text(
        "from intercap_core.plugins import modules_of\nFOUND = modules_of('intercap_core.energy')\n"
    )
    before = code_digest("stages.scene", root=package)
    assert {"energy.contact", "energy.ground"} <= reached(package, "stages.scene")
    (package / "energy/new.py").write_text("WEIGHT = 3\n")
    os.utime(package / "stages/scene.py", ns=(1, 1))  # its imports are cached by its date
    assert code_digest("stages.scene", root=package) != before


@pytest.mark.parametrize(
    ("name", "text", "changes"),
    [
        # An import inside a function counts
        ("energy/contact.py", "WEIGHT = 3\n", {"joint"}),
        ("energy/ground.py", "WEIGHT = 3\n", {"scene"}),
        ("solve/banded.py", "import numpy as np\nx = 1\n", {"scene"}),
        ("body/maps.py", "x = 1\n", {"joint"}),
        ("body/data/body.npz", "other", {"joint"}),
        # Comments, docstrings and layout do not count
        ("energy/contact.py", '"""Doc."""\n\nWEIGHT = 1  # why\n', set()),
        ("stages/joint.py", FILES["stages/joint.py"].replace("Doc", "Other"), set()),
        # Declarations count by name, with the names that they use
        ("config.py", FILES["config.py"].replace("x: int = 1", "x: int = 2"), {"joint"}),
        ("config.py", FILES["config.py"].replace("y: int = 1", "y: int = 2"), set()),
        ("schemas.py", FILES["schemas.py"].replace("_SHARED = 1", "_SHARED = 5"), {"joint"}),
        ("schemas.py", FILES["schemas.py"].replace("TWO = 2", "TWO = 3"), set()),
        ("project.py", FILES["project.py"].replace("return C", "return None"), set()),
    ],
)
def test_an_edit_changes_the_stages_that_reach_it(
    package: Path, name: str, text: str, changes: set[str]
) -> None:
    stages = ("joint", "scene")
    before = {stage: code_digest(f"stages.{stage}", root=package) for stage in stages}
    (package / name).write_text(text)
    after = {stage: code_digest(f"stages.{stage}", root=package) for stage in stages}
    assert {stage for stage in stages if before[stage] != after[stage]} == changes


def test_an_unknown_module_is_refused(package: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"stages\.nothing"):
        code_digest("stages.nothing", root=package)


def test_only_the_metrics_reach_the_truth() -> None:
    """No stage before the metrics may know the studio, its truth or its noise."""
    for stage in FITS:
        modules = modules_reached(f"stages.{stage}")
        assert not [name for name in modules if ".studio" in name or ".evaluation" in name], stage
        assert "TRUTH" not in modules.get("intercap_core.schemas", ())
    assert "TRUTH" in modules_reached("stages.metrics")["intercap_core.schemas"]
    assert not [name for name in modules_reached("stages.metrics") if ".studio" in name]


@pytest.mark.parametrize(
    ("module", "stages"),
    [
        ("joint.terms.ground", {"joint"}),
        ("object_track.smooth", {"object_track"}),
        ("body_fit.problem", {"body_fit", "joint"}),
    ],
)
def test_a_term_is_reached_by_its_own_stages(module: str, stages: set[str]) -> None:
    name = f"intercap_core.{module}"
    reaching = {stage for stage in FITS if name in modules_reached(f"stages.{stage}")}
    assert reaching == stages


def test_core_does_not_import_snakemake() -> None:
    for module in ("stages.joint", "stages.metrics"):
        for name in modules_reached(module):
            path = ROOT / Path(*name.split(".")[1:])
            path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
            assert "import snakemake" not in path.read_text(encoding="utf-8")


def test_code_digest_is_independent_of_the_folder(package: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere" / "intercap_core"
    shutil.copytree(package, moved)
    assert code_digest("stages.joint", root=package) == code_digest("stages.joint", root=moved)
