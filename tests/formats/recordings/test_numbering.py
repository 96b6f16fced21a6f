"""Names of image files: their order and times, and which depth belongs to which image."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from intercap_core.errors import UserError
from intercap_core.formats.recordings.numbering import natural_key
from intercap_core.formats.recordings.timestamps import PairedImages, Timestamps, pair_images

FPS = 30.0


def pair(
    colour: list[str], depth: list[str] | None = None, times: Timestamps | None = None, **more: int
) -> PairedImages:
    files, of_depth = (sorted(map(Path, names)) for names in (colour, depth or []))
    return pair_images(files, of_depth, fps=FPS, offset_s=0, times=times, source=Path("k1"), **more)


@pytest.mark.parametrize(
    "name_of",
    [
        lambda n: f"frame{n}_k1",
        lambda n: f"frame_{n:04d}_k2",
        lambda n: f"{n}",
        lambda n: f"take2_{n:03d}_v1.5",
        lambda n: f"{n:04d}_{7919 * (n + 1) % 1009:04d}",
        lambda n: f"img{n:02d}" + "_blurred2" * (n == 3),
    ],
)
def test_the_number_of_an_image_is_found_in_its_name(name_of: Callable[[int], str]) -> None:
    numbers = [n for n in range(24) if n not in (5, 6)]
    found = pair([f"{name_of(n)}.jpg" for n in numbers])
    assert (found.timing, found.notes) == ("by number", [])
    expected = [(round(n * 1e6 / FPS), f"{name_of(n)}.jpg") for n in numbers]
    assert [(time, path.name) for time, path, _ in found.pairs if path] == expected


@pytest.mark.parametrize(
    "names",
    [
        ["b", "a", "c"],
        ["20240101_1000", "20240101_1001", "20240102_1000"],
        ["a2_2", "a2_10", "a10_2"],
    ],
)
def test_names_without_a_number_of_their_own_are_in_natural_order(names: list[str]) -> None:
    found = pair(names)
    assert found.timing == "by order" and "in the order of their names" in found.notes[0]
    assert [path.name for _, path, _ in found.pairs if path] == sorted(names, key=natural_key)
    assert pair(names, times={0: 0.0, 1: 0.1, 2: 0.2}).notes == []


@pytest.mark.parametrize(
    "names",
    [
        [*(f"{n:05d}.jpg" for n in range(8)), "00003 (1).jpg"],
        [*(f"{n:05d}.jpg" for n in range(8)), "00003 (25).jpg"],
        [*(f"{n:05d}.jpg" for n in range(8)), "background.jpg"],
        [f"{side}_{n}.jpg" for side in ("left", "right") for n in range(4)],
        [f"{100 + (n + 7) // 10}_{(n + 7) % 10 * 997 + n}.jpg" for n in range(9)],  # s_ns
    ],
)
def test_names_that_do_not_determine_the_order_are_refused(names: list[str]) -> None:
    with pytest.raises(UserError, match=r"^k1: the names do not determine the order.*timestamps"):
        pair(names)
    stated = pair(names, times={name: 9 - place / 10 for place, name in enumerate(names)})
    assert [path.name for _, path, _ in stated.pairs if path] == names[::-1]
    assert stated.notes == []


@pytest.mark.parametrize("first", [1, 100])
@pytest.mark.parametrize("missing", [(), (4,)])
def test_depth_with_a_counter_of_its_own(first: int, missing: tuple[int, ...]) -> None:
    numbers = [n for n in range(9) if n not in missing]
    depth = [f"d_{n + first:05d}.png" for n in numbers]
    found = pair([f"{n:05d}.jpg" for n in numbers], depth)
    assert [path.name for _, _, path in found.pairs if path] == depth
    assert all(shot.colour and shot.depth for shot in found.pairs)
    assert f"depth/d_{first:05d}.png is taken for the depth of 00000.jpg" in found.notes[0]
    if not missing:
        beside_video = pair([], depth, images=9)
        assert beside_video.pairs[0].time_us == 0 and "of image 0" in beside_video.notes[0]


@pytest.mark.parametrize("kept", [(0, 2, 4), (3,), (1, 2, 3, 4)])
def test_depth_of_equal_number_belongs_together(kept: tuple[int, ...]) -> None:
    found = pair([f"f_{n:03d}_k1.jpg" for n in range(5)], [f"{n:05d}_k9.png" for n in kept])
    together = [shot.time_us * FPS / 1e6 for shot in found.pairs if shot.colour and shot.depth]
    assert together == pytest.approx(kept, abs=1e-4) and found.notes == []


def test_depth_without_any_equal_number_is_refused() -> None:
    with pytest.raises(UserError, match="no depth file has the number of a colour image"):
        pair(["0.jpg", "1.jpg", "2.jpg"], ["100.png", "101.png"])
