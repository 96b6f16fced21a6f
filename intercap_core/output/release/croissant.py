"""Description of the dataset in the Croissant format 1.0, with its responsible-AI fields.

Croissant: mlcommons.org/croissant.

It lists files and columns of tables for loaders and search engines.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from intercap_core.output.export.registry import formats
from intercap_core.output.release.card import Facts
from intercap_core.output.release.datasheet import rai_fields

CONFORMS_TO = ["http://mlcommons.org/croissant/1.0", "http://mlcommons.org/croissant/RAI/1.0"]
_TYPES = {"b": "sc:Boolean", "i": "sc:Integer", "u": "sc:Integer", "f": "sc:Float"}  # of numpy
_TERMS = (
    "citeAs", "column", "extract", "field", "fileProperty", "fileObject", "fileSet", "format",
    "includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet",
    "references", "regex", "repeated", "replace", "samplingRate", "separator", "source", "subField",
    "transform",
)  # fmt: skip
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{name: f"cr:{name}" for name in _TERMS},
}


def croissant(card: Facts, folder: Path, tables: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
    """Return the content of croissant.json of a dataset in ``folder``; ``tables`` are written."""
    described: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": CONFORMS_TO,
        "name": card["name"],
        "alternateName": card["title"],
        "description": card["description"] or f"{card['title']}: people and objects in 4D",
        "version": card["version"],
        "keywords": ["human-object interaction", "SMPL-X", "6D object pose", "contact", "RGB-D"],
        "distribution": [
            *(_table_file(folder, name) for name in tables),
            *(_file_set(name) for name in card["formats"]),
        ],
        "recordSet": [_records(name, table) for name, table in tables.items()],
    }
    optional = {
        "license": card["licence"],
        "url": card["url"],
        "citeAs": card["citation"],
        "datePublished": card["published"],
        "creator": [{"@type": "sc:Person", "name": name} for name in card["creators"]],
    }
    stated = {key: value for key, value in optional.items() if value}
    return described | stated | rai_fields(card)


def _table_file(folder: Path, name: str) -> dict[str, Any]:
    path = folder / "tables" / f"{name}.csv"
    data = path.read_bytes()
    return {
        "@type": "cr:FileObject",
        "@id": f"{name}.csv",
        "name": f"{name}.csv",
        "contentUrl": f"tables/{name}.csv",
        "contentSize": f"{len(data)} B",
        "encodingFormat": "text/csv",
        "sha256": hashlib.sha256(data).hexdigest(),
    }


def _file_set(name: str) -> dict[str, Any]:
    format_ = formats()[name.removesuffix("_merged")]
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "encodingFormat": format_.media_type,
        # one folder for each sequence, but for merged exports
        "includes": format_.includes.removeprefix("*/" if name.endswith("_merged") else ""),
    }


def _records(name: str, table: pd.DataFrame) -> dict[str, Any]:
    """Describe the columns of a table."""
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{column}",
                "name": f"{name}/{column}",
                "dataType": _TYPES.get(table[column].dtype.kind, "sc:Text"),
                "source": {
                    "fileObject": {"@id": f"{name}.csv"},
                    "extract": {"column": str(column)},
                },
            }
            for column in table.columns
        ],
    }
