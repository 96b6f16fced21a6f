"""Charts as inline SVG, coloured by the page's style sheet; equal numbers give equal bytes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from intercap_core.evaluation import flags

_WIDTH, _HEIGHT = 440, 290  # of a line chart, readable on a phone
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 16, 34, 44
_ROW = 22
_LABEL = 150
_LETTER = 6.6  # mean width of a letter in a legend
_LEGEND_ROW = 18


@dataclass(frozen=True, eq=False)
class Series:
    """A line of a chart."""

    name: str
    """Entry in the legend, "" for none."""
    colour: str
    """CSS class or "#rrggbb"."""
    x: np.ndarray
    """(N,)"""
    y: np.ndarray
    """(N,)"""


def line_chart(
    series: Sequence[Series],
    *,
    x_label: str,
    y_label: str,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    marks: Sequence[tuple[float, str]] = (),
) -> str:
    """Plot lines with axes, grid and legend; ``marks`` are labelled vertical lines."""
    named = [line for line in series if line.name]
    legend = _legend([line.name for line in named])
    top = _TOP + _LEGEND_ROW * max((row for _, row in legend), default=0)
    height = _HEIGHT + top - _TOP
    inner_width, inner_height = _WIDTH - _LEFT - _RIGHT, height - top - _BOTTOM

    def at_x(value: float) -> float:
        return _LEFT + inner_width * (value - x_range[0]) / (x_range[1] - x_range[0])

    def at_y(value: float) -> float:
        return top + inner_height * (1 - (value - y_range[0]) / (y_range[1] - y_range[0]))

    parts = [_open(_WIDTH, height, f"{y_label} by {x_label}")]
    for tick in ticks(*y_range):
        y = at_y(tick)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" {_same("y", y)}/>')
        parts.append(_text(_LEFT - 6, y + 4, _number(tick), "tick", "end"))
    for tick in ticks(*x_range):
        x = at_x(tick)
        parts.append(_text(x, height - _BOTTOM + 16, _number(tick), "tick", "middle"))
        parts.append(f'<line class="grid" {_same("x", x)} y1="{top}" y2="{top + inner_height}"/>')
    for value, label in marks:
        x = at_x(value)
        parts.append(f'<line class="mark" {_same("x", x)} y1="{top}" y2="{top + inner_height}"/>')
        parts.append(_text(x + 3, top + 10, label, "tick", "start"))
    for line in series:
        points = " ".join(
            f"{at_x(float(x)):.1f},{at_y(float(y)):.1f}"
            for x, y in zip(line.x, line.y, strict=True)
        )
        parts.append(f'<polyline {_stroke(line.colour)} points="{points}"/>')
    for line, (x, row) in zip(named, legend, strict=True):
        y = 14 + _LEGEND_ROW * row
        ends = f'x1="{x:.1f}" x2="{x + 20:.1f}"'
        parts.append(f"<line {_stroke(line.colour)} {ends} {_same('y', y)}/>")
        parts.append(_text(x + 26, y + 4, line.name, "legend", "start"))
    parts.append(_text(_LEFT + inner_width / 2, height - 8, x_label, "label", "middle"))
    parts.append(
        f'<text class="label" text-anchor="middle" transform="translate(14 '
        f'{top + inner_height / 2:.1f}) rotate(-90)">{escape(y_label)}</text>'
    )
    return "".join([*parts, "</svg>"])


def _legend(names: Sequence[str]) -> list[tuple[float, int]]:
    """Return x and row of each entry of a legend; rows are filled from left to right."""
    places, x, row = [], float(_LEFT), 0
    for name in names:
        wide = max(100, 44 + _LETTER * len(name))
        if x > _LEFT and x + wide > _WIDTH:
            x, row = float(_LEFT), row + 1
        places.append((x, row))
        x += wide
    return places


@dataclass(frozen=True, eq=False)
class Band:
    """A row of a timeline."""

    name: str
    colour: str
    """CSS class."""
    runs: Sequence[tuple[int, int, str]]
    """First and last frame of each bar, and its tooltip."""
    levels: np.ndarray | None = None
    """(T,) in 0..1: the row is filled to these levels instead of showing bars."""


def timeline(bands: Sequence[Band], total: int) -> str:
    """Draw rows of bars over ``total`` frames."""
    width, tall = 860, _ROW - 7
    inner = width - _LABEL - _RIGHT
    height = _ROW * len(bands) + 24
    parts = [_open(width, height, f"frames: {', '.join(band.name for band in bands)}")]

    def at_x(frame: float) -> float:
        return _LABEL + inner * frame / total

    for row, band in enumerate(bands):
        y = _ROW * row + 4
        parts.append(_text(_LABEL - 8, y + 12, band.name, "tick", "end"))
        parts.append(
            f'<rect class="track" x="{_LABEL}" y="{y}" width="{inner}" height="{tall}" rx="3"/>'
        )
        if band.levels is not None:
            ends = [(at_x(t), y + tall * (1 - level)) for t, level in _steps(band.levels)]
            line = "".join(f"H{x:.1f}V{down:.1f}" for x, down in ends)
            parts.append(
                f'<path class="fill {band.colour}" d="M{_LABEL} {y + tall}{line}'
                f'H{at_x(total):.1f}V{y + tall}Z"/>'
            )
            parts.append(
                f'<line class="half" x1="{_LABEL}" x2="{_LABEL + inner}" '
                f"{_same('y', y + tall / 2)}/>"
            )
        for first, last, title in band.runs:
            x = at_x(first)
            long = max(1.5, inner * (last + 1 - first) / total)
            kind = f"fill {band.colour}" if band.levels is None else "hover"
            parts.append(
                f'<rect class="{kind}" x="{x:.1f}" y="{y}" width="{long:.1f}" '
                f'height="{tall}" rx="2"><title>{escape(title)}</title></rect>'
            )
    for tick in ticks(0, total, 8):
        if tick < total:
            parts.append(_text(at_x(tick + 0.5), height - 6, _number(tick), "tick", "middle"))
    return "".join([*parts, "</svg>"])


def _steps(levels: np.ndarray) -> list[tuple[int, float]]:
    """Return frames at which levels (T,), rounded to fiftieths, change; NaN counts as 0."""
    rounded = np.rint(50 * np.nan_to_num(levels)) / 50
    changed = np.flatnonzero(np.diff(rounded, prepend=-1.0))
    return [(int(t), float(rounded[t])) for t in changed]


@dataclass(frozen=True)
class StateRow:
    """A row of a timeline that has a state in every frame."""

    name: str
    runs: Sequence[tuple[int, int, str, str]]
    """First and last frame, state (a CSS class) and tooltip of each run."""
    label: str
    """Text at the end of the row."""


def state_timeline(
    rows: Sequence[StateRow],
    total: int,
    marks: Sequence[tuple[int, str]] = (),
) -> str:
    """Draw rows of states over ``total`` frames.

    Args:
        marks: vertical lines after a frame, with their tooltips.
    """
    left, inner, bottom = _room_for([row.name for row in rows]), 560, _ROW * len(rows)
    width, height = left + inner + 330, bottom + 24
    parts = [_open(width, height, f"frames: {', '.join(row.name for row in rows)}")]

    def at_x(frame: float) -> float:
        return left + inner * frame / max(total, 1)

    for index, row in enumerate(rows):
        y = _ROW * index + 4
        parts.append(_text(left - 8, y + 12, row.name, "tick", "end"))
        for first, last, state, title in row.runs:
            x = at_x(first)
            long = max(1.5, at_x(last + 1) - x)
            parts.append(
                f'<rect class="state {state}" x="{x:.1f}" y="{y}" width="{long:.1f}" '
                f'height="{_ROW - 7}"><title>{escape(title)}</title></rect>'
            )
        parts.append(_text(left + inner + 10, y + 12, row.label, "tick", "start"))
    for frame, title in marks:
        x = at_x(frame + 1)
        parts.append(
            f'<line class="gap" {_same("x", x)} y1="0" y2="{bottom}">'
            f"<title>{escape(title)}</title></line>"
        )
    for tick in ticks(0, total, 8):
        if tick < total and tick == int(tick):
            parts.append(_text(at_x(tick + 0.5), height - 6, _number(tick), "tick", "middle"))
    return "".join([*parts, "</svg>"])


def state_runs(states: Sequence[str], words: Mapping[str, str]) -> list[tuple[int, int, str, str]]:
    """Return the runs of a :class:`StateRow`; ``words`` has the tooltip of each state."""
    return [
        (a, b, state, f"{a}–{b}: {words[state]}" if b > a else f"{a}: {words[state]}")
        for a, b, state in flags.ranges(states)
    ]


@dataclass(frozen=True)
class Bar:
    """A value and a maximum, drawn as a bar and a thin line."""

    name: str
    value: float
    most: float
    label: str


def _upright_grid(top: float, left: float, inner: float, height: float) -> list[str]:
    """Draw vertical grid lines with numbers from 0 to ``top``."""
    parts = []
    for tick in ticks(0, top):
        x = left + inner * tick / top
        parts.append(f'<line class="grid" {_same("x", x)} y1="2" y2="{height - 36}"/>')
        parts.append(_text(x, height - 22, _number(tick), "tick", "middle"))
    return parts


def bars(rows: Sequence[Bar], unit: str) -> str:
    """Draw one bar per row, with its value."""
    top = max([*(row.most for row in rows), 1e-9])
    left, inner, tall = _room_for([row.name for row in rows]), 300, 16
    width, height = left + inner + 150, tall * len(rows) + 40
    parts = [_open(width, height, unit)]
    parts += _upright_grid(top, left, inner, height)
    for index, row in enumerate(rows):
        y = tall * index + 4
        parts.append(_text(left - 8, y + 9, row.name, "tick", "end"))
        for value, css, down, thick in ((row.most, "faint", 3, 3), (row.value, "c1", 0, 9)):
            parts.append(
                f'<rect class="bar {css}" x="{left}" y="{y + down}" '
                f'width="{max(1.0, inner * value / top):.1f}" height="{thick}"/>'
            )
        text = f"{row.value:.1f}, {row.label}"
        parts.append(_text(left + inner + 10, y + 9, text, "tick", "start"))
    parts.append(_text(left + inner / 2, height - 6, unit, "label", "middle"))
    return "".join([*parts, "</svg>"])


@dataclass(frozen=True)
class BarPair:
    """A value before and after."""

    name: str
    before: float
    after: float
    label: str
    weak: bool
    """The values have little support."""


def bar_pairs(rows: Sequence[BarPair], unit: str) -> str:
    """Draw two bars per row, before above after, with their values."""
    top = max([*(v for r in rows for v in (r.before, r.after) if math.isfinite(v)), 1e-9])
    left, inner, tall = _room_for([row.name for row in rows]), 360, 24
    width, height = left + inner + 190, tall * len(rows) + 40
    parts = [_open(width, height, f"before and after, {unit}")]
    parts += _upright_grid(top, left, inner, height)
    for index, row in enumerate(rows):
        y = tall * index + 4
        parts.append(_text(left - 8, y + 12, row.name, "tick", "end"))
        for value, css, down in ((row.before, "faint", 0), (row.after, "c1", 8)):
            if math.isfinite(value):
                kind = f"bar {css} weak" if row.weak else f"bar {css}"
                parts.append(
                    f'<rect class="{kind}" x="{left}" y="{y + down}" '
                    f'width="{max(1.0, inner * value / top):.1f}" height="7"/>'
                )
        values = " → ".join(
            f"{v:.1f}" if math.isfinite(v) else "–" for v in (row.before, row.after)
        )
        label = f"  ·  {row.label}" if row.label else ""
        text = f"{values}{label}{', weak' if row.weak else ''}"
        parts.append(_text(left + inner + 10, y + 12, text, "tick", "start"))
    parts.append(_text(left + inner / 2, height - 6, unit, "label", "middle"))
    return "".join([*parts, "</svg>"])


def dumbbells(rows: Sequence[tuple[str, float, float]], unit: str) -> str:
    """Draw one row per pair of numbers, before and after."""
    finite = [v for _, *pair in rows for v in pair if math.isfinite(v)]
    top = max([*finite, 1e-9]) * 1.1
    width, height = 640, _ROW * len(rows) + 40
    inner = width - _LABEL - _RIGHT
    parts = [_open(width, height, f"before and after, {unit}")]
    for tick in ticks(0, top):
        x = _LABEL + inner * tick / top
        parts.append(f'<line class="grid" {_same("x", x)} y1="4" y2="{height - 36}"/>')
        parts.append(_text(x, height - 22, _number(tick), "tick", "middle"))
    for row, (name, before, after) in enumerate(rows):
        y = _ROW * row + 14
        parts.append(_text(_LABEL - 8, y + 4, name, "tick", "end"))
        if not (math.isfinite(before) and math.isfinite(after)):
            continue
        x0, x1 = (_LABEL + inner * v / top for v in (before, after))
        parts.append(f'<line class="link" x1="{x0:.1f}" x2="{x1:.1f}" {_same("y", y)}/>')
        parts.append(f'<circle class="dot faint" cx="{x0:.1f}" cy="{y}" r="4"/>')
        parts.append(f'<circle class="dot c1" cx="{x1:.1f}" cy="{y}" r="4.5"/>')
    parts.append(_text(_LABEL + inner / 2, height - 6, unit, "label", "middle"))
    return "".join([*parts, "</svg>"])


def ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Return about ``count`` round numbers from ``low`` to ``high``."""
    step = (high - low) / count
    size = 10 ** math.floor(math.log10(step)) if step > 0 else 1.0
    step = min((s * size for s in (1, 2, 5, 10) if s * size >= step * 0.999), default=size)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def _open(width: int, height: int, name: str) -> str:
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label={quoteattr(name)} '
        f'style="--width:{width}px">'
    )


def _room_for(names: Sequence[str]) -> int:
    """Return the width of a column of labels, pixels."""
    return 16 + max(30, min(240, 7 * max((len(name) for name in names), default=0)))


def _stroke(colour: str) -> str:
    if colour.startswith("#"):
        return f'class="line" stroke="{escape(colour)}"'
    return f'class="line {colour}"'


def _same(axis: str, value: float) -> str:
    return f'{axis}1="{value:.1f}" {axis}2="{value:.1f}"'


def _text(x: float, y: float, text: str, css: str, anchor: str) -> str:
    return (
        f'<text class="{css}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
    )


def _number(value: float) -> str:
    return f"{value:.6g}"
