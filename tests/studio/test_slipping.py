"""Scripts in which what is held moves in the hand: by as much as they say, skin on the surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from intercap_core.config import ObjectEntry, StudioCapture, StudioSettings
from intercap_core.evaluation.motion import SLIP_S, slip_speed
from intercap_core.studio.capture import CONTACT_M, region_contact
from intercap_core.studio.interactions.slipping import (
    BottleRegrasp,
    RacquetGlide,
    UmbrellaTurn,
    along_and_about,
)
from intercap_core.studio.stage import StageState, StudioStage

FPS = 15
Entry = Callable[[str], ObjectEntry]


@dataclass(frozen=True)
class Held:
    """A recording of 45 sets and where its skin is on the thing (T, V, 3), metres."""

    stage: StudioStage
    moment: StageState
    local: np.ndarray
    distance: np.ndarray

    @property
    def touching(self) -> np.ndarray:
        return self.distance <= CONTACT_M

    def true_slip(self) -> np.ndarray:
        """Metres a second (T,): the metric's, of a fit that sticks where it touches."""

        def normals_at(points: np.ndarray) -> np.ndarray:
            return self.stage.prop.surface.closest(points).normals

        found = np.full(len(self.local), np.nan)
        for t in range(len(self.local)):
            stuck = np.broadcast_to(self.local[t], self.local.shape)
            found[t] = slip_speed(stuck, self.local, self.touching, normals_at, FPS)[t]
        return found


@pytest.fixture(scope="module")
def held(object_entry: Entry) -> Callable[[str, str, str, int], Held]:
    known: dict[str, Held] = {}

    def play(name: str, thing: str, subject: str, seed: int) -> Held:
        if name not in known:
            capture = StudioCapture(interaction=name, subject=subject, seed=seed, frames=45)
            stage = StudioStage(
                capture, StudioSettings(captures={}, cameras=1), object_entry(thing)
            )
            moment = stage.at(stage.set_times)
            rotation = moment.stage_from_object[:, :3, :3]
            local = (moment.body - moment.stage_from_object[:, None, :3, 3]) @ rotation
            reach = np.linalg.norm(stage.prop.vertices, axis=1).max() + 0.02
            distance = np.full(local.shape[:2], np.inf)
            near = np.linalg.norm(local, axis=2) < reach
            distance[near] = stage.prop.surface.signed_distance(local[near])
            known[name] = Held(stage, moment, local, distance)
        return known[name]

    return play


def racquet(held: Callable[..., Held]) -> Held:
    return held("racquet_glide", "tennis_racquet", "s03", 6)


def umbrella(held: Callable[..., Held]) -> Held:
    return held("umbrella_turn", "umbrella", "s09", 26)


def bottle(held: Callable[..., Held]) -> Held:
    return held("bottle_regrasp", "bottle", "s08", 27)


def between(start: float, end: float) -> slice:
    """Sets whose whole window of the metric is in these script times."""
    return slice(int(np.ceil(start * FPS)), int((end - SLIP_S) * FPS) + 1)


def test_a_slide_turns_about_its_axis_and_shifts_along_it() -> None:
    moved = along_and_about(np.array([0.1]), np.array([np.pi / 2]), np.array([0.2, 0.0]))[0]
    np.testing.assert_allclose(moved @ [0.2, 0.0, 0.3, 1], [0.2, 0.0, 0.4, 1], atol=1e-12)
    np.testing.assert_allclose(moved @ [0.3, 0.0, 0.0, 1], [0.2, 0.1, 0.1, 1], atol=1e-12)


def test_truth_slips_as_fast_as_the_hand_glides(held: Callable[..., Held]) -> None:
    recording = racquet(held)
    start, end, back, home = RacquetGlide.glide_s
    slip = recording.true_slip()
    along = recording.stage.interaction.slide(recording.stage.set_times)[:, 2, 3]
    assert along.max() == pytest.approx(RacquetGlide.glide_m)
    window = round(SLIP_S * FPS)
    intended = np.abs(along[window:] - along[:-window]) * FPS / window
    for part in (between(start, end), between(back, home)):
        assert intended[part].max() > 0.07
        np.testing.assert_allclose(slip[part], intended[part], rtol=0.15, atol=0.005)


def test_truth_slips_as_fast_as_the_handle_turns(held: Callable[..., Held]) -> None:
    recording = umbrella(held)
    start, end, back, home = UmbrellaTurn.turn_s
    turned = recording.stage.interaction.slide(recording.stage.set_times)[:, :3, :3]
    angle = np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert angle.max() == pytest.approx(np.radians(UmbrellaTurn.turn_deg))
    slip = recording.true_slip()
    window = round(SLIP_S * FPS)
    turns = np.abs(angle[window:] - angle[:-window]) * FPS / window
    handle_m = 0.0108  # the handle is a round bar of 21.5 mm
    for part in (between(start, end), between(back, home)):
        assert turns[part].max() > 2.0
        np.testing.assert_allclose(slip[part], turns[part] * handle_m, rtol=0.35, atol=0.006)


@pytest.mark.parametrize("play", [racquet, umbrella])
def test_what_is_held_sticks_once_it_came_back(
    play: Callable[..., Held], held: Callable[..., Held]
) -> None:
    recording = play(held)
    assert np.nanmax(recording.true_slip()[between(2.05, 2.50)]) < 0.005


def test_a_regrasp_lets_go_and_holds_elsewhere(held: Callable[..., Held]) -> None:
    recording = bottle(held)
    stage, times = recording.stage, recording.stage.set_times
    right = region_contact(stage, recording.moment).any(1)
    opens, off, back, closed = BottleRegrasp.regrasp_s
    script = stage.interaction.script_times(times, stage.duration)
    assert right[(script > 0.97) & (script < opens)].all()
    assert not right[(script > off) & (script < back)].any()
    assert right[(script > closed) & (script < 2.45)].all()
    rests = script <= closed
    poses = recording.moment.stage_from_object
    assert np.abs(poses[rests] - poses[0]).max() < 1e-12
    first = np.flatnonzero((script > 0.97) & (script < opens))[0]
    later = np.flatnonzero(script > closed + 0.1)[0]
    both = recording.touching[first] & recording.touching[later]
    assert both.any()
    way = recording.local[later, both] - recording.local[first, both]
    assert np.linalg.norm(way, axis=1).min() > 0.015


@pytest.mark.parametrize("play", [racquet, umbrella, bottle])
def test_skin_that_slips_stays_on_the_surface(
    play: Callable[..., Held], held: Callable[..., Held]
) -> None:
    recording = play(held)
    holds = np.flatnonzero(recording.touching.any(1))
    assert recording.distance[holds].min() > -0.002
    patch = recording.touching.sum(1)
    assert np.median(patch[holds]) > 30


@pytest.mark.parametrize("play", [racquet, umbrella])
def test_no_finger_loses_what_slides(play: Callable[..., Held], held: Callable[..., Held]) -> None:
    recording = play(held)
    hold = slice(int(np.ceil(1.0 * FPS)), int(2.5 * FPS))
    patch = recording.touching.sum(1)[hold]
    assert patch.min() > 0.5 * np.median(patch)
