"""The example of a new joint term in docs/extending.md works in a copy of the package."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.helpers.extending import apply_chapter

ROOT = Path(__file__).resolve().parents[2]
CHANGED = ("intercap_core/config.py", "intercap_core/joint/problem.py")
# Modules that the chapter writes come from the copy. All others come from the project, whose
# compiled kernels are in the cache.
SCRIPT = """
import importlib.abc, importlib.util, sys
from pathlib import Path

copy, test = Path(sys.argv[1]), sys.argv[2]


class Copied(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        file = copy / (name.replace(".", "/") + ".py")
        return importlib.util.spec_from_file_location(name, file) if file.is_file() else None


sys.meta_path.insert(0, Copied())
import numpy as np, pytest
from intercap_core.joint.state import ALL
from intercap_core.joint.terms.steady_head import SteadyHead
from tests.helpers.bodies import open_body
from tests.joint.scenes import FRAMES, Scene, bodies
from tests.joint.test_terms import test_gradient_of_each_term_matches_differences as check

assert pytest.main(["-q", "-p", "no:cacheprovider", "--confcutdir", str(copy), test]) == 0
check(open_body(), SteadyHead)
shaken = np.random.default_rng(0).normal(scale=0.01, size=(FRAMES, ALL.stop))
state = bodies(open_body(), 0.5).moved(shaken)
fit = Scene(open_body(), state, hold=0.1, track=0.1).minimise(max_steps=3)
before, after = (e[SteadyHead.name].sum() for e in (fit.energies_before, fit.energies))
assert 0 < after < before
"""


def test_a_new_joint_term_takes_three_files_and_a_test(tmp_path):
    for name in CHANGED:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    files = apply_chapter("A new joint term", tmp_path)
    assert len([path for path in files if "tests" not in path.parts]) == 3 == len(files) - 1
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path), str(files[-1])],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout + run.stderr
