"""The page on rooms and layers says what the code does."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from intercap_core.commands import architecture
from intercap_core.stage_list import STAGES

ROOT = Path(__file__).resolve().parents[2]


def contract() -> list[set[str]]:
    """Layers of the import contract, top first."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = next(c["layers"] for c in settings["contracts"] if c["type"] == "layers")
    return [{name.strip() for name in layer.split("|")} for layer in layers]


def test_the_layers_are_those_of_the_import_contract() -> None:
    assert [set(layer) for layer in architecture.LAYERS] == contract()


def test_every_room_has_its_place_and_every_stage_its_rooms() -> None:
    listed = {room for layer in architecture.LAYERS for room in layer}
    rooms = set(architecture.room_imports())
    assert rooms <= listed
    for stage in STAGES:
        assert set(architecture.rooms_of(stage)) <= rooms


def test_arrows_between_shared_rooms_are_imports() -> None:
    imports = architecture.room_imports()
    drawn = re.findall(r"^    (\w+) -\.-> (\w+)$", architecture.page(), re.MULTILINE)
    assert drawn
    for room, other in drawn:
        rooms = [room] if room in architecture.SHARED else architecture.rooms_of(room)
        assert any(other in imports[name] for name in rooms)


def test_an_edge_that_a_longer_way_implies_is_left_out() -> None:
    found = architecture.reduced({"a": {"b", "c", "d"}, "b": {"c"}, "c": set(), "d": set()})
    assert found == {"a": {"b", "d"}, "b": {"c"}, "c": set(), "d": set()}


def test_links_of_the_page_lead_to_files_of_the_docs() -> None:
    for name in re.findall(r"\]\((\w+\.md)\)", architecture.page()):
        assert name == "equations.md" or (ROOT / "docs" / name).is_file(), name
