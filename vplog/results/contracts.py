"""The contracts for outsiders: one .proto per own message, one JSON per Parquet table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa

from vplog.errors import ResultError
from vplog.results import feature_table, landmark_table, messages, places_map, tables
from vplog.results.mcap import TOPICS
from vplog.results.staging import check_contents
from vplog.storage.parquet_limits import TABLE_VERSION, VERSION_ABOUT, VERSION_KEY
from vplog.storage.scratch import replacing

_HEADER = {
    "vplog.table": "Name of the table.",
    "vplog.settings": "The full tree of settings as JSON with sorted keys.",
    "vplog.library": "Hash of the place library, empty where none was used.",
    "vplog.version": "Version of vplog that wrote the file.",
    VERSION_KEY: VERSION_ABOUT,
}

_MAP_HEADER = {
    "vplog.descriptor": "The columns behind the poses, one for each part of a descriptor, as JSON: name, type, and "
    "where the column is bytes the number of its values, which are little endian.",
    "vplog.drives": "For each drive by its ID, as JSON, as far as known: `inputs`, the sha256 of its log's files; "
    "`topics`, those that were requested; `earth`, where on earth its frame is.",
}

_CODE = (
    "By reference, then window: where the window is found, the number of a box of places.box_columns x places.box_rows "
    "cells in a grid of places.columns x places.rows, row by row by its upper left cell; 255: nowhere."
)
_CORNERS = "By reference, then box: x0 y0 x1 y1 in cells of a grid of places.grid x places.grid; all 0: none."
_BEST_FIRST = "Numbers of the library images that explain it, best first"

LAYOUTS: dict[str, list[tuple[str, str, str]]] = {
    "bobb": [
        ("references", "uint16[J]", f"{_BEST_FIRST}; 65535: none."),
        ("weights", "uint8[J]", "How much each explains, in 255ths of the most."),
        ("boxes", "uint8[J*I]", _CODE),
    ],
    "bobb_paper": [
        ("references", "int32[J]", f"{_BEST_FIRST}; -1: none."),
        ("boxes", "uint8[J*I*4]", _CORNERS),
    ],
    "hybrid": [
        ("boxes", "as bobb", "The boxes; in a map boxes.references, boxes.weights, boxes.boxes."),
        ("signs", "uint8[W*B/8]", "One bit for each visual word and direction."),
    ],
    "bovf": [("descriptor", "(uint16 word, uint8 count)[]", "Words by number, and how often each is there.")],
    "fabmap": [("descriptor", "uint16[]", "Words that are there, increasing.")],
    "vlad": [("descriptor", "float16[D]", "Of unit length; compared by the scalar product.")],
    "gist": [("descriptor", "float16[D]", "Mean energy by scale, orientation, then block, row by row.")],
    "onnx": [("descriptor", "float16[D]", "The network's vector at unit length; compared by the scalar product.")],
    "vectors": [("descriptor", "float16[D]", "At unit length, compared by the scalar product; by L2, float32[D].")],
    "thumbnail": [("descriptor", "uint8[2048]", "Patch-normalised pixels, row by row.")],
}
"""By recogniser: name, type and meaning of the parts of `descriptor`, which become columns of a map. J references
with I boxes or windows on each, W words of B bits: settings under `places`, which the header of every table holds."""
_OF_TABLE: dict[str, dict[str, Any]] = {
    "features": {"file": "MAP/joins/drive=ID/features.parquet", "metadata": feature_table.HEADER},
    "joins": {
        "file": "joins.parquet, MAP/joins/drive=ID/match=ID.parquet, MAP/joint/component=KEY/joins.parquet",
    },
    "landmarks": {
        "file": "RUN/landmarks.parquet, MAP/joins/drive=ID/landmarks.parquet",
        "metadata": landmark_table.HEADER,
    },
    "localized": {"file": "named by `vplog localize -o`"},
    "placed": {"file": "named by `vplog map query -o`"},
    "map": {"file": "named by `vplog map export -o`", "metadata": {**_HEADER, **_MAP_HEADER}},
}
"""Fields of the contract of a table that differ from those of most."""


_HEAD = 14
"""Characters by which a schema is known: as far as the name of its first key's value."""


def write_schemas(folder: Path, pipeline_schema: dict[str, Any]) -> list[Path]:
    """Write the contracts into a folder; the files written, in order. The pipeline's JSON Schema comes from outside:
    the settings of all stages are known only to the pipeline. Raises ResultError where other files have their names."""
    topics = [{"topic": name, "schema": kind, "description": about} for name, (kind, about) in TOPICS.items()]
    texts = {
        "vplog.LoopClosure.proto": messages.loop_closure_proto(),
        "result.mcap.json": json.dumps({"file": "result.mcap", "topics": topics}, indent=2) + "\n",
        "pipeline.schema.json": json.dumps(pipeline_schema, indent=2, sort_keys=True, ensure_ascii=False) + "\n",
    }
    for name, schema in table_schemas().items():
        texts[f"{name}.json"] = json.dumps(_contract(name, schema), indent=2, ensure_ascii=False) + "\n"
    check_contents(folder, "schemas", any((folder / name).exists() for name in texts))
    for name, text in texts.items():
        if (folder / name).exists() and not (folder / name).read_bytes().startswith(text[:_HEAD].encode()):
            raise ResultError(f"{folder / name} is no schema, and is not replaced. Choose another folder with -o.")
    for name, text in texts.items():
        with replacing(folder / name) as stream:
            stream.write(text.encode())
    return [folder / name for name in texts]


def table_schemas() -> dict[str, pa.Schema]:
    """The schema of every table, by name. A descriptor is shown as bytes: its type is the recogniser's choice."""
    return {
        "keyframes": tables.KEYFRAMES,
        "descriptors": tables.descriptors_schema(pa.binary()),
        "closures": tables.CLOSURES,
        "joins": tables.JOINS,
        "edges": tables.EDGES,
        "trajectory": tables.TRAJECTORY,
        "placed": tables.PLACED,
        "features": feature_table.FEATURES,
        "landmarks": landmark_table.LANDMARKS,
        "localized": tables.LOCALIZED,
        "map": pa.schema([*places_map.PLACE, tables.descriptors_schema(pa.binary()).field("descriptor")]),
    }


def _contract(name: str, schema: pa.Schema) -> dict[str, Any]:
    columns = [
        {
            "name": column.name,
            "type": "any" if column.name == "descriptor" else _kind(column.type),
            "nullable": column.nullable,
            **{key: column.metadata[key.encode()].decode() for key in ("unit", "description")},
        }
        for column in schema
    ]
    about = {"table": name, "version": TABLE_VERSION, "file": f"{name}.parquet", "metadata": _HEADER}
    contract = {**about, "columns": columns, **_OF_TABLE.get(name, {})}
    if columns[-1]["name"] == "descriptor":
        keys = ("name", "type", "description")
        contract["descriptor"] = {
            kind: [dict(zip(keys, part, strict=True)) for part in parts] for kind, parts in LAYOUTS.items()
        }
    return contract


def _kind(kind: pa.DataType) -> str:
    """The name of a type: `float64[36]` a list of that many, `uint16[]` a list of any length."""
    if pa.types.is_fixed_size_list(kind):
        return f"{_kind(kind.value_type)}[{kind.list_size}]"
    if pa.types.is_list(kind):
        return f"{_kind(kind.value_type)}[]"
    if pa.types.is_dictionary(kind):
        return _kind(kind.value_type)
    return {"halffloat": "float16", "float": "float32", "double": "float64"}.get(str(kind), str(kind))
