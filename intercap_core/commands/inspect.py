"""`intercap inspect`: print the contents of an artefact."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape

from intercap_core import artefacts, schemas
from intercap_core.commands.console import ListTable, print_plain, standard_console
from intercap_core.errors import UserError
from intercap_core.evaluation.flags import ranges


def print_summary(path: Path, *, verify: bool = False) -> None:
    """Print attributes, datasets, the number of set flags and the texts.

    ``verify`` reads every dataset, which checks the checksums. Raises UserError if the file is no
    complete artefact or a checksum is wrong.
    """
    known = {s.name: s for s in vars(schemas).values() if isinstance(s, artefacts.Schema)}
    name = artefacts.schema_name(path)
    if name not in known:
        raise UserError(f"{path}: schema {name!r} is not known; known are {', '.join(known)}")
    schema = known[name]
    console = standard_console()
    with artefacts.read(path, schema) as source:
        for key, value in sorted(source.attributes.items()):
            console.print(f"[bold]{escape(key)}[/bold]  {escape(str(value))}", highlight=False)
        table = ListTable("dataset", "shape", "type", "units", "frame", "set", "meaning")
        for key in source.keys():  # noqa: SIM118 (an Artefact is not a mapping)
            shape, dtype, units, frame = source.describe(key)
            try:
                doc = schema.field_of(key).doc
            except KeyError:
                doc = "(not part of this schema)"
            count = ""
            if dtype == "bool" and shape:
                count = str(int(np.count_nonzero(source[key])))
            elif verify and shape:
                source[key]
            unit = "" if units == "1" else units
            cells = (key, " x ".join(map(str, shape)), dtype, unit, frame, count, doc)
            table.add_row(*map(escape, cells))
        console.print(table)
        for key in source.keys():  # noqa: SIM118
            _print_texts(source, key, console)
        if verify:
            console.print("every dataset was read and its checksum is right")


def _print_texts(source: artefacts.Artefact, key: str, console: Console) -> None:
    """Print the non-empty texts of a dataset, equal neighbours in one line.

    Prints nothing for datasets of numbers and of names.
    """
    shape, dtype, _, _ = source.describe(key)
    if dtype != "text" or len(shape) != 1 or key.endswith("_names"):
        return
    texts = source.text(key)
    cameras = source.text("camera_names") if "camera_names" in source else []
    by_camera = len(cameras) == len(texts) and key.rpartition("/")[2] == "note"
    lines = [f"{_span(first, last)}: {text}" for first, last, text in ranges(texts)]
    if by_camera:
        lines = [f"{name}: {text}" for name, text in zip(cameras, texts, strict=True) if text]
    if lines:
        console.print(f"[bold]{escape(key)}[/bold]", highlight=False)
    shown = 30
    for line in lines[:shown]:
        print_plain(console, f"  {line}")
    if len(lines) > shown:
        console.print(f"  ... and {len(lines) - shown} more", highlight=False)


def _span(first: int, last: int) -> str:
    return str(first) if first == last else f"{first} to {last}"
