"""Compiled kernels: never older than what they call, kept between processes, removed later."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from intercap_core.kernel_cache import (
    DAY_S,
    KEPT_FOLDERS,
    UNUSED_DAYS,
    kernel_modules,
    remove_unused,
)
from intercap_core.pipeline.code_digest import ROOT, modules_reached

FILES = {
    "geometry/solve/__init__.py": "",
    "solve/constants.py": "OFFSET = 10.0\n",
    "solve/inner.py": (
        "import numba\n\n\n@numba.njit(cache=True)\ndef inner(x):\n    return x + 1.0\n"
    ),
    "solve/outer.py": (
        "import numba\n\nfrom intercap_core.solve.constants import OFFSET\n"
        "from intercap_core.solve.inner import inner\n\n\n@numba.njit(cache=True)\n"
        "def outer(x):\n    return inner(x) + OFFSET\n"
    ),
    "report.py": "TEXT = 1\n",
}
CALL = (
    "from intercap_core.solve.outer import outer\n"
    "value = outer(0.0)\n"
    "print(value, sum(outer.stats.cache_misses.values()), sum(outer.stats.cache_hits.values()))\n"
)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A small package of two kernels in two files, with this package's own cache."""
    folder = tmp_path / "intercap_core"
    for name, text in FILES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    for name in ("__init__.py", "kernel_cache.py"):
        shutil.copy(ROOT / name, folder / name)
    return folder


