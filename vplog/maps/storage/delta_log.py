"""Logs of Delta Lake tables, by the protocol of github.com/delta-io/delta: schemas, commits and checkpoints.

Delta has no unsigned numbers, none of half precision and no lists of a fixed length, so values get the next wider type
that it has. The drive is a column of every table, and nothing is a partition: so it is there once, as text.
"""

from __future__ import annotations

import io
import json
import uuid
from typing import Annotated, Any, NotRequired

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field, StrictInt, TypeAdapter
from typing_extensions import TypedDict  # as pydantic needs it below Python 3.12

from vplog.errors import ResultError
from vplog.version import __version__

_WIDER = {
    pa.uint8(): pa.int16(), pa.uint16(): pa.int32(), pa.uint32(): pa.int64(), pa.float16(): pa.float32(),
}  # fmt: skip
_NAMES = {
    pa.int8(): "byte", pa.int16(): "short", pa.int32(): "integer", pa.int64(): "long", pa.float32(): "float",
    pa.float64(): "double", pa.bool_(): "boolean", pa.string(): "string", pa.binary(): "binary",
}  # fmt: skip
_PROTOCOL = {"minReaderVersion": 1, "minWriterVersion": 2}
"""The version that every reader has: no feature that came later is used."""
_MAP = pa.map_(pa.string(), pa.string())
_ADD = {
    "path": pa.string(), "partitionValues": _MAP, "size": pa.int64(), "modificationTime": pa.int64(),
    "dataChange": pa.bool_(), "stats": pa.string(),
}  # fmt: skip
_METADATA = {
    "id": pa.string(), "name": pa.string(), "format": pa.struct({"provider": pa.string(), "options": _MAP}),
    "schemaString": pa.string(), "partitionColumns": pa.list_(pa.string()), "configuration": _MAP,
}  # fmt: skip
_CHECKPOINT = pa.schema(
    {
        "protocol": pa.struct(dict.fromkeys(_PROTOCOL, pa.int32())),
        "metaData": pa.struct(_METADATA),
        "add": pa.struct(_ADD),
        "remove": pa.struct({"path": pa.string(), "deletionTimestamp": pa.int64(), "dataChange": pa.bool_()}),
    }
)

Commit = dict[str, Any]
"""Fields as in `_Commit`, as plain values."""


class _DataFile(TypedDict):
    drives: dict[str, str]
    """Drives in it, with a hash of what each was made from."""
    tables: dict[str, tuple[StrictInt, StrictInt]]
    """Bytes and rows of each table that has rows."""


_DataFiles = dict[Annotated[str, Field(pattern="^part-[0-9a-f]{32}$")], _DataFile]


class _Commit(TypedDict):
    """A version of all tables."""

    format: StrictInt
    id: Annotated[str, Field(pattern="^[0-9a-f-]{36}$")]
    """Identity of the tables, the same in all versions."""
    version: StrictInt
    time: StrictInt
    """ms since 1970."""
    change: bool
    """Whether rows differ from those before."""
    schemas: dict[str, str]
    replaced: bool
    """Whether schemas differ from those before."""
    added: _DataFiles
    removed: _DataFiles
    files: NotRequired[_DataFiles]
    """All there are after it."""


COMMIT = TypeAdapter(_Commit)


def plain_schema(schema: pa.Schema) -> pa.Schema:
    """Columns of a data set in the types that Delta has, any of which may be null, with the drive first."""
    fields = [field.with_type(_plain(field.type)).with_nullable(True) for field in schema if field.name != "drive"]
    return pa.schema([pa.field("drive", pa.string(), metadata={"description": "Name of the drive."}), *fields])


def _plain(kind: pa.DataType) -> pa.DataType:
    if isinstance(kind, pa.StructType):
        return pa.struct([pa.field(part.name, _plain(part.type)) for part in kind])
    if isinstance(kind, pa.ListType | pa.LargeListType | pa.FixedSizeListType):
        return pa.list_(pa.field("element", _plain(kind.value_type)))
    return _WIDER.get(kind, kind)


