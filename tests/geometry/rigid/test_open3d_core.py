"""Open3D's core alone: that it is alone, and that the package can follow."""

import subprocess
import sys


def _run(code: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.strip()


def test_stages_do_not_import_what_open3d_brings_along():
    heavy = "{'sklearn', 'pandas', 'dash', 'matplotlib', 'torch', 'open3d'}"
    code = "import sys, intercap_core.stages.object_track, intercap_core.geometry.rigid.distance;"
    assert _run(f"{code} print(sorted({heavy} & set(sys.modules)))") == "[]"


def test_the_package_follows_the_core_and_the_core_the_package():
    after = (
        "from intercap_core.geometry.rigid.distance import o3d as ours; import open3d;"
        "print(ours.core.Tensor is open3d.core.Tensor,"
        " open3d.t.geometry.RaycastingScene is ours.t.geometry.RaycastingScene)"
    )
    assert _run(after) == "True True"
    before = (
        "import open3d; from intercap_core.geometry.rigid.distance import o3d as ours;"
        "print(ours.core.Tensor is open3d.core.Tensor)"
    )
    assert _run(before) == "True"
