"""Build the meshes of the ten objects: ``python tools/build_objects.py [--output config/objects]``.

Writes ``<NN>_<name>.ply`` (binary, metres, z up in the standing pose, origin at the centre of
mass, vertex colours) and ``<NN>_<name>.contact.json`` (likely-contact vertices), and with
``--picture`` a sheet that shows all of them from two sides, contact vertices highlighted.
Needs ``manifold3d`` (the ``bake`` extra).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import trimesh
from object_shapes import furniture, luggage, sports, vessels
from object_shapes.parts import Built

from intercap_core.geometry.rigid.contact_vertices import contact_list

BUILDERS: dict[str, Callable[[], Built]] = {
    "01_suitcase": luggage.suitcase,
    "02_skateboard": sports.skateboard,
    "03_football": sports.football,
    "04_umbrella": vessels.umbrella,
    "05_tennis_racquet": sports.tennis_racquet,
    "06_toolbox": luggage.toolbox,
    "07_chair": furniture.chair,
    "08_bottle": vessels.bottle,
    "09_cup": vessels.cup,
    "10_stool": furniture.stool,
}
ROOT = Path(__file__).resolve().parents[1]


def write(name: str, built: Built, folder: Path) -> None:
    """Write one object's mesh and its contact vertices."""
    mesh = trimesh.Trimesh(
        built.vertices, built.faces, vertex_colors=built.colours, process=False, validate=False
    )
    (folder / f"{name}.ply").write_bytes(
        mesh.export(file_type="ply", encoding="binary", vertex_normal=False)
    )
    contact = json.dumps(contact_list(built.contact_vertices, mesh.vertices))
    (folder / f"{name}.contact.json").write_text(contact + "\n")


def main() -> None:
    """Build all objects and, if asked, their picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=ROOT / "config" / "objects")
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    built = {name: build() for name, build in BUILDERS.items()}
    for name, solid in built.items():
        write(name, solid, arguments.output)
        size = solid.vertices.max(0) - solid.vertices.min(0)
        print(
            f"{name:18s} {len(solid.vertices):5d} vertices {len(solid.faces):5d} faces "
            f"{len(solid.contact_vertices):5d} contact, {size.round(3)} m"
        )
    if arguments.picture:
        from object_shapes.picture import draw_sheet

        draw_sheet(built, arguments.picture)


if __name__ == "__main__":
    main()
