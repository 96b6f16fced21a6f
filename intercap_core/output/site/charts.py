"""Charts as inline SVG, coloured by the page's style sheet; equal numbers give equal bytes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from intercap_core.evaluation import flags
from intercap_core.geometry.solve.time_series import runs
from intercap_core.output.site.embed import span

_WIDTH = 440  # width of a line chart, px; readable on a phone
_LEFT = 56  # left edge of its axes, px
_ROW = 22  # height of a row of a timeline, px


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
    """(N,); the line has a gap where a value is NaN."""


Axis = tuple[str, float, float]
"""Label, lower and upper end."""


def line_chart(
    series: Sequence[Series], x_axis: Axis, y_axis: Axis, marks: Sequence[tuple[float, str]] = ()
) -> str:
    """Plot lines with axes, grid and legend; ``marks`` are labelled vertical lines."""
    (x_label, *x_range), (y_label, *y_range) = x_axis, y_axis
    named = [line for line in series if line.name]
    legend = _legend([line.name for line in named])
    legend_row, right, bottom = 18, 16, 44
    legend_height = legend_row * max((row for _, row in legend), default=0)
    top, height = 34 + legend_height, 290 + legend_height
    inner_width, inner_height = _WIDTH - _LEFT - right, height - top - bottom

    def at_x(value: float) -> float:
        return _LEFT + inner_width * (value - x_range[0]) / (x_range[1] - x_range[0])

    def at_y(value: float) -> float:
        return top + inner_height * (1 - (value - y_range[0]) / (y_range[1] - y_range[0]))

    parts = [_open(_WIDTH, height, f"{y_label} by {x_label}")]
    for tick in ticks(y_range[0], y_range[1]):
        y = at_y(tick)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - right}" {_same("y", y)}/>')
        parts.append(_text(_LEFT - 6, y + 4, _number(tick), "tick", "end"))
    for tick in ticks(x_range[0], x_range[1]):
        x = at_x(tick)
        parts.append(_text(x, height - bottom + 16, _number(tick), "tick", "middle"))
        parts.append(f'<line class="grid" {_same("x", x)} y1="{top}" y2="{top + inner_height}"/>')
    for value, label in marks:
        x = at_x(value)
        parts.append(f'<line class="mark" {_same("x", x)} y1="{top}" y2="{top + inner_height}"/>')
        parts.append(_text(x + 3, top + 10, label, "tick", "start"))
    for line in series:
        for first, last in runs(np.isfinite(line.y)):
            points = " ".join(
                f"{at_x(float(line.x[i])):.1f},{at_y(float(line.y[i])):.1f}"
                for i in range(first, last + 1)
            )
            parts.append(f'<polyline {_stroke(line.colour)} points="{points}"/>')
    for line, (x, row) in zip(named, legend, strict=True):
        y = 14 + legend_row * row
        ends = f'x1="{x:.1f}" x2="{x + 20:.1f}"'
        parts.append(f"<line {_stroke(line.colour)} {ends} {_same('y', y)}/>")
        parts.append(_text(x + 26, y + 4, line.name, "legend", "start"))
    parts.append(_text(_LEFT + inner_width / 2, height - 8, x_label, "label", "middle"))
    parts.append(
        f'<text class="label" text-anchor="middle" transform="translate(14 '
        f'{top + inner_height / 2:.1f}) rotate(-90)">{escape(y_label)}</text>'
    )
    return "".join([*parts, "</svg>"])


def frame_chart(series: Sequence[Series], total: int, y_label: str, least: float = 10.0) -> str:
    """Plot lines over ``total`` frames; the vertical axis reaches at least to ``least``."""
    top = max(least, *(1.1 * float(np.nanmax(line.y, initial=0.0)) for line in series))
    return line_chart(series, ("frame", 0.0, max(total - 1, 1)), (y_label, 0.0, top))


def _legend(names: Sequence[str]) -> list[tuple[float, int]]:
    """Return x and row of each entry of a legend; rows are filled from left to right."""
    places, x, row = [], float(_LEFT), 0
    for name in names:
        wide = max(100, 44 + 6.6 * len(name))
        if x > _LEFT and x + wide > _WIDTH:
            x, row = float(_LEFT), row + 1
        places.append((x, row))
        x += wide
    return places


@dataclass(frozen=True, eq=False)
class TimelineRow:
    """A row of a timeline."""

    name: str
    """Text at the beginning of the row."""
    runs: Sequence[tuple[int, int, str, str]]
    """First and last frame, CSS classes and words of each run of frames; the tooltip has the frames
    and the words."""
    label: str = ""
    """Text at the end of the row."""
    levels: np.ndarray | None = None
    """(T,) in 0..1: the row is filled to these levels, and the runs are invisible."""


def timeline(rows: Sequence[TimelineRow], total: int, marks: Sequence[tuple[int, str]] = ()) -> str:
    """Draw rows of runs over ``total`` frames.

    Args:
        marks: vertical lines after a frame, with their tooltips.
    """
    left, bottom, tall = _room_for([row.name for row in rows]), _ROW * len(rows), _ROW - 7
    labelled = any(row.label for row in rows)
    inner, right = (560, 330) if labelled else (700, 16)
    parts = [_open(left + inner + right, bottom + 24, f"frames: {', '.join(r.name for r in rows)}")]

    def at_x(frame: float) -> float:
        return left + inner * frame / max(total, 1)

    for index, row in enumerate(rows):
        y = _ROW * index + 4
        parts.append(_text(left - 8, y + 12, row.name, "tick", "end"))
        if not labelled:
            track = f'x="{left}" y="{y}" width="{inner}" height="{tall}" rx="3"'
            parts.append(f'<rect class="track" {track}/>')
        if row.levels is not None:
            steps = [(at_x(t), y + tall * (1 - level)) for t, level in _steps(row.levels)]
            line = "".join(f"H{x:.1f}V{down:.1f}" for x, down in steps)
            parts.append(
                f'<path class="fill touch" d="M{left} {y + tall}{line}'
                f'H{at_x(total):.1f}V{y + tall}Z"/><line class="half" x1="{left}" '
                f'x2="{left + inner}" {_same("y", y + tall / 2)}/>'
            )
        for first, last, css, words in row.runs:
            x = at_x(first)
            long = max(1.5, at_x(last + 1) - x)
            title = f"{span(first, last)}: {words}" if words else span(first, last)
            parts.append(
                f'<rect class="{css}" x="{x:.1f}" y="{y}" width="{long:.1f}" '
                f'height="{tall}" rx="2"><title>{escape(title)}</title></rect>'
            )
        parts.append(_text(left + inner + 10, y + 12, row.label, "tick", "start"))
    for frame, title in marks:
        ends = f'{_same("x", at_x(frame + 1))} y1="0" y2="{bottom}"'
        parts.append(f'<line class="gap" {ends}><title>{escape(title)}</title></line>')
    for tick in ticks(0, total, 8):
        if tick < total and tick == int(tick):
            parts.append(_text(at_x(tick + 0.5), bottom + 18, _number(tick), "tick", "middle"))
    return "".join([*parts, "</svg>"])


def _steps(levels: np.ndarray) -> list[tuple[int, float]]:
    """Return the frames at which levels (T,) change, with the new level.

    Levels are rounded to fiftieths; NaN counts as 0.
    """
    rounded = np.rint(50 * np.nan_to_num(levels)) / 50
    changed = np.flatnonzero(np.diff(rounded, prepend=-1.0))
    return [(int(t), float(rounded[t])) for t in changed]


def state_runs(states: Sequence[str], words: Mapping[str, str]) -> list[tuple[int, int, str, str]]:
    """Return the runs of a :class:`TimelineRow`; ``words``: by state."""
    return [(a, b, f"state {state}", words[state]) for a, b, state in flags.ranges(states)]


@dataclass(frozen=True)
class BarPair:
    """Two values of a row, the first one drawn in grey; NaN values are not drawn."""

    name: str
    first: float
    second: float
    label: str
    """Text at the end of the row."""
    weak: bool = False
    """The values have little support."""

    @classmethod
    def change(
        cls, name: str, before: float, after: float, note: str = "", weak: bool = False
    ) -> BarPair:
        """Return a pair that is labelled with both values."""
        values = " → ".join(f"{v:.1f}" if math.isfinite(v) else "–" for v in (before, after))
        label = f"{values}{f'  ·  {note}' if note else ''}{', little overlap' if weak else ''}"
        return cls(name, before, after, label, weak)


def bar_pairs(rows: Sequence[BarPair], unit: str, description: str = "before and after") -> str:
    """Draw two bars per row, the first above the second."""
    top = max([*(v for r in rows for v in (r.first, r.second) if math.isfinite(v)), 1e-9])
    left, inner, tall = _room_for([row.name for row in rows]), 360, 24
    height = tall * len(rows) + 40
    parts = [_open(left + inner + 190, height, f"{description}, {unit}")]
    for tick in ticks(0, top):
        x = left + inner * tick / top
        parts.append(f'<line class="grid" {_same("x", x)} y1="2" y2="{height - 36}"/>')
        parts.append(_text(x, height - 22, _number(tick), "tick", "middle"))
    for index, row in enumerate(rows):
        y = tall * index + 4
        parts.append(_text(left - 8, y + 12, row.name, "tick", "end"))
        for value, css, down in ((row.first, "faint", 0), (row.second, "c1", 8)):
            if math.isfinite(value):
                kind = f"bar {css} weak" if row.weak else f"bar {css}"
                parts.append(
                    f'<rect class="{kind}" x="{left}" y="{y + down}" '
                    f'width="{max(1.0, inner * value / top):.1f}" height="7"/>'
                )
        parts.append(_text(left + inner + 10, y + 12, row.label, "tick", "start"))
    parts.append(_text(left + inner / 2, height - 6, unit, "label", "middle"))
    return "".join([*parts, "</svg>"])


def ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Return the multiples of a round step from ``low`` to ``high``, about ``count`` or fewer."""
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
    """Attributes x1 and x2, or y1 and y2, with the same value."""
    return f'{axis}1="{value:.1f}" {axis}2="{value:.1f}"'


def _text(x: float, y: float, text: str, css: str, anchor: str) -> str:
    return (
        f'<text class="{css}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
    )


def _number(value: float) -> str:
    return f"{value:.6g}"