def schema_string(schema: pa.Schema) -> str:
    """A schema as Delta writes it. Raises ResultError where it has no such type."""
    fields = []
    for field in schema:
        about = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
        text = " ".join(filter(None, (about.get("description"), about.get("unit") and f"[{about['unit']}]")))
        fields.append(_field(field, {"comment": text} if text else {}))
    return json.dumps({"type": "struct", "fields": fields})


def extends(schema: str, known: str) -> bool:
    """Whether files of a known schema can be read by another: each column has its type, and there may be more."""
    types, before = ({one["name"]: one["type"] for one in json.loads(text)["fields"]} for text in (schema, known))
    return before.items() <= types.items()


def _field(field: pa.Field, about: dict[str, str]) -> dict[str, Any]:
    return {"name": field.name, "type": _type(field.type), "nullable": True, "metadata": about}


def _type(kind: pa.DataType) -> Any:
    if isinstance(kind, pa.StructType):
        return {"type": "struct", "fields": [_field(part, {}) for part in kind]}
    if isinstance(kind, pa.ListType):
        return {"type": "array", "elementType": _type(kind.value_type), "containsNull": True}
    if kind not in _NAMES:
        raise ResultError(f"Delta Lake has no type for {kind}, which descriptors of the map have.")
    return _NAMES[kind]


def log_entry(commit: Commit, table: str) -> bytes:
    """The commit in the log of a table: VERSION.json."""
    actions: list[dict[str, Any]] = [
        {"commitInfo": {
            "timestamp": commit["time"], "operation": "WRITE" if commit["change"] else "OPTIMIZE",
            "engineInfo": f"vplog {__version__}",
        }}
    ]  # fmt: skip
    if commit["replaced"]:
        actions += [{"protocol": _PROTOCOL}, {"metaData": _metadata(commit, table)}]
    removed = {"deletionTimestamp": commit["time"], "dataChange": commit["change"]}
    actions += [
        {"remove": {"path": f"{name}.parquet", **removed}}
        for name, file in commit["removed"].items()
        if table in file["tables"]
    ]
    actions += [{"add": add} for add in _adds(commit["added"], table, commit)]
    return "".join(json.dumps(action, ensure_ascii=False) + "\n" for action in actions).encode()


def checkpoint(commit: Commit, table: str, files: dict[str, Any]) -> tuple[bytes, bytes]:
    """VERSION.checkpoint.parquet and _last_checkpoint of a table that has these files after a commit."""
    about = _metadata(commit, table)
    about |= {"format": {"provider": "parquet", "options": []}, "configuration": []}
    adds = [{**add, "partitionValues": []} for add in _adds(files, table, commit)]
    rows = [{"protocol": _PROTOCOL}, {"metaData": about}, *({"add": add} for add in adds)]
    sink = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows, _CHECKPOINT), sink, store_schema=False)
    return sink.getvalue(), json.dumps({"version": commit["version"], "size": len(rows)}).encode()


def _metadata(commit: Commit, table: str) -> dict[str, Any]:
    return {
        "id": str(uuid.uuid5(uuid.UUID(commit["id"]), table)), "name": table,
        "format": {"provider": "parquet", "options": {}}, "schemaString": commit["schemas"][table],
        "partitionColumns": [], "configuration": {},
    }  # fmt: skip


def _adds(files: dict[str, Any], table: str, commit: Commit) -> list[dict[str, Any]]:
    """Files of a table, with the least and greatest drive of each, by which readers pass files over."""
    found = []
    for name, file in files.items():
        if table in file["tables"]:
            size, rows = file["tables"][table]
            stats = {"numRecords": rows, "minValues": {"drive": min(file["drives"])}}
            stats |= {"maxValues": {"drive": max(file["drives"])}, "nullCount": {"drive": 0}}
            found.append({
                "path": f"{name}.parquet", "partitionValues": {}, "size": size, "modificationTime": commit["time"],
                "dataChange": commit["change"], "stats": json.dumps(stats, ensure_ascii=False),
            })  # fmt: skip
    return found
