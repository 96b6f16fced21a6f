"""The ten objects of the catalogue, loaded once."""

from pathlib import Path

import pytest
import yaml

from intercap_core.entries import ObjectEntry
from intercap_core.geometry.rigid.mesh import ObjectMesh

CONFIG = Path(__file__).parents[3] / "config"


def catalogue() -> dict[str, ObjectEntry]:
    """Entries of config/objects.yaml with absolute paths."""
    entries = {}
    for name, values in yaml.safe_load((CONFIG / "objects.yaml").read_text()).items():
        entry = ObjectEntry.model_validate({"name": name, **values})
        assert entry.contact_vertices is not None
        entries[name] = entry.model_copy(
            update={
                "mesh": CONFIG / entry.mesh,
                "contact_vertices": CONFIG / entry.contact_vertices,
            }
        )
    return entries


@pytest.fixture(scope="session")
def objects() -> dict[str, ObjectMesh]:
    return {name: ObjectMesh.load(entry) for name, entry in catalogue().items()}
