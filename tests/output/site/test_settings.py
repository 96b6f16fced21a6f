"""Which settings the overview lists."""

from __future__ import annotations

from pathlib import Path

from intercap_core.config import BodyModels, Config, JointSettings, PageSettings
from intercap_core.output.site.settings import changed


def test_only_what_differs_from_the_defaults_is_listed() -> None:
    assert changed(Config(dataset="demo", results=Path("/elsewhere"))) == []
    found = changed(
        Config(
            dataset="demo",
            body_models=BodyModels(male=Path("/licensed/M.npz")),
            joint=JointSettings(contact_weight=2.5, lemo=Path("/licensed/LEMO")),
            page=PageSettings(frames=2),
        )
    )
    default = JointSettings().contact_weight
    assert ("joint.contact_weight", "2.5", str(default)) in found
    assert ("joint.lemo", "LEMO", "–") in found  # no folder of this machine
    assert [name for name, _, _ in found if not name.startswith("joint.")] == ["page.frames"]
