"""`intercap dev docs`: documentation that is generated from the code.

Settings with their defaults, tables of all settings and columns, JSON schemas for editors, the
contents of every artefact, and the table of the joint fit's terms.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from intercap_core import schemas
from intercap_core.annotation import Annotation
from intercap_core.artefact_schema import Schema
from intercap_core.config import Config
from intercap_core.entries import ObjectEntry, SequenceEntry, SubjectEntry

ENTRIES: dict[str, tuple[type[BaseModel], str, str]] = {
    "config": (Config, "config.yaml", "Settings"),
    "sequences": (SequenceEntry, "sequences.tsv", "Recordings, one a row, columns split by tabs"),
    "subjects": (SubjectEntry, "subjects.tsv", "People, one a row, columns split by tabs"),
    "objects": (ObjectEntry, "objects.yaml", "Objects, one an entry under its name"),
    "annotation": (Annotation, "annotations/<sequence>.yaml", "What a person adds by hand"),
}
STARTING_DATASET = "my_dataset"
# Lines of docs/equations.md between which the table of the joint terms is generated.
TERMS_BEGIN, TERMS_END = "<!-- joint terms -->\n", "<!-- end of joint terms -->\n"


def generate(root: Path, *, write: bool) -> list[Path]:
    """Return the stale generated files under ``root``; with ``write``, update them."""
    stale = []
    for relative, text in contents(root).items():
        path = root / relative
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            stale.append(path)
            if write:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
    return stale


def contents(root: Path) -> dict[str, str]:
    """Text of every generated file by its path, relative to ``root``."""
    files = {
        "config/config.yaml": default_settings(),
        "config/README.md": settings_page(),
        "docs/artefacts.md": artefacts_page(),
        "docs/equations.md": equations_page((root / "docs/equations.md").read_text("utf-8")),
    }
    for name, (model, _, _) in ENTRIES.items():
        text = json.dumps(model.model_json_schema(), indent=2) + "\n"
        files[f"config/schemas/{name}.json"] = text
    return files


def default_settings() -> str:
    """config.yaml with every default below its description."""
    lines = [
        "# Settings of a dataset. Only the dataset's name is required.",
        "# config/README.md lists allowed values; paths are relative to this file.",
        "# yaml-language-server: $schema=schemas/config.json",
    ]
    values = Config(dataset=STARTING_DATASET).model_dump(mode="json")
    _settings(Config.model_json_schema(), Config.model_json_schema(), values, "", lines)
    return "\n".join(lines) + "\n"


# The functions below read the JSON schema of a pydantic model. ``top`` is the whole schema, with
# the definitions of inner models; ``schema`` is a model in it; ``entry`` is a property of a model.
def _settings(
    top: dict[str, Any],
    schema: dict[str, Any],
    values: dict[str, Any],
    pad: str,
    lines: list[str],
) -> None:
    """Append the lines of config.yaml for the properties of ``schema``, indented by ``pad``."""
    for name, entry in schema["properties"].items():
        if name == "studio" and not pad:  # for virtual recordings only
            continue
        lines += [""] if not pad else []
        lines += [f"{pad}# {_meaning(entry, top)}"]
        if isinstance(values[name], dict) and values[name]:
            lines.append(f"{pad}{name}:")
            _settings(top, _resolved(entry, top), values[name], pad + "  ", lines)
        else:
            lines.append(f"{pad}{name}: {_inline(values[name])}")


def _inline(value: Any) -> str:
    return (
        yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("\n...\n").strip()
    )


def equations_page(page: str) -> str:
    """docs/equations.md with the table of the joint terms."""
    from intercap_core.joint.problem import equation_table  # imports torch

    head, _, rest = page.partition(TERMS_BEGIN)
    _, _, tail = rest.partition(TERMS_END)
    return head + TERMS_BEGIN + "\n".join(equation_table()) + "\n" + TERMS_END + tail


def settings_page() -> str:
    """config/README.md: all entries of the files that a user writes."""
    lines = [
        "# Settings, tables and annotations",
        "",
        "`intercap dev docs` generates this page and the schemas in `schemas/` from `config.py`,",
        "`entries.py` and `annotation.py` in `intercap_core/`. Relative paths are relative to the",
        "file that contains them. Unknown entries are errors; `intercap check` reports them.",
        "",
        "| folder | contents |",
        "|---|---|",
        "| `demo/`, `quickstart/` | virtual recordings of `make demo` and of docs/quickstart.md |",
        "| `evaluation/`, `capture/`, `object/`, `body/`, `field/`, `annotate/` "
        "| settings of `make evaluate` |",
        "| `bench/` | settings of `make bench` |",
        "| `test/` | two small recordings for the tests |",
        "| `objects/` | meshes of `objects.yaml` |",
    ]
    for model, file, purpose in ENTRIES.values():
        schema = model.model_json_schema()
        lines += ["", f"## {file}", "", f"{purpose}.", ""]
        _table(schema, schema, lines)
    return "\n".join(lines) + "\n"


def _table(top: dict[str, Any], schema: dict[str, Any], lines: list[str]) -> None:
    lines += ["| entry | value | default | meaning |", "|---|---|---|---|"]
    inner: list[tuple[str, dict[str, Any]]] = []
    for name, entry in schema["properties"].items():
        resolved = _resolved(entry, top)
        if "properties" in resolved:
            inner.append((name, resolved))
        default = _default(name, entry, schema)
        meaning = _cell(_meaning(entry, top))
        lines.append(f"| `{name}` | {_kind(entry, top)} | {default} | {meaning} |")
    for name, resolved in inner:
        lines += ["", f"### {name}", "", _cell(resolved.get("description", "")), ""]
        _table(top, resolved, lines)


def _default(name: str, entry: dict[str, Any], schema: dict[str, Any]) -> str:
    if name in schema.get("required", ()):
        return "*required*"
    value = entry.get("default")
    if value is None or isinstance(value, dict):
        return ""
    return f"`{_cell(_inline(value))}`"


def _meaning(entry: dict[str, Any], top: dict[str, Any]) -> str:
    text = entry.get("description") or _resolved(entry, top).get("description", "")
    return " ".join(text.split())


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _resolved(entry: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    """Schema of the inner model of an entry, which may be optional or repeated."""
    options = _options(entry)
    for candidate in (*options, entry.get("items", {}), entry.get("additionalProperties", {})):
        if isinstance(candidate, dict) and candidate:
            found = _resolved(candidate, top)
            if "properties" in found:
                return found
    if "$ref" in entry:
        return top["$defs"][entry["$ref"].rsplit("/", 1)[1]]
    return entry


def _options(entry: dict[str, Any]) -> list[dict[str, Any]]:
    """Alternatives of an entry, without null."""
    either = (*entry.get("anyOf", ()), *entry.get("oneOf", ()))
    return [option for option in either if option.get("type") != "null"]


def _kind(entry: dict[str, Any], top: dict[str, Any]) -> str:
    """Allowed values in words."""
    options = _options(entry)
    if options:
        return " or ".join(_kind(option, top) for option in options)
    if "enum" in entry or "const" in entry:
        return ", ".join(f"`{value}`" for value in entry.get("enum", [entry.get("const")]))
    if "$ref" in entry:
        return "entries, see below"
    kind = entry.get("type", "")
    if kind == "array":
        if "prefixItems" in entry:
            return f"list of {len(entry['prefixItems'])} numbers"
        return f"list of: {_kind(entry.get('items', {}), top)}"
    if kind == "object":
        values = entry.get("additionalProperties", {})
        if isinstance(values, dict) and _options(values):
            return f"names, each with {_kind(values, top)}"
        return "names, each with entries as below"
    if entry.get("format") == "path":
        return "path"
    words = {"integer": "whole number", "string": "text", "boolean": "`true`, `false`"}
    text = words.get(kind, kind)
    if "pattern" in entry:
        text = "name (letters, digits, `_`, `-`)"
    bounds = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    limits = [f"{sign} {entry[key]:g}" for key, sign in bounds.items() if key in entry]
    return " ".join([text, ", ".join(limits)]).strip()


def artefacts_page() -> str:
    """docs/artefacts.md: contents of every artefact."""
    lines = [
        "# What every artefact holds",
        "",
        "Generated from `intercap_core/schemas.py` by `intercap dev docs`. Artefacts are HDF5",
        "files, one a stage and sequence: `results/<dataset>/<sequence>/<stage>.h5`. All carry",
        "the root attributes `schema`, `schema_version`, `frame`, `units`, `settings_digest` and",
        "`complete`; every dataset has a checksum and units. `intercap inspect FILE` prints one.",
        "",
        "Exports are folders in other formats, `results/<dataset>/<sequence>/export`, and those of",
        "all sequences as one are in `results/<dataset>/export`: see",
        "[usage.md](usage.md#publish-a-dataset).",
        "",
        *(schemas.__doc__ or "").split("\n\n", 1)[1].strip().splitlines(),
    ]
    for schema in vars(schemas).values():
        if isinstance(schema, Schema):
            lines += _artefact(schema)
    return "\n".join(lines) + "\n"


def _artefact(schema: Schema) -> list[str]:
    """Lines of docs/artefacts.md about one artefact."""
    lines = [
        "",
        f"## {schema.name}",
        "",
        f"Version {schema.version}, written by stage `{schema.stage}`. Frame: {schema.frame}.",
        "",
    ]
    lines += [f"- attribute `{name}`: {meaning}" for name, meaning in schema.attributes.items()]
    lines += [
        f"- attribute `{name}` (optional): {meaning}"
        for name, meaning in schema.optional_attributes.items()
    ]
    lines += [
        "",
        "| dataset | shape | type | units | frame | meaning |",
        "|---|---|---|---|---|---|",
    ]
    for key, declared in schema.fields.items():
        optional = " (optional)" if declared.optional else ""
        shape = " x ".join(declared.dims)
        lines.append(
            f"| `{key}` | {shape} | {declared.dtype} | {declared.units} | {declared.frame} "
            f"| {_cell(declared.doc)}{optional} |"
        )
    return lines
