"""Command line, output file and tables of the scripts that measure speed."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from intercap_core.errors import UserError


def add_figures(output: Path, area: str, figures: Mapping[str, float]) -> None:
    """Write ``<area>.<measure>`` to the JSON file, in place of the area's older figures."""
    new = {f"{area}.{key}": round(float(value), 4) for key, value in figures.items()}
    replace_figures(output, new, (f"{area}.",))


def report_figures(output: Path, area: str, figures: Mapping[str, float]) -> None:
    """Write the figures of an area (:func:`add_figures`), and print them as tables."""
    from bench.evaluate.tables import print_figures

    add_figures(output, area, figures)
    print_figures({f"{area}.{key}": float(value) for key, value in figures.items()})
    print(output)


def replace_figures(output: Path, figures: Mapping[str, float], prefixes: tuple[str, ...]) -> None:
    """Add figures to a JSON file and remove those whose name begins with one of ``prefixes``.

    Raises UserError if the file is no JSON object.
    """
    known = {}
    if output.exists():
        try:
            known = dict(json.loads(output.read_text(encoding="utf-8")))
        except (ValueError, TypeError):
            raise UserError(f"{output} holds no figures; remove it or name another file") from None
    kept = {key: value for key, value in known.items() if not key.startswith(prefixes)}
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps({**kept, **figures}, indent=1) + "\n", encoding="utf-8")


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
