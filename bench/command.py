"""Command line, output file and figure class that the comparisons share."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from intercap_core.commands import bench as commands
from intercap_core.errors import UserError


def add_figures(output: Path, area: str, figures: Mapping[str, float]) -> None:
    """Write ``<area>.<measure>`` to the JSON file, in place of the area's older figures."""
    new = {f"{area}.{key}": round(float(value), 4) for key, value in figures.items()}
    commands.add_figures(output, new)


@contextmanager
def exit_on_user_error() -> Iterator[None]:
    """Print a user's mistake and end the process with status 1."""
    try:
        yield
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None


def from_command_line(
    measure: Callable[[Path, Path, int], None],
    description: str,
    count: int,
    counted: str = "frames",
    settings: Path = Path("config/bench/config.yaml"),
) -> None:
    """Read the command line and ``measure(settings, output, count)``.

    Args:
        count: default of the option ``--<counted>``.
        settings: default of the positional argument.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("settings", type=Path, nargs="?", default=settings)
    parser.add_argument("--output", type=Path, default=Path("results/bench.json"))
    parser.add_argument(f"--{counted}", type=int, default=count)
    arguments = parser.parse_args()
    with exit_on_user_error():
        measure(arguments.settings, arguments.output, getattr(arguments, counted))
