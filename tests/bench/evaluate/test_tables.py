"""Tables of an evaluation's figures: each figure has one cell."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.evaluate.captures import PART
from bench.evaluate.part import Figures, Measured
from bench.evaluate.tables import FigureKey, print_part, tabulate

FIGURES = {
    "object.lost_share": 0.25, "object.lost_share_spread": 0.0123456, "object.noise2_lost_share": 1,
    "object.cup.lost_share": 0.5, "object.cup.noise2_lost_share": 0.75,
    "object.noise2_views_2.frames": 12345, "joint.contact_f1_at_4.5mm": 0.9,
    "object.p95_mm": float("inf"), "object.p95_mm_spread": 1,
}  # fmt: skip


def test_columns_are_variants_and_groups() -> None:
    tables = [
        [str(table.title or ""), *([str(c.header), *map(str, c.cells)] for c in table.columns)]
        for table in tabulate(FIGURES, ["noise2_"])
    ]
    assert tables == [
        [
            "", ["measure", "lost_share", "p95_mm"], ["object", "0.25 +- 0.01235", ""],
            ["object noise2", "1", ""],
        ],
        ["", ["measure", "contact_f1_at_4.5mm"], ["joint", "0.9"]],
        ["object", ["measure", "lost_share"], ["cup", "0.5"]],
        ["object noise2", ["measure", "lost_share"], ["cup", "0.75"]],
        ["object noise2", ["measure", "frames"], ["views_2", "12345"]],
    ]  # fmt: skip


def test_prefix_of_a_variant_is_removed_from_group_or_measure() -> None:
    prefixes = ["two_view_rgb_", "two_view_"]
    assert FigureKey.parse("body.two_view_rgb_mm", prefixes) == ("body", "", "two_view_rgb", "mm")
    assert FigureKey.parse("body.a.two_view_mm", prefixes) == ("body", "a", "two_view", "mm")
    assert FigureKey.parse("body.a.mm", prefixes) == ("body", "a", "", "mm")


def test_recordings_without_figures_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    def flat(measured: list[Measured[float]]) -> Figures:
        return {f"{m.dataset}.mm": m.errors[0] for m in measured if m.errors}

    part = replace(
        PART, flat=flat, columns=("mm",), problems=lambda e: [] if e else ["no board [/a.h5]"]
    )
    print_part(part, [Measured("rig", [2.5, 0.0], ["lost"], ["first", "second"])], {"rig.mm": 2.5})
    lines = [line.split(maxsplit=3) for line in capsys.readouterr().out.splitlines()]
    assert ["rig:", "first", "2.5"] in lines
    assert ["rig:", "second", "0", "no board [/a.h5]"] in [[c.strip() for c in x] for x in lines]
    assert ["rig:", "lost", "no", "artefact of scene"] in [[c.strip() for c in x] for x in lines]
