"""In words, the z-up frame of a scene: what its floor and its upright rest on."""

from __future__ import annotations

from intercap_core import artefacts

_BY_FLOOR = "z-up: gravity-aligned, ground at z = 0, metres"
_BY_STATED_FLOOR = "z-up: up and ground at z = 0 as stated with the calibration, metres"
_BY_HINT = {
    "gravity": "by the gravity sensors",
    "stated": "as stated with the calibration",
    "cameras": "by the mean of the cameras' own up, which may be tilted",
}


def z_up_frame(scene: artefacts.Artefact) -> str:
    """The frame to which ``zup_from_master`` of a scene artefact leads."""
    said = scene.attributes
    if said["ground_found"]:
        return _BY_STATED_FLOOR if said["ground_source"] == "stated" else _BY_FLOOR
    hint = _BY_HINT.get(str(said.get("up_source")), "by a hint that the scene does not name")
    return f"z-up: {hint}; no floor is known, z = 0 at the master camera, metres"