def python(package: Path, code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    return subprocess.run(
        [sys.executable, "-c", code],
        env={
            **kept,
            "PYTHONPATH": str(package.parent),
            "XDG_CACHE_HOME": str(package.parent / "cache"),
            # bytecode is checked by size and whole seconds, which these edits may not change
            "PYTHONDONTWRITEBYTECODE": "1",
            **variables,
        },
        cwd=package.parent,
        capture_output=True,
        text=True,
    )


def called(package: Path, **variables: str) -> tuple[float, int, int]:
    """What a new process computes, and how many kernels it compiled and found."""
    done = python(package, CALL, **variables)
    assert done.returncode == 0, done.stderr
    value, misses, hits = done.stdout.split()
    return float(value), int(misses), int(hits)


def folders(package: Path) -> list[str]:
    return sorted(path.name for path in (package.parent / "cache/intercap/kernels").iterdir())


def test_an_edit_in_another_file_recompiles_once(package: Path) -> None:
    assert called(package) == (11.0, 1, 0)
    inner, constants = package / "solve" / "inner.py", package / "solve" / "constants.py"
    inner.write_text(inner.read_text().replace("1.0", "2.0"))
    assert called(package) == (12.0, 1, 0)
    constants.write_text("OFFSET = 20.0\n")
    assert called(package) == (22.0, 1, 0)
    assert len(folders(package)) == 3
    constants.write_text("OFFSET = 10.0\n")
    inner.write_text(inner.read_text().replace("2.0", "1.0"))  # as before the edits
    (package / "report.py").write_text("TEXT = 2\n")  # no kernel reaches it
    assert called(package) == (11.0, 0, 1)


def test_numba_imported_first_and_a_folder_of_the_user(package: Path) -> None:
    own = package.parent / "own"
    done = python(package, "import numba\n" + CALL, NUMBA_CACHE_DIR=str(own))
    assert done.stdout.split() == ["11.0", "1", "0"], done.stderr
    (chosen,) = own.iterdir()
    assert chosen.name.startswith("intercap-")
    # A process that was started by one of this package chooses the same folder
    assert called(package, NUMBA_CACHE_DIR=str(chosen)) == (11.0, 0, 1)
    assert [path.name for path in own.iterdir()] == [chosen.name]
    assert not list(package.rglob("*.nb?"))


def test_without_a_writable_home_kernels_are_temporary(package: Path) -> None:
    blocked = package.parent / "blocked"
    blocked.write_text("a file, so no folder can be made here")
    temporary = package.parent / "temporary"
    temporary.mkdir()
    variables = {"XDG_CACHE_HOME": str(blocked), "TMPDIR": str(temporary)}
    done = python(package, "import intercap_core", **variables)
    assert done.returncode == 0
    assert "compiled kernels are cached in " + str(temporary) in done.stderr
    (base,) = temporary.iterdir()
    assert stat.S_IMODE(base.stat().st_mode) == 0o700
    assert called(package, **variables) == (11.0, 1, 0)
    assert list(base.rglob("*.nbc"))


def test_several_processes_at_once(package: Path) -> None:
    command = [sys.executable, "-c", CALL]
    cache = str(package.parent / "cache")
    env = {**os.environ, "PYTHONPATH": str(package.parent), "NUMBA_CACHE_DIR": cache}
    started = [
        subprocess.Popen(command, env=env, cwd=package.parent, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    assert [process.communicate()[0].split()[0] for process in started] == ["11.0"] * 2
    assert len(list(Path(cache).iterdir())) == 1


def test_old_folders_are_emptied_except_the_most_recent(tmp_path: Path) -> None:
    now_s, old_s = time.time(), (UNUSED_DAYS + 1) * DAY_S
    made = []
    for index in range(KEPT_FOLDERS + 3):
        folder = tmp_path / f"intercap-{index:016x}"
        (folder / "body").mkdir(parents=True)
        made.append(folder / "body" / "kernel.nbc")
        made[-1].write_text("compiled")
        used_s = now_s - old_s - index * DAY_S
        os.utime(made[-1], (used_s, used_s))
        os.utime(folder, (used_s, used_s))
    foreign = tmp_path / "numba" / "theirs.nbc"
    foreign.parent.mkdir()
    foreign.write_text("of somebody else")
    os.utime(foreign.parent, (0.0, 0.0))
    remove_unused(tmp_path, now_s=now_s)
    kept = [path.exists() for path in made]
    assert kept == [True] * KEPT_FOLDERS + [False] * 3
    assert all(path.parent.is_dir() for path in made)  # for a process that still runs
    assert foreign.exists()
    remove_unused(tmp_path, now_s=now_s + 400 * DAY_S)
    assert [path.parent.parent.exists() for path in made] == kept


def test_folders_in_use_stay(tmp_path: Path) -> None:
    for index in range(KEPT_FOLDERS + 3):
        path = tmp_path / f"intercap-{index:016x}" / "kernel.nbc"
        path.parent.mkdir()
        path.write_text("compiled")
    remove_unused(tmp_path, now_s=time.time() + (UNUSED_DAYS - 1) * DAY_S)
    assert len(list(tmp_path.glob("*/*.nbc"))) == KEPT_FOLDERS + 3


def test_a_new_folder_sends_the_old_ones_away(package: Path) -> None:
    base = package.parent / "cache/intercap/kernels"
    for index in range(KEPT_FOLDERS + 1):
        path = base / f"intercap-{index:016x}" / "kernel.nbc"
        path.parent.mkdir(parents=True)
        path.write_text("compiled")
        os.utime(path, (index, index))
        os.utime(path.parent, (index, index))
    assert python(package, "import intercap_core").returncode == 0
    assert sorted(path.parent.name[-1] for path in base.glob("*/kernel.nbc")) == ["2", "3", "4"]


def test_all_that_a_kernel_can_reach_counts() -> None:
    """What the text search finds holds all that a walk over the syntax trees finds."""
    found = kernel_modules()
    holders = {name for name, text in found.items() if b"import numba" in text}
    assert len(holders) > 20
    neutral = "intercap_core.kernel_cache"
    for name in holders:
        reached = modules_reached(name.removeprefix("intercap_core."))
        assert set(reached) <= set(found) | {neutral}


def test_an_edit_of_settings_or_stages_recompiles_nothing() -> None:
    assert not {"intercap_core.config", "intercap_core.stage_list"} & kernel_modules().keys()


def test_importing_the_package_is_light(package: Path) -> None:
    done = python(package, "import sys\nimport intercap_core\nprint(*sys.modules)")
    assert done.returncode == 0, done.stderr
    assert not {"numba", "llvmlite", "numpy", "importlib.metadata"} & set(done.stdout.split())
