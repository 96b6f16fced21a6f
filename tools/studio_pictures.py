"""Render docs/pictures/studio_*.jpg: what the studio's cameras see, and grasps from close by.

python tools/studio_pictures.py suitcase_carry s01 11 suitcase
python tools/studio_pictures.py --sheet handling bottle_drink:s03:5 cup_pass:s10:23
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from intercap_core.config import StudioCapture, StudioSettings  # noqa: E402
from intercap_core.entries import ObjectEntry  # noqa: E402
from intercap_core.geometry.camera.intrinsics import Intrinsics  # noqa: E402
from intercap_core.geometry.camera.transforms import invert, rigid  # noqa: E402
from intercap_core.studio.interactions import interaction_named  # noqa: E402
from intercap_core.studio.recording import surfaces_at  # noqa: E402
from intercap_core.studio.render import Photographer, RoomView  # noqa: E402
from intercap_core.studio.skeleton import unit  # noqa: E402
from intercap_core.studio.stage import StageState, StudioStage  # noqa: E402
from intercap_core.studio.subjects import body_colours  # noqa: E402


def object_entry(name: str) -> ObjectEntry:
    entry = yaml.safe_load((ROOT / "config/objects.yaml").read_text())[name]
    return ObjectEntry(name=name, **{**entry, "mesh": ROOT / "config" / entry["mesh"],
                                     "contact_vertices": None})  # fmt: skip


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    forward = unit(target - eye)
    right = unit(np.cross(forward, [0, 0, 1.0]))
    return rigid(np.stack([right, np.cross(forward, right), forward], 1), eye)


def picture(stage: StudioStage, view: RoomView, moment: StageState, t: int) -> np.ndarray:
    colours = body_colours(stage.subject, stage.noise.rng("looks"))
    photographer = Photographer(view, np.ones(3), np.random.default_rng(0))
    return photographer.photograph(view.cast(surfaces_at(stage, moment, t, colours)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="+", help="interaction subject seed object, or rows")
    parser.add_argument("--sheet", help="name of a sheet with one row for each interaction")
    parser.add_argument("--output", type=Path, default=ROOT / "docs/pictures")
    parser.add_argument("--times", type=float, nargs="+", default=[0.3, 0.9, 1.3, 1.7, 2.2, 2.7])
    parser.add_argument("--close", type=float, nargs="+", default=[1.02, 1.2, 1.75])
    options = parser.parse_args()
    if options.sheet:
        rows = [sheet_row(*what.split(":"), options.times) for what in options.what]
        save(options.output / f"studio_{options.sheet}.jpg", np.vstack(rows))
        return
    interaction, subject, seed, object_name = options.what
    capture = StudioCapture(interaction=interaction, subject=subject, seed=int(seed), frames=45)
    stage = StudioStage(capture, StudioSettings(captures={}), object_entry(object_name))
    moment = stage.at(np.array(options.times))
    rows = []
    stage_from_master = invert(stage.rig.master_from_stage)
    for index in (0, 3):
        camera = stage.rig.true[index]
        pose = stage_from_master @ camera.master_from_colour
        view = RoomView(camera.colour.scaled(0.5), pose, stage.room, coloured=True)
        images = [picture(stage, view, moment, t) for t in range(len(options.times))]
        rows.append(np.hstack([im[80:460, 240:720] for im in images]))
    name = f"studio_{interaction}"
    save(options.output / f"{name}.jpg", np.vstack(rows))
    save(options.output / f"{name}_close.jpg", close_ups(stage, options.close))


def sheet_row(interaction: str, subject: str, seed: str, times: list[float]) -> np.ndarray:
    """One interaction at six moments, from ahead and the right of where the person starts."""
    capture = StudioCapture(interaction=interaction, subject=subject, seed=int(seed), frames=45,
                            room="bare")  # fmt: skip
    entry = object_entry(interaction_named(interaction).object_class)
    stage = StudioStage(capture, StudioSettings(captures={}, cameras=1), entry)
    place = stage.stage_from_script
    target = np.array([*stage.interaction.centre, 0.95])
    eye = target + 2.6 * np.array([0.60, -0.72, 0.34])
    eye, target = (place[:3, :3] @ at + place[:3, 3] for at in (eye, target))
    view = RoomView(Intrinsics(300, 330, 400.0, 400.0, 149.5, 164.5), look_at(eye, target),
                stage.room, coloured=True)  # fmt: skip
    moment = stage.at(np.array(times))
    return np.hstack([picture(stage, view, moment, t) for t in range(len(times))])


def close_ups(stage: StudioStage, times: list[float]) -> np.ndarray:
    """Each time from two sides, centred where body and object are nearest."""
    moment = stage.at(np.array(times))
    lens = Intrinsics(420, 420, 900.0, 900.0, 209.5, 209.5)
    rows: list[list[np.ndarray]] = [[], []]
    for t in range(len(times)):
        pose = moment.stage_from_object[t]
        local = (moment.body[t] - pose[:3, 3]) @ pose[:3, :3]
        distance = stage.prop.surface.signed_distance(local)
        target = moment.body[t][np.argsort(distance)[:60]].mean(0)
        away = unit(target - moment.joints[t, 0])
        for row, side in enumerate((1.0, -1.0)):
            across = np.cross(away, [0, 0, 1.0]) * side
            eye = target + 0.95 * unit(0.7 * away * (1, 1, 0) + 0.9 * across + (0, 0, 0.45))
            view = RoomView(lens, look_at(eye, target), stage.room, coloured=True)
            rows[row].append(picture(stage, view, moment, t))
    return np.vstack([np.hstack(row) for row in rows])


def save(path: Path, image: np.ndarray) -> None:
    """A JPEG below 300 kB."""
    if image.shape[1] > 1800:
        image = cv2.resize(image, None, fx=1800 / image.shape[1], fy=1800 / image.shape[1],
                           interpolation=cv2.INTER_AREA)  # fmt: skip
    for quality in range(88, 30, -6):
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        if len(data) < 290_000:
            break
    path.write_bytes(data.tobytes())


if __name__ == "__main__":
    main()
