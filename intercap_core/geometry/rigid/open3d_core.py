"""Open3D without its Python packages, which take most of the time of ``import open3d``."""

from __future__ import annotations

import os
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

_OPEN3D_CORE = "open3d.cpu.pybind"


def _load_open3d() -> Any:
    """Return the compiled core of a CPU build of Open3D; for other builds the whole package.

    ``import open3d`` takes 1.7 s, of which 1.3 s are for scikit-learn, pandas and dash, which are
    not used here. The core has the same ``core``, ``t``, ``geometry`` and ``utility``, and the
    whole package can still be imported afterwards.
    """
    if _OPEN3D_CORE in sys.modules:
        return sys.modules[_OPEN3D_CORE]
    package = find_spec("open3d")
    folders = list(package.submodule_search_locations or ()) if package else []
    files = [
        path
        for folder in folders
        for suffix in EXTENSION_SUFFIXES
        for path in Path(folder, "cpu").glob(f"pybind*{suffix}")
    ]
    gpu_build = any(Path(folder, "cuda").is_dir() for folder in folders)
    if not files or gpu_build or "open3d" in sys.modules:
        import open3d

        return open3d
    # the package sets these variables before it loads the same file
    os.environ["KMP_DUPLICATE_LIB_OK"] = "True"
    os.environ["TCM_ENABLE"] = "1"
    spec = spec_from_file_location(_OPEN3D_CORE, files[0])
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[_OPEN3D_CORE] = module
    spec.loader.exec_module(module)
    return module


o3d = _load_open3d()
