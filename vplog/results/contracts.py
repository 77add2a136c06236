"""The contracts for outsiders: one .proto per own message, one JSON per Parquet table."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from vplog.results import kept_features, messages, placed, places_map, tables
from vplog.results.layouts import layouts
from vplog.results.mcap import TOPICS
from vplog.storage.parquet_limits import TABLE_VERSION, VERSION_ABOUT, VERSION_KEY
from vplog.storage.scratch import replacing

if TYPE_CHECKING:
    from pathlib import Path

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


def write_schemas(folder: Path, pipeline_schema: dict[str, Any]) -> list[Path]:
    """Write the contracts into a folder; the files written, in order. The pipeline's JSON Schema comes from outside:
    the settings of all stages are known only to the pipeline."""
    texts = {"vplog.LoopClosure.proto": messages.loop_closure_proto()}
    topics = [{"topic": name, "schema": kind, "description": about} for name, (kind, about) in TOPICS.items()]
    texts["result.mcap.json"] = json.dumps({"file": "result.mcap", "topics": topics}, indent=2) + "\n"
    texts["pipeline.schema.json"] = json.dumps(pipeline_schema, indent=2, sort_keys=True, ensure_ascii=False) + "\n"
    for name, schema in table_schemas().items():
        texts[f"{name}.json"] = json.dumps(_contract(name, schema), indent=2, ensure_ascii=False) + "\n"
    written = []
    for name, text in texts.items():
        with replacing(folder / name) as stream:
            stream.write(text.encode())
        written.append(folder / name)
    return written


def table_schemas() -> dict[str, pa.Schema]:
    """The schema of every table, by name. A descriptor is shown as bytes: its type is the recogniser's choice."""
    return {
        "keyframes": tables.KEYFRAMES,
        "descriptors": tables.descriptors_schema(pa.binary()),
        "closures": tables.CLOSURES,
        "joins": tables.JOINS,
        "edges": tables.EDGES,
        "trajectory": tables.TRAJECTORY,
        "placed": placed.PLACED,
        "features": kept_features.FEATURES,
        "map": pa.schema([*places_map.PLACE, tables.descriptors_schema(pa.binary()).field("descriptor")]),
    }


def _contract(name: str, schema: pa.Schema) -> dict[str, Any]:
    columns = []
    for column in schema:
        metadata = {key.decode(): value.decode() for key, value in column.metadata.items()}
        kind = _kind(column.type)
        if column.name == "descriptor":
            kind = "any"
        columns.append(
            {
                "name": column.name,
                "type": kind,
                "nullable": column.nullable,
                "unit": metadata["unit"],
                "description": metadata["description"],
            }
        )
    contract = {
        "table": name,
        "version": TABLE_VERSION,
        "file": f"{name}.parquet",
        "metadata": _HEADER,
        "columns": columns,
    }
    if name == "features":
        contract |= {"file": "MAP/joins/drive=ID/features.parquet", "metadata": kept_features.HEADER}
    if name == "joins":
        files = "joins.parquet, MAP/joins/drive=ID/match=ID.parquet, MAP/joint/component=KEY/joins.parquet"
        contract |= {"file": files}
    if name == "placed":
        contract |= {"file": "named by `vplog map query -o`"}
    if name == "map":
        contract |= {"file": "named by `vplog map export -o`", "metadata": {**_HEADER, **_MAP_HEADER}}
    return {**contract, "descriptor": layouts()} if columns[-1]["name"] == "descriptor" else contract


def _kind(kind: pa.DataType) -> str:
    """The name of a type: `float64[36]` a list of that many, `uint16[]` a list of any length."""
    if pa.types.is_fixed_size_list(kind):
        return f"{_kind(kind.value_type)}[{kind.list_size}]"
    if pa.types.is_list(kind):
        return f"{_kind(kind.value_type)}[]"
    if pa.types.is_dictionary(kind):
        return _kind(kind.value_type)
    return {"float": "float32", "double": "float64"}.get(str(kind), str(kind))
