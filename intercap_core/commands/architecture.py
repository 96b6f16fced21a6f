"""docs/architecture.md: rooms, stages and layers, drawn from the code.

Arrows between stages are what ``stage_list`` says they read; arrows between rooms are imports, as
they stand in the files. Where one is implied by others it is left out.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from intercap_core.stage_list import STAGES

PACKAGE = "intercap_core"
ROOT = Path(__file__).resolve().parents[1]
TEMPLATE = Path(__file__).parent / "data" / "architecture.md"
# What each room holds, by layer: a room knows only what lies below it. The same layers are the
# import contract in pyproject.toml; a test holds the two together.
LAYERS: tuple[Mapping[str, str], ...] = (
    {"cli": "the command line's options, nothing else"},
    {
        "evaluation": "figures against truth over many recordings: `intercap evaluate`",
        "annotate": "annotations mended in the browser: a server on the loopback and its page",
    },
    {
        "commands": "the command line's verbs: run, check, report, view, compare, release, bench "
        "and others"
    },
    {
        "tables": "a project's tables for released datasets",
        "pipeline": "runs one stage; decides, by digests of code and settings, what is run again",
        "posed": "results as vertices and joints, for users of the library",
    },
    {
        "stages": "one thin file a stage: read artefacts, call the room, write one artefact",
        "project": "settings, tables and annotations, loaded and checked together",
    },
    {"viewer": "a sequence in a browser: play, turn, compare; opens from disk"},
    {
        "report": "charts, pictures and the pages of the site",
        "export": "files for other tools: InterCap, AMASS, BOP, COCO, glb, meshes",
        "release": "what goes with a dataset that is given away: splits, card, list of files",
    },
    {
        "metrics": "distances, penetration, contact; errors against truth",
        "verdict": "a result judged without truth, by cameras held out; stated errors",
    },
    {
        "joint": "body and object together over all frames, with contact (equation 6)",
        "imports": "another program's results, in place of the joint fit",
    },
    {
        "body_fit": "SMPL-X parameters in every frame (equation 2)",
        "object_track": "the object's pose in every frame (equation 1)",
        "scene": "extrinsics, exposure times and slips, ground plane, background",
    },
    {
        "person": "the subject over views, left and right, keypoints in space",
        "segmentation": "person and object from the images alone",
    },
    {
        "detections": "keypoints and candidates, from files and models",
        "studio": "virtual recordings whose truth is known",
    },
    {"capture": "recordings to synchronised frame sets: k4a, releases, videos, images"},
    {"contact": "patches of the body, and which of them touch"},
    {"energy": "the terms of the energies, one file a term: residual and Jacobian"},
    {
        "body": "the SMPL-X format: skinning and its Jacobian, keypoints, priors",
        "rigid": "meshes, symmetry, distance fields, rendering, poses over time",
    },
    {"camera": "lenses, projection, triangulation, depth to points, masks"},
    {
        "config": "settings, as pydantic models",
        "solve": "Levenberg-Marquardt, banded systems, robust functions; knows no domain",
    },
    {"schemas": "what every artefact holds"},
    {"artefacts": "the one place that opens HDF5"},
    {"inputs": "files that a user supplies, read within bounds"},
)
# Stages that are not named as their room.
ROOM_OF = {"frames": "capture", "summary": "metrics", "page": "report"}
SHARED = ("contact", "energy", "body", "rigid", "camera", "solve")  # by several stages
Graph = dict[str, set[str]]


def page() -> str:
    """The page's text: the template's words around what is read from the code."""
    text = TEMPLATE.read_text(encoding="utf-8")
    parts = {"picture": picture(), "stages": stage_table(), "layers": layer_table()}
    for name, lines in parts.items():
        text = text.replace(f"{{{name}}}", "\n".join(lines))
    return text


def picture() -> list[str]:
    """A Mermaid diagram: stages in the order data flows, and the rooms that they share."""
    lines = ["```mermaid", "flowchart TB"]
    flow = reduced({name: set(stage.reads) for name, stage in STAGES.items()})
    for name in STAGES:
        rooms = " + ".join(rooms_of(name))
        lines.append(f'    {name}["<b>{name}</b><br/>{rooms}"]')
    lines += [f"    {source} ==> {name}" for name in STAGES for source in _ordered(flow[name])]
    lines.append('    subgraph shared ["shared by several stages"]')
    lines += [f"        {room}" for room in SHARED] + ["    end"]
    imports = room_imports()
    known: Graph = {room: imports[room] & set(SHARED) for room in SHARED}
    for name in STAGES:
        known[name] = set().union(*(imports[room] for room in rooms_of(name))) & set(SHARED)
    known = reduced(known)
    for name in (*STAGES, *SHARED):
        lines += [f"    {name} -.-> {room}" for room in SHARED if room in known[name]]
    return [*lines, "```"]


def stage_table() -> list[str]:
    """Stage, what it is for, what it reads, its artefact and its rooms."""
    lines = ["| stage | gives | reads | artefact | room |", "|---|---|---|---|---|"]
    for name, stage in STAGES.items():
        reads = ", ".join(stage.reads) or "the recordings"
        artefact = f"`{name}/`" if stage.writes_folder else f"`{name}.h5`"
        rooms = ", ".join(f"`{room}/`" for room in rooms_of(name))
        lines.append(f"| `{name}` | {stage.purpose.rstrip('.')} | {reads} | {artefact} | {rooms} |")
    return lines


def layer_table() -> list[str]:
    """Rooms from top to bottom, and what each holds."""
    lines = ["| room | holds |", "|---|---|"]
    for layer in LAYERS:
        lines += [f"| `{room}` | {purpose} |" for room, purpose in layer.items()]
    return lines


def rooms_of(stage: str) -> list[str]:
    """The room of a stage, and those beside it that no other stage imports."""
    own = ROOM_OF.get(stage, stage)
    users = {name: _imports(ROOT / "stages" / f"{name}.py") for name in STAGES}
    alone = {
        room
        for room in users[stage] - set(SHARED) - {ROOM_OF.get(name, name) for name in STAGES}
        if sum(room in found for found in users.values()) == 1 and (ROOT / room).is_dir()
    }
    return [own, *sorted(alone)]


@cache
def room_imports(root: Path = ROOT) -> Graph:
    """Rooms that the files of each room import, imports inside functions included."""
    rooms = sorted(path.parent.name for path in root.glob("*/__init__.py"))
    found: Graph = {room: set() for room in rooms}
    for room in rooms:
        for path in (root / room).rglob("*.py"):
            found[room] |= (_imports(path) & set(rooms)) - {room}
    return found


def _imports(path: Path) -> set[str]:
    """First parts below the package of what a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == PACKAGE:
            parts = (node.module or "").split(".")[1:]
            found |= {parts[0]} if parts else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {
                alias.name.split(".")[1]
                for alias in node.names
                if alias.name.startswith(f"{PACKAGE}.")
            }
    return found


def reduced(graph: Graph) -> Graph:
    """The graph without edges that longer ways imply (its transitive reduction)."""

    def reach(node: str) -> set[str]:
        return set().union(*({after} | reach(after) for after in graph.get(node, ())))

    return {
        node: {after for after in nexts if not any(after in reach(o) for o in nexts - {after})}
        for node, nexts in graph.items()
    }


def _ordered(stages: set[str]) -> list[str]:
    return [name for name in STAGES if name in stages]
