"""Tables on the terminal and in pipes, without truncated cells."""

from __future__ import annotations

import sys
from collections.abc import Iterator

from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

UNLIMITED = 100_000  # columns of a console that is no terminal
LAST_COLUMN = 24  # characters below which the last column is not wrapped


def counted(count: int, noun: str) -> str:
    """Return the number with the noun, which gets an s unless the number is 1."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def standard_console() -> Console:
    """Return the console of standard output; lines have any length if it is no terminal."""
    return Console(width=None if sys.stdout.isatty() else UNLIMITED)


def print_plain(console: Console, text: str) -> None:
    """Print text without markup, highlighting and line breaks."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


class ListTable(Table):
    """Table without borders that never truncates a cell.

    Only the last column is wrapped. If the other columns do not fit into the terminal, each row is
    a paragraph with one ``heading: value`` after the other.
    """

    def __init__(self, *headings: str, **options: object) -> None:
        super().__init__(*headings, box=None, pad_edge=False, header_style="bold", **options)  # type: ignore[arg-type]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render as a table, or as paragraphs if the terminal is too narrow."""
        for column in self.columns[:-1]:
            column.no_wrap = True
        wide = options.update(width=UNLIMITED)
        cells = [self.columns[-1].header, *self.columns[-1].cells]
        longest = max(Measurement.get(console, wide, cell).maximum for cell in cells)
        least = Measurement.get(console, wide, self).maximum - max(0, longest - LAST_COLUMN)
        if least <= options.max_width:
            yield from super().__rich_console__(console, options)
        else:
            yield from self._paragraphs(console)

    def _paragraphs(self, console: Console) -> Iterator[Text | Padding]:
        def text(cell: object) -> Text:
            return (
                console.render_str(cell, highlight=False)
                if isinstance(cell, str)
                else Text(str(cell))
            )

        heads = [text(column.header) for column in self.columns[1:]]
        if self.title:
            yield Text.assemble((str(self.title), "italic"))
        for name, *cells in zip(*(column.cells for column in self.columns), strict=True):
            yield Text.assemble(text(name), style="bold", overflow="fold")
            pairs = [
                Text.assemble(head, ": " if head else "", text(cell))
                for head, cell in zip(heads, cells, strict=True)
                if cell != ""
            ]
            yield Padding(Text("; ").join(pairs), (0, 0, 0, 2))
